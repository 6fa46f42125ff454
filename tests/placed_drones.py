"""Drones of known shape at known places, for tests of what cameras make of them."""

from dataclasses import replace

import msgspec
import numpy as np

from psotrack.geometry import project
from psotrack.simulation.flights.formulas import HarmonicFlight
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.labels.masks import silhouettes
from psotrack.simulation.world.drones import DroneModel
from psotrack.simulation.world.shapes import box


def straight_flight(position_m, velocity_m_s=(0.0, 0.0, 0.0)):
    """A flight through a point at time 0 at some speed: the middle of a very slow, very long swing."""
    angular = 1e-3
    velocity = np.array([velocity_m_s], float)
    zero = np.zeros((1, 3))
    return HarmonicFlight(
        np.array(position_m, float), velocity / angular, np.array([angular]), zero, Heading()
    )


def with_drones(scene, *placed):
    """The scene with only these drones: (model, flight, paint) each."""
    recipe = msgspec.structs.replace(
        scene.scenario,
        drones=tuple(
            msgspec.structs.replace(scene.scenario.drones[0], paint_bgr=paint) for _, _, paint in placed
        ),
    )
    models, flights = tuple(model for model, _, _ in placed), tuple(flight for _, flight, _ in placed)
    return replace(scene, scenario=recipe, models=models, flights=flights)


def cube(side_m):
    """A model whose silhouette's middle is its origin: all paint, and rotors too small to be seen."""
    triangles = box((0.0, 0.0, 0.0), (side_m, side_m, side_m))
    return DroneModel(triangles, np.ones(len(triangles)), np.zeros((1, 3)), np.array([1e-6]))


def ray_point(scene, index, pixel, depth_m):
    """The world point that camera `index` sees in a pixel at a depth."""
    cam = scene.rig.cameras[index]
    R, t = cam.T_cam_world[:3, :3], cam.T_cam_world[:3, 3]
    return R.T @ (depth_m * np.linalg.inv(cam.K) @ [*pixel, 1.0] - t)


def drone_masks(scene, cam, backdrop_depth_m, frame):
    """(height, width): which drone is seen in a pixel in the middle of the exposure, its number from 1, or 0."""
    numbers = np.zeros((cam.height, cam.width), np.uint8)
    for one in silhouettes(scene, cam, backdrop_depth_m, frame):
        numbers[one.window.slices][one.seen] = one.number
    return numbers


def pixel_of(scene, index, point_m):
    return project(scene.rig.cameras[index], np.asarray(point_m, float))[0]
