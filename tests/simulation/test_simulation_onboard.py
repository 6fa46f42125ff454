"""Rendered frames of on-board cameras, compared with OpenCV's projection, rays, a depth buffer and sharp frames."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from placed_drones import cube, straight_flight, with_drones
from scipy.spatial.transform import Rotation

from psotrack.recordings.datasets import onboard_pose_file, read_poses, write_poses
from psotrack.simulation import CameraRenderer, build, scenario
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.imaging import backdrop, raster, sensor
from psotrack.simulation.imaging.onboard import OnboardRenderer, intrinsics, onboard_poses
from psotrack.simulation.imaging.painter import LIGHT_UNIT, RoomPainter
from psotrack.simulation.imaging.shadows import FloorLight
from psotrack.simulation.scenarios import OnboardCamera
from psotrack.simulation.world.halls import HALLS
from psotrack.simulation.world.rooms import MARKER_DICTIONARY, room

S02 = scenario("S02_D4_A")
BLACK = (0.0, 0.0, 0.0)
TILT = Rotation.from_rotvec([0.4, 0.3, 0.5]).as_matrix()
#: Position of the on-board camera in the middle of the laboratory, looking along x, metres.
MIDDLE = (-1.0, 0.3, 1.5)


@pytest.fixture(scope="module")
def scene():
    return build(S02, scale=0.25)


@pytest.fixture(scope="module")
def full_size():
    return build(S02)


def make_tilted_cube(side_m):
    """Make a cube whose edges are not parallel to pixel rows or columns.

    An edge that is parallel to a row would enter or miss all samples of the row at once.
    """
    upright = cube(side_m)
    return replace(upright, triangles_m=upright.triangles_m @ TILT.T)


def scene_with_onboard_camera(scene, flight, *placed, **onboard):
    """Return a scene without shadows in which drone 0 carries a camera and all other drones are black tilted cubes.

    Args:
        scene: scene whose room is used.
        flight: flight of drone 0.
        placed: further drones, each as (side in metres, flight).
        onboard: fields of `OnboardCamera`.
    """
    imaging = msgspec.structs.replace(scene.scenario.imaging, shadows=False)
    recipe = msgspec.structs.replace(scene.scenario, imaging=imaging, onboard=OnboardCamera(**onboard))
    return with_drones(
        replace(scene, scenario=recipe),
        (cube(0.2), flight, BLACK),
        *((make_tilted_cube(side_m), flight, BLACK) for side_m, flight in placed),
    )


def turning_flight(position_m, speed_rad_s=0.0, yaw_rad=0.0):
    """Make a flight that hovers and turns; `speed_rad_s` is the yaw rate at time 0."""
    return replace(straight_flight(position_m), heading=Heading(yaw_rad, speed_rad_s, 1.0, 0.0))


def project_by_opencv(cam, points_m):
    rvec, _ = cv2.Rodrigues(cam.R)
    return cv2.projectPoints(np.atleast_2d(points_m), rvec, cam.t_m, cam.K, None)[0].reshape(-1, 2)


def covered_share(with_drones_shown, empty, frame=0):
    """Return the share of the room's light that black drones hide, (height, width)."""
    light = [
        sensor.undevelop(renderer.clean_frame(frame)).sum(axis=-1) for renderer in (with_drones_shown, empty)
    ]
    share = 1 - light[0] / np.maximum(light[1], 1e-3)
    # Shares up to 0.03 come from the rounding to 8 bits.
    return np.where(share > 0.03, share, 0.0)


def mean_and_variance(weight):
    """Return the weighted mean (x, y) and the variances along x and y, pixels and squared pixels."""
    rows, columns = np.indices(weight.shape)
    x, y = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
    spread = [(weight * (columns - x) ** 2).sum(), (weight * (rows - y) ** 2).sum()]
    return np.array([x, y]), np.array(spread) / weight.sum()


def detect_aruco(image):
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(image)
    return {int(marker): found.reshape(4, 2) for marker, found in zip(ids.ravel(), corners, strict=True)}


# --- where the camera is


