"""Drones of known shape at known places, for tests of the images, masks and labels of the simulator."""

from dataclasses import replace

import msgspec
import numpy as np

from psotrack.geometry import project
from psotrack.simulation.flights.motion import HarmonicFlight, Heading
from psotrack.simulation.labels.masks import silhouettes
from psotrack.simulation.world.drones import DroneModel
from psotrack.simulation.world.models import box


def straight_flight(position_m, velocity_m_s=(0.0, 0.0, 0.0)):
    """Flight on an almost straight line through `position_m` at time 0: the middle of a slow, long oscillation."""
    angular = 1e-3
    velocity = np.array([velocity_m_s], float)
    zero = np.zeros((1, 3))
    return HarmonicFlight(
        np.array(position_m, float), velocity / angular, np.array([angular]), zero, Heading()
    )


def with_drones(scene, *placed):
    """The scene with other drones; each element of `placed` is a tuple (model, flight, paint in BGR)."""
    recipe = msgspec.structs.replace(
        scene.scenario,
        drones=tuple(
            msgspec.structs.replace(scene.scenario.drones[0], paint_bgr=paint) for _, _, paint in placed
        ),
    )
    models, flights = tuple(model for model, _, _ in placed), tuple(flight for _, flight, _ in placed)
    return replace(scene, scenario=recipe, models=models, flights=flights)


def cube(side_m):
    """Painted cube around the origin, whose rotors are too small to be visible."""
    triangles = box((0.0, 0.0, 0.0), (side_m, side_m, side_m))
    return DroneModel(triangles, np.ones(len(triangles)), np.zeros((1, 3)), np.array([1e-6]))


def ray_point(scene, index, pixel, depth_m):
    """(3,), the point in the world that camera `index` sees in `pixel` at depth `depth_m`, metres."""
    cam = scene.rig.cameras[index]
    R, t = cam.T_cam_world[:3, :3], cam.T_cam_world[:3, 3]
    return R.T @ (depth_m * np.linalg.inv(cam.K) @ [*pixel, 1.0] - t)


def drone_masks(scene, cam, backdrop_depth_m, frame):
    """(height, width), number of the visible drone per pixel, from 1 on, at the middle of the exposure; 0 for none."""
    numbers = np.zeros((cam.height, cam.width), np.uint8)
    for silhouette in silhouettes(scene, cam, backdrop_depth_m, frame):
        numbers[silhouette.window.slices][silhouette.seen] = silhouette.number
    return numbers


def pixel_of(scene, index, point_m):
    """(2,), the pixel in which camera `index` sees a point of the world."""
    return project(scene.rig.cameras[index], np.asarray(point_m, float))[0]
