"""Drones of known shape at known places, and what OpenCV says of them, for tests of the simulator's images."""

import functools
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest

from psotrack.geometry import project
from psotrack.simulation import CameraRenderer, build, scenario
from psotrack.simulation.flights.motion import HarmonicFlight, Heading
from psotrack.simulation.imaging import sensor
from psotrack.simulation.labels import silhouettes
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.world.drones import DroneModel, box
from psotrack.simulation.world.rooms import MARKER_DICTIONARY

S02 = scenario("S02_D4_A")
BLACK = (0.0, 0.0, 0.0)
#: Settings with antialiasing and without any other effect.
PLAIN = Imaging(
    shutter_s=0.0,
    lens_blur_px=0.0,
    shadows=False,
    reflections=0.0,
    exposure_drift=0.0,
    white_balance_drift=0.0,
    flicker=0.0,
    read_noise=0.0,
    shot_noise=0.0,
)
#: Corners of a cube with sides of 1 m around the origin.
CORNERS_M = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


@functools.cache
def laboratory(scale=0.25):
    """The scene of a sequence with four drones and eight cameras, built once per process."""
    return build(S02, scale=scale)


def straight_flight(position_m, velocity_m_s=(0.0, 0.0, 0.0), heading=Heading()):  # noqa: B008
    """Flight on an almost straight line through `position_m` at time 0: the middle of a slow, long oscillation."""
    angular = 1e-3
    velocity = np.array([velocity_m_s], float)
    zero = np.zeros((1, 3))
    return HarmonicFlight(np.array(position_m, float), velocity / angular, np.array([angular]), zero, heading)


def cube(side_m):
    """Painted cube around the origin, whose rotors are too small to be visible."""
    triangles = box((0.0, 0.0, 0.0), (side_m, side_m, side_m))
    return DroneModel(triangles, np.ones(len(triangles)), np.zeros((1, 3)), np.array([1e-6]))


def hovering(model, position_m, paint=BLACK):
    """A drone for `with_drones` that stays at a point."""
    return model, straight_flight(position_m), paint


def with_drones(scene, *placed):
    """The scene with other drones; each element of `placed` is a tuple (model, flight, paint in BGR)."""
    first = scene.scenario.drones[0]
    drones = tuple(msgspec.structs.replace(first, paint_bgr=paint) for _, _, paint in placed)
    recipe = msgspec.structs.replace(scene.scenario, drones=drones)
    models, flights = tuple(model for model, _, _ in placed), tuple(flight for _, flight, _ in placed)
    return replace(scene, scenario=recipe, models=models, flights=flights)


def with_imaging(scene, imaging=PLAIN, **changes):
    """The scene with other imaging settings: those of `imaging`, with changes."""
    imaging = msgspec.structs.replace(imaging, **changes)
    return replace(scene, scenario=msgspec.structs.replace(scene.scenario, imaging=imaging))


def ray_point(scene, index, pixel, depth_m):
    """(3,), the point in the world that camera `index` sees in `pixel` at depth `depth_m`, metres."""
    cam = scene.rig.cameras[index]
    R, t = cam.T_cam_world[:3, :3], cam.T_cam_world[:3, 3]
    return R.T @ (depth_m * np.linalg.inv(cam.K) @ [*pixel, 1.0] - t)


def pixel_of(scene, index, point_m):
    """(2,), the pixel in which camera `index` sees a point of the world."""
    return project(scene.rig.cameras[index], np.asarray(point_m, float))[0]


def opencv_pixels(cam, points_m, dist=None):
    """(points, 2), the pixels in which OpenCV projects points; `cam` has `R`, `t_m` and `K`."""
    points_m = np.reshape(points_m, (-1, 3)).astype(float)
    return cv2.projectPoints(points_m, cv2.Rodrigues(cam.R)[0], cam.t_m, cam.K, dist)[0][:, 0]


def centre_and_area(pixels):
    """The centre (x, y) and the area of the convex outline of points, by OpenCV, pixels and squared pixels."""
    outline = cv2.moments(cv2.convexHull((256 * pixels).round().astype(np.int32)))
    return np.array([outline["m10"], outline["m01"]]) / outline["m00"] / 256, outline["m00"] / 256**2


def mean_and_variance(weight):
    """Weighted mean (x, y) and the variances along x and y, pixels and squared pixels."""
    rows, columns = np.indices(weight.shape)
    x, y = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
    spread = [(weight * (columns - x) ** 2).sum(), (weight * (rows - y) ** 2).sum()]
    return np.array([x, y]), np.array(spread) / weight.sum()


def hidden_share(frame, empty, least=0.03):
    """The share of the light of the empty room that black drones hide in a frame, (height, width)."""
    light, room = (sensor.undevelop(image).sum(axis=-1) for image in (frame, empty))
    share = 1 - light / np.maximum(room, 1e-3)
    # Shares up to 0.03 come from the rounding to 8 bits and from the drone's own shadow.
    return np.where(share > least, share, 0.0)


def hidden_by_drones(scene, index=0, **options):
    """The share of the room's light that black drones hide in frame 0 of a camera, (height, width)."""
    renderer = CameraRenderer(scene, index)
    return hidden_share(renderer.clean_frame(0), sensor.develop(renderer.views[0].backdrop.light), **options)


def around(pixel, reach):
    """The window of an image within `reach` pixels of a pixel, and the window's first (x, y)."""
    x, y = np.round(pixel).astype(int)
    return np.s_[y - reach : y + reach + 1, x - reach : x + reach + 1], np.array([x - reach, y - reach])


def assert_drawn_at(share, corners, *, atol_px, area_rel):
    """Assert that the share of light that drones hide has the place and the area of the outline of corners, pixels.

    Returns the window of the image around the outline.
    """
    expected, area = centre_and_area(corners)
    window, first = around(expected, 24)
    middle, _ = mean_and_variance(share[window])
    np.testing.assert_allclose(middle + first, expected, atol=atol_px)
    assert share[window].sum() == pytest.approx(area, rel=area_rel)
    return window


def number_image(renderer, frame=0):
    """(height, width), number of the visible drone per pixel at the middle of a frame's exposure, from 1 on; else 0."""
    cam, numbers = renderer.cam, np.zeros((renderer.cam.height, renderer.cam.width), np.uint8)
    for silhouette in silhouettes(renderer.scene, cam, renderer.views[0].backdrop.depth_m, frame):
        numbers[silhouette.window.slices][silhouette.seen] = silhouette.number
    return numbers


def find_markers(image):
    """Number -> corners (4, 2), pixels, of the markers that OpenCV finds in an image."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY), settings)
    corners, ids, _ = detector.detectMarkers(image)
    return {int(marker): found[0] for marker, found in zip(ids.ravel(), corners, strict=True)}