def test_the_camera_is_fixed_to_the_body_and_looks_forward(scene):
    carrier_scene = scene_with_onboard_camera(
        scene, turning_flight(MIDDLE, yaw_rad=0.7), position_m=(0.1, 0.05, -0.02), pitch_deg=20.0
    )
    cam = OnboardRenderer(carrier_scene, 0).cam_at(0.0)
    # The drone does not accelerate and is level, so the body's axes are the world's axes, turned by the heading.
    ahead, left, up = Rotation.from_euler("z", 0.7).as_matrix().T
    centre = np.array(MIDDLE) + 0.1 * ahead + 0.05 * left - 0.02 * up
    np.testing.assert_allclose(-cam.R.T @ cam.t_m, centre, atol=1e-12)
    optical_axis = np.cos(np.radians(20)) * ahead + np.sin(np.radians(20)) * up
    points = centre + np.stack([optical_axis, optical_axis - 0.1 * left, optical_axis + 0.1 * up])
    on_axis, to_the_right, upwards = project_by_opencv(cam, points)
    np.testing.assert_allclose(on_axis, cam.K[:2, 2], atol=1e-9)
    assert to_the_right[0] > on_axis[0] + 10
    np.testing.assert_allclose(to_the_right[1], on_axis[1], atol=1e-9)
    assert upwards[1] < on_axis[1] - 10


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.2])
def test_the_field_of_view_does_not_depend_on_the_scale(scale):
    K, (width, height) = intrinsics(build(S02, scale=scale))
    assert (width, height) == (round(1920 * scale), round(1080 * scale))
    # The field of view reaches from the outer edge of the first pixel to the outer edge of the last pixel.
    for side, axis, fov_deg in ((width, 0, 92.45), (height, 1, 60.83)):
        edges = (np.array([-0.5, side - 0.5]) - K[axis, 2]) / K[axis, axis]
        np.testing.assert_allclose(np.degrees(np.arctan(edges)), [-fov_deg / 2, fov_deg / 2], atol=1e-9)


def test_written_poses_are_the_poses_of_the_rendered_frames(scene, tmp_path):
    path = tmp_path / onboard_pose_file(3)
    write_poses(path, *onboard_poses(scene, 2, 60))
    position_m, orientation_wxyz = read_poses(path)
    assert np.isnan(position_m[0]).all()
    renderer = OnboardRenderer(scene, 2)
    for frame in (1, 33, 59):
        cam = renderer.cam_at(scene.time_s(frame))
        # The text file holds sixteen digits.
        np.testing.assert_allclose(position_m[frame], -cam.R.T @ cam.t_m, atol=1e-12)
        to_world = Rotation.from_quat(orientation_wxyz[frame], scalar_first=True).as_matrix()
        np.testing.assert_allclose(to_world, cam.R.T, atol=1e-12)
    steps = np.abs(np.diff(orientation_wxyz[1:], axis=0)).max()
    assert steps < 0.1, "no quaternion changes its sign"


# --- the room


@pytest.mark.parametrize("drone", range(4))
@pytest.mark.parametrize("frame", [0, 90, 170])
def test_the_painted_room_agrees_with_a_depth_buffer(scene, drone, frame):
    """The painter draws surfaces from far to near without depth; the oracle is a depth buffer with full textures."""
    surfaces = scene.room.surfaces
    cam = OnboardRenderer(scene, drone).cam_at(scene.time_s(frame))
    painted = np.empty((cam.height, cam.width, 4), np.uint16)
    RoomPainter(surfaces).paint(raster.full_view(cam), painted)
    expected = backdrop.render_light(surfaces, cam, antialiasing=False)
    difference = np.abs(painted[..., :3] / LIGHT_UNIT - expected).max(axis=-1)
    # Pixels on an edge may differ because the depth buffer is float32 (measured at most 3.4e-4 of the pixels). The
    # painter's reduced textures also differ in fine structure and at the edges of markers.
    assert (difference > 0.2).mean() < 1e-3
    assert difference.mean() < 2e-3
    number, _ = backdrop.numbers_and_depth(surfaces, raster.full_view(cam))
    floor = painted[..., 3] > LIGHT_UNIT // 2
    assert (floor != (number == 0)).mean() < 2e-4


@pytest.mark.parametrize("hall", HALLS)
def test_a_hall_is_painted_from_far_to_near_wherever_the_eye_is(hall):
    surfaces = room(hall, True, 0.1).surfaces
    painter, rng = RoomPainter(surfaces), np.random.default_rng(0)
    ahead = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    for _ in range(20):
        eye_m = rng.uniform([-0.4, -0.4, 0.3], [0.4, 0.4, 0.9]) * HALLS[hall].size_m
        R = (
            ahead
            @ Rotation.from_euler("zyx", rng.uniform([0, -0.5, -0.5], [2 * np.pi, 0.5, 0.5])).as_matrix()
        )
        cam = raster.Pinhole(R, -R @ eye_m, np.array([[92.0, 0, 95.5], [0, 92, 53.5], [0, 0, 1]]), 192, 108)
        painted = np.empty((cam.height, cam.width, 4), np.uint16)
        painter.paint(raster.full_view(cam), painted)
        expected = backdrop.render_light(surfaces, cam, antialiasing=False)
        difference = np.abs(painted[..., :3] / LIGHT_UNIT - expected).max(axis=-1)
        wrong = cv2.morphologyEx((difference > 0.2).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2)))
        # Without single pixels on edges, where the reduced textures differ; measured at most 3.9e-4.
        assert wrong.mean() < 1e-3


def test_colours_agree_with_a_fixed_camera_at_the_same_pose(scene):
    """The renderer of fixed cameras draws the same room from the same pose, with the same sensor."""
    renderer = OnboardRenderer(scene_with_onboard_camera(scene, turning_flight(MIDDLE)), 0)
    imaging = msgspec.structs.replace(scene.scenario.imaging, reflections=0.0)
    still = backdrop.render(scene.room, renderer.cam_at(0.0), imaging)
    difference = renderer.clean_frame(0).astype(float) - sensor.develop(still.light)
    # The two renderers sample edges differently; colours agree to one grey level.
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.5
    assert np.median(np.abs(difference)) <= 1.0


# --- markers


@pytest.mark.parametrize("drone", [0, 3])
@pytest.mark.slow
def test_markers_in_onboard_frames_are_detected_at_their_projection(full_size, tmp_path, drone):
    """Frames have full size, optics, motion blur and noise; the pose is read from its file, and OpenCV projects."""
    path = tmp_path / onboard_pose_file(drone + 1)
    write_poses(path, *onboard_poses(full_size, drone, 101))
    position_m, orientation_wxyz = read_poses(path)
    K, (width, height) = intrinsics(full_size)
    R = Rotation.from_quat(orientation_wxyz[100], scalar_first=True).as_matrix().T
    cam = raster.Pinhole(R, -R @ position_m[100], K, width, height)
    found = detect_aruco(OnboardRenderer(full_size, drone).frame(100))
    assert len(found) >= 4
    check_corners(found, cam, full_size.room.marker_corners_m)


@pytest.mark.slow
def test_markers_in_frames_of_a_wall_camera_are_detected_at_their_projection(full_size):
    renderer = CameraRenderer(full_size, 0)
    found = detect_aruco(renderer.frame(0))
    assert len(found) >= 8
    check_corners(found, renderer.cam, full_size.room.marker_corners_m)


def check_corners(found, cam, marker_corners_m):
    errors = np.stack(
        [corners - project_by_opencv(cam, marker_corners_m[marker]) for marker, corners in found.items()]
    )
    distance = np.linalg.norm(errors, axis=-1)
    # OpenCV finds the corners of a black square 0.2 px inside the square even in linear light without blur. Gamma
    # spreads white over black and adds another 0.2 px (measured mean 0.41 px).
    assert distance.mean() < 0.5
    # A common shift of all corners would be an error of the simulator; the mean of at least 16 corners has a standard
    # error of 0.1 px (measured shift 0.03 px).
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.12
    # Partly hidden corners, and corners where OpenCV's refinement fails, have larger errors (measured 1 in 80 above
    # 1.2 px).
    assert np.mean(distance < 1.2) > 0.9


# --- other drones


@pytest.mark.parametrize("velocity_m_s", [(0.0, 0.0, 0.0), (0.5, -2.0, 1.0)])
@pytest.mark.parametrize("speed_rad_s", [0.0, 0.8])
def test_a_drone_is_seen_at_its_projection(scene, velocity_m_s, speed_rad_s):
    """Motion blur is centred on the projection, for still and moving drones and for still and turning cameras."""
    position_m = np.array([1.2, 0.5, 1.7])
    camera_flight = turning_flight(MIDDLE, speed_rad_s)
    settings = {"shutter_s": 1 / 100}
    renderer = OnboardRenderer(
        scene_with_onboard_camera(
            scene, camera_flight, (0.25, straight_flight(position_m, velocity_m_s)), **settings
        ),
        0,
    )
    empty = OnboardRenderer(scene_with_onboard_camera(scene, camera_flight, **settings), 0)
    found, _ = mean_and_variance(covered_share(renderer, empty))
    corners = (
        np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * 0.125 @ TILT.T + position_m
    )
    hull = cv2.moments(
        cv2.convexHull((64 * project_by_opencv(renderer.cam_at(0.0), corners)).round().astype(np.int32))
    )
    expected = np.array([hull["m10"], hull["m01"]]) / hull["m00"] / 64
    # The tolerance covers 4 samples per pixel over an edge of about 100 pixels, and rounding to 8 bits.
    np.testing.assert_allclose(found, expected, atol=0.15)


def test_without_antialiasing_a_pixel_shows_the_drone_or_the_room(scene):
    hard = msgspec.structs.replace(scene.scenario.imaging, antialiasing=False, lens_blur_px=0.0)
    sharp = replace(scene, scenario=msgspec.structs.replace(scene.scenario, imaging=hard))
    cubes = (0.3, straight_flight((1.2, 0.5, 1.7)))
    frame, room = (
        OnboardRenderer(
            scene_with_onboard_camera(sharp, turning_flight(MIDDLE), *placed, shutter_s=1e-9), 0
        ).clean_frame(0)
        for placed in ([cubes], [])
    )
    changed = (frame != room).any(axis=-1)
    assert changed.sum() > 200
    assert not frame[changed].any()


def test_a_pillar_hides_a_drone_behind_it(scene):
    pillar = np.array([1.81, -2.89])  # 0.22 m square
    eye = (0.0, -2.89, 1.4)
    for x, seen in ((2.6, False), (1.2, True)):
        assert (x < pillar[0]) == seen
        cubes = (0.1, straight_flight((x, pillar[1], 1.45)))
        renderer = OnboardRenderer(scene_with_onboard_camera(scene, turning_flight(eye), cubes), 0)
        empty = OnboardRenderer(scene_with_onboard_camera(scene, turning_flight(eye)), 0)
        assert (covered_share(renderer, empty).max() > 0.5) == seen


def test_drones_cast_shadows_on_the_visible_floor(scene):
    position_m = np.array([1.0, 0.3, 0.25])
    plain = scene_with_onboard_camera(
        scene, turning_flight(MIDDLE), (0.3, straight_flight(position_m)), pitch_deg=-20.0
    )
    imaging = scene.scenario.imaging
    assert imaging.shadows
    shaded = replace(plain, scenario=msgspec.structs.replace(plain.scenario, imaging=imaging))
    without, with_them = OnboardRenderer(plain, 0), OnboardRenderer(shaded, 0)
    before, after = (
        sensor.undevelop(renderer.clean_frame(0)).sum(axis=-1) for renderer in (without, with_them)
    )
    gain = FloorLight(shaded).floor_gain(0.0)
    # Compare floor pixels only, away from the cube and its edges.
    clear = cv2.erode(before, np.ones((3, 3))) > 0.3
    compared = 0
    for shift in np.mgrid[-0.5:0.6:0.1, -0.5:0.6:0.1].reshape(2, -1).T:
        spot = np.array([*(position_m[:2] + shift), 0.0])
        x, y = project_by_opencv(with_them.cam_at(0.0), spot)[0].round().astype(int)
        row, column = int((4.0 - spot[1]) / 0.02), int((spot[0] + 5.0) / 0.02)
        if clear[y, x]:
            compared += 1
            # A pixel covers about 2 cm of the floor, across which soft shadows change by a few per cent.
            assert after[y, x] / before[y, x] == pytest.approx(gain[row, column], abs=0.06)
    assert compared > 50
    assert (after / np.maximum(before, 1e-3)).min() < 0.8
    number, _ = backdrop.numbers_and_depth(scene.room.surfaces, raster.full_view(with_them.cam_at(0.0)))
    near_floor = cv2.dilate((number == 0).astype(np.uint8), np.ones((3, 3))) > 0
    np.testing.assert_array_equal(after[~near_floor], before[~near_floor])


def test_near_drones_hide_far_ones(scene):
    near, far = (0.3, straight_flight((0.5, 0.3, 1.5))), (0.3, straight_flight((2.0, 0.35, 1.55)))
    both = OnboardRenderer(
        scene_with_onboard_camera(scene, turning_flight(MIDDLE), far, near), 0
    ).clean_frame(0)
    alone = OnboardRenderer(scene_with_onboard_camera(scene, turning_flight(MIDDLE), near), 0).clean_frame(0)
    np.testing.assert_array_equal(both, alone)


def test_the_drone_that_carries_the_camera_is_not_drawn(scene):
    with_own, without = (
        scene_with_onboard_camera(scene, turning_flight(MIDDLE)),
        scene_with_onboard_camera(scene, turning_flight(MIDDLE)),
    )
    large = replace(with_own, models=(cube(1.0),))
    np.testing.assert_array_equal(
        OnboardRenderer(large, 0).clean_frame(0), OnboardRenderer(without, 0).clean_frame(0)
    )


# --- motion blur


@pytest.mark.parametrize("speed_rad_s", [1.5, 3.0, -3.0])
def test_a_turning_camera_blurs_along_rows_by_its_rotation(scene, speed_rad_s):
    """A box blur of length L adds L^2 / 12 to the variance of the silhouette, along the blur only."""
    shutter_s = 1 / 50
    target_cube = (0.2, straight_flight((1.0, 0.3, 1.5)))
    spreads = []
    for speed in (0.0, speed_rad_s):
        settings = {"shutter_s": shutter_s, "position_m": (0.0, 0.0, 0.0)}
        renderer = OnboardRenderer(
            scene_with_onboard_camera(scene, turning_flight(MIDDLE, speed), target_cube, **settings), 0
        )
        empty = OnboardRenderer(
            scene_with_onboard_camera(scene, turning_flight(MIDDLE, speed), **settings), 0
        )
        spreads.append(mean_and_variance(covered_share(renderer, empty))[1])
    along, across = spreads[1] - spreads[0]
    length_px = abs(speed_rad_s) * shutter_s * renderer.K[0, 0]
    # N samples of a uniform motion have the variance L^2 / 12 (1 - 1 / N^2): with 5 samples 4 % less. With 4 samples
    # per pixel, the silhouette's own variance of 70 px^2 has an error of a few tenths (measured 0.2).
    assert along == pytest.approx(length_px**2 / 12, rel=0.1, abs=0.4)
    assert abs(across) < 0.4


def test_a_long_exposure_is_the_mean_of_short_exposures(scene):
    """The comparison is in linear light without lens blur, where an exposure is an integral over time."""
    shutter_s, parts = 1 / 40, 64
    plain = msgspec.structs.replace(scene.scenario.imaging, lens_blur_px=0.0)
    quiet = replace(scene, scenario=msgspec.structs.replace(scene.scenario, imaging=plain))
    flight = turning_flight(MIDDLE, 1.2)
    long = OnboardRenderer(scene_with_onboard_camera(quiet, flight, shutter_s=shutter_s), 0)
    short = OnboardRenderer(scene_with_onboard_camera(quiet, flight, shutter_s=1e-9), 0)
    painter = RoomPainter(scene.room.surfaces)
    total, light = np.zeros((long.height, long.width)), np.empty((long.height, long.width, 4), np.uint16)
    for part in range(parts):
        painter.paint(raster.full_view(short.cam_at(((part + 0.5) / parts - 0.5) * shutter_s)), light)
        total += light[..., 1].clip(0, 4 * LIGHT_UNIT) / LIGHT_UNIT
    expected = total / parts
    found = sensor.undevelop(long.clean_frame(0))[..., 1]
    dull = expected < 0.95  # light above full scale is clipped
    away = np.abs(found - expected)[dull]
    sharp = np.abs(sensor.undevelop(short.clean_frame(0))[..., 1] - expected)[dull]
    # 5 samples for 7 px of blur leave steps at strong edges; a sharp frame differs much more.
    assert away.mean() < 0.006
    assert away.mean() < 0.5 * sharp.mean()


# --- the sensor, and the order of frames


def test_frames_do_not_depend_on_the_order_of_rendering(scene):
    renderer, again = OnboardRenderer(scene, 1), OnboardRenderer(scene, 1)
    first, second = renderer.frame(3), renderer.frame(40)
    np.testing.assert_array_equal(again.frame(40), second)
    np.testing.assert_array_equal(again.frame(3), first)
    assert first.dtype == np.uint8
    assert (first != second).mean() > 0.5


def test_each_camera_has_its_own_noise(scene):
    noise = []
    for drone in (0, 1):
        renderer = OnboardRenderer(scene, drone)
        grey = np.full((renderer.height, renderer.width, 3), 120, np.uint8)
        noise.append(renderer.sensor.expose(grey, 5, 0.2).astype(float))
        noise[-1] -= noise[-1].mean()
    # With half a million partly correlated numbers, independent noise has a correlation below 0.01.
    assert abs((noise[0] * noise[1]).mean() / (noise[0].std() * noise[1].std())) < 0.02
