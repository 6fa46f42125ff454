"""On-board cameras, rolling shutters and lenses included, beside OpenCV, rays and a depth buffer."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from placed_drones import (
    BLACK,
    CORNERS_M,
    S02,
    centre_and_area,
    cube,
    find_markers,
    hidden_share,
    laboratory,
    mean_and_variance,
    opencv_pixels,
    straight_flight,
    with_drones,
    with_imaging,
)
from scipy.spatial.transform import Rotation

from psotrack.geometry import project
from psotrack.inside_out import choose_lens
from psotrack.recordings.datasets import onboard_pose_file, read_poses, write_poses
from psotrack.simulation import SimulationSettings, build, change_scenario, simulate
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.imaging import backdrop, raster, sensor
from psotrack.simulation.imaging.onboard import OnboardRenderer, intrinsics, lens, onboard_poses
from psotrack.simulation.imaging.painter import LIGHT_UNIT, RoomPainter
from psotrack.simulation.imaging.shadows import FloorLight
from psotrack.simulation.imaging.strips import strips
from psotrack.simulation.scenarios import OnboardCamera
from psotrack.simulation.world.halls import HALLS
from psotrack.simulation.world.rooms import room

TILT = Rotation.from_rotvec([0.4, 0.3, 0.5]).as_matrix()
#: Position of the on-board camera in the middle of the laboratory, looking along x, metres.
MIDDLE = (-1.0, 0.3, 1.5)


@pytest.fixture
def scene():
    return laboratory()


def tilted_cube(side_m, position_m, velocity_m_s=(0.0, 0.0, 0.0)):
    """A black cube for `seen_by` whose edges are not parallel to pixel rows or columns.

    An edge that is parallel to a row would enter or miss all samples of the row at once.
    """
    upright = cube(side_m)
    tilted = replace(upright, triangles_m=upright.triangles_m @ TILT.T)
    return tilted, straight_flight(position_m, velocity_m_s), BLACK


def turning_flight(position_m, speed_rad_s=0.0, yaw_rad=0.0):
    """Make a flight that hovers and turns; `speed_rad_s` is the yaw rate at time 0."""
    return straight_flight(position_m, heading=Heading(yaw_rad, speed_rad_s, 1.0, 0.0))


def seen_by(flight, *placed, imaging=S02.imaging, shadows=False, **onboard):
    """The renderer of a camera on a drone with this flight, in the laboratory without shadows and with other drones."""
    scene = with_imaging(laboratory(), imaging, shadows=shadows)
    recipe = msgspec.structs.replace(scene.scenario, onboard=OnboardCamera(**onboard))
    return OnboardRenderer(
        with_drones(replace(scene, scenario=recipe), (cube(0.2), flight, BLACK), *placed), 0
    )


def hidden(flight, *placed, **onboard):
    """The share of the room's light that black drones hide in frame 0, (height, width)."""
    return hidden_share(*(seen_by(flight, *each, **onboard).clean_frame(0) for each in (placed, ())))


# --- where the camera is


def test_the_camera_is_fixed_to_the_body_and_looks_forward():
    flight = turning_flight(MIDDLE, yaw_rad=0.7)
    cam = seen_by(flight, position_m=(0.1, 0.05, -0.02), pitch_deg=20.0).cam_at(0.0)
    # The drone does not accelerate and is level, so the body's axes are the world's axes, turned by the heading.
    ahead, left, up = Rotation.from_euler("z", 0.7).as_matrix().T
    centre = np.array(MIDDLE) + 0.1 * ahead + 0.05 * left - 0.02 * up
    np.testing.assert_allclose(-cam.R.T @ cam.t_m, centre, atol=1e-12)
    optical_axis = np.cos(np.radians(20)) * ahead + np.sin(np.radians(20)) * up
    points = centre + np.stack([optical_axis, optical_axis - 0.1 * left, optical_axis + 0.1 * up])
    on_axis, to_the_right, upwards = opencv_pixels(cam, points)
    np.testing.assert_allclose(on_axis, cam.K[:2, 2], atol=1e-9)
    assert to_the_right[0] > on_axis[0] + 10
    np.testing.assert_allclose(to_the_right[1], on_axis[1], atol=1e-9)
    assert upwards[1] < on_axis[1] - 10


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_the_field_of_view_does_not_depend_on_the_scale(scale):
    K, (width, height) = intrinsics(laboratory(scale))
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


@pytest.mark.parametrize("hall", HALLS)
def test_a_hall_is_painted_from_far_to_near_wherever_the_eye_is(hall):
    """The painter draws surfaces without depth; the oracle is a depth buffer with full textures."""
    surfaces = room(hall, True, 0.1).surfaces
    painter, rng = RoomPainter(surfaces), np.random.default_rng(0)
    ahead = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    for _ in range(5):
        eye_m = rng.uniform([-0.4, -0.4, 0.3], [0.4, 0.4, 0.9]) * HALLS[hall].size_m
        turn = Rotation.from_euler("zyx", rng.uniform([0, -0.5, -0.5], [2 * np.pi, 0.5, 0.5]))
        R = ahead @ turn.as_matrix()
        cam = raster.Pinhole(R, -R @ eye_m, np.array([[92.0, 0, 95.5], [0, 92, 53.5], [0, 0, 1]]), 192, 108)
        painted = np.empty((cam.height, cam.width, 4), np.uint16)
        painter.paint(raster.full_view(cam), painted)
        expected = backdrop.render_light(surfaces, cam, antialiasing=False)
        difference = np.abs(painted[..., :3] / LIGHT_UNIT - expected).max(axis=-1)
        wrong = (difference > 0.2).astype(np.uint8)
        # Without single pixels on edges, where the reduced textures differ; measured at most 3.9e-4.
        assert cv2.morphologyEx(wrong, cv2.MORPH_OPEN, np.ones((2, 2))).mean() < 1e-3
        number, _ = backdrop.numbers_and_depth(surfaces, raster.full_view(cam))
        floor = painted[..., 3] > LIGHT_UNIT // 2
        # Pixels on an edge may differ because the depth buffer is float32.
        assert (floor != (number == 0)).mean() < 2e-4


def test_colours_agree_with_a_fixed_camera_at_the_same_pose(scene):
    """The renderer of fixed cameras draws the same room from the same pose, with the same sensor."""
    renderer = seen_by(turning_flight(MIDDLE))
    imaging = msgspec.structs.replace(S02.imaging, reflections=0.0)
    still = backdrop.render(scene.room, renderer.cam_at(0.0), imaging)
    difference = renderer.clean_frame(0).astype(float) - sensor.develop(still.light)
    # The two renderers sample edges differently; colours agree to one grey level.
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.5
    assert np.median(np.abs(difference)) <= 1.0


# --- other drones


@pytest.mark.parametrize(
    ("speed_rad_s", "velocity_m_s"),
    [(0.0, (0.0, 0.0, 0.0)), (0.0, (0.5, -2.0, 1.0)), (0.8, (0.5, -2.0, 1.0))],
)
def test_a_drone_is_seen_at_its_projection(speed_rad_s, velocity_m_s):
    """Motion blur is centred on the projection, for still and moving drones and for still and turning cameras."""
    position_m, flight = np.array([1.2, 0.5, 1.7]), turning_flight(MIDDLE, speed_rad_s)
    share = hidden(flight, tilted_cube(0.25, position_m, velocity_m_s), shutter_s=1 / 100)
    cam = seen_by(flight).cam_at(0.0)
    expected, _ = centre_and_area(opencv_pixels(cam, 0.25 * CORNERS_M @ TILT.T + position_m))
    # The tolerance covers 4 samples per pixel over an edge of about 100 pixels, and rounding to 8 bits.
    np.testing.assert_allclose(mean_and_variance(share)[0], expected, atol=0.15)


def test_without_antialiasing_a_pixel_shows_the_drone_or_the_room():
    imaging = msgspec.structs.replace(S02.imaging, antialiasing=False, lens_blur_px=0.0)
    frame, empty = (
        seen_by(turning_flight(MIDDLE), *placed, imaging=imaging, shutter_s=1e-9).clean_frame(0)
        for placed in ([tilted_cube(0.3, (1.2, 0.5, 1.7))], [])
    )
    changed = (frame != empty).any(axis=-1)
    assert changed.sum() > 200
    assert not frame[changed].any()


def test_pillars_and_near_drones_hide_far_drones_and_the_carrier_is_not_drawn():
    # A pillar of 0.22 m is at (1.81, -2.89).
    for x, seen in ((2.6, False), (1.2, True)):
        share = hidden(turning_flight((0.0, -2.89, 1.4)), tilted_cube(0.1, (x, -2.89, 1.45)))
        assert (share.max() > 0.5) == seen
    near, far = tilted_cube(0.3, (0.5, 0.3, 1.5)), tilted_cube(0.3, (2.0, 0.35, 1.55))
    alone = seen_by(turning_flight(MIDDLE), near)
    both = seen_by(turning_flight(MIDDLE), far, near)
    np.testing.assert_array_equal(both.clean_frame(0), alone.clean_frame(0))
    large = replace(alone.scene, models=(cube(1.0), *alone.scene.models[1:]))
    np.testing.assert_array_equal(OnboardRenderer(large, 0).clean_frame(0), alone.clean_frame(0))


def test_drones_cast_shadows_on_the_visible_floor(scene):
    position_m = np.array([1.0, 0.3, 0.25])
    plain, shaded = (
        seen_by(turning_flight(MIDDLE), tilted_cube(0.3, position_m), shadows=shadows, pitch_deg=-20.0)
        for shadows in (False, True)
    )
    before, after = (sensor.undevelop(each.clean_frame(0)).sum(axis=-1) for each in (plain, shaded))
    cam, gain = shaded.cam_at(0.0), FloorLight(shaded.scene).floor_gain(0.0)
    # Compare floor pixels only, away from the cube and its edges.
    clear = cv2.erode(before, np.ones((3, 3))) > 0.3
    compared = 0
    for shift in np.mgrid[-0.5:0.6:0.1, -0.5:0.6:0.1].reshape(2, -1).T:
        spot = np.array([*(position_m[:2] + shift), 0.0])
        x, y = opencv_pixels(cam, spot)[0].round().astype(int)
        row, column = int((4.0 - spot[1]) / 0.02), int((spot[0] + 5.0) / 0.02)
        if clear[y, x]:
            compared += 1
            # A pixel covers about 2 cm of the floor, across which soft shadows change by a few per cent.
            assert after[y, x] / before[y, x] == pytest.approx(gain[row, column], abs=0.06)
    assert compared > 50
    assert (after / np.maximum(before, 1e-3)).min() < 0.8
    number, _ = backdrop.numbers_and_depth(scene.room.surfaces, raster.full_view(cam))
    near_floor = cv2.dilate((number == 0).astype(np.uint8), np.ones((3, 3))) > 0
    np.testing.assert_array_equal(after[~near_floor], before[~near_floor])


# --- time: motion blur, rolling shutter, exposure, noise


def test_a_turning_camera_blurs_along_rows_by_its_rotation():
    """A box blur of length L adds L^2 / 12 to the variance of the silhouette, along the blur only."""
    shutter_s, speed_rad_s, target = 1 / 50, -3.0, tilted_cube(0.2, (1.0, 0.3, 1.5))
    still, turning = (
        mean_and_variance(
            hidden(turning_flight(MIDDLE, speed), target, shutter_s=shutter_s, position_m=(0.0, 0.0, 0.0))
        )[1]
        for speed in (0.0, speed_rad_s)
    )
    along, across = turning - still
    length_px = abs(speed_rad_s) * shutter_s * intrinsics(laboratory())[0][0, 0]
    # N samples of a uniform motion have the variance L^2 / 12 (1 - 1 / N^2): with 5 samples 4 % less. With 4 samples
    # per pixel, the silhouette's own variance of 70 px^2 has an error of a few tenths (measured 0.2).
    assert along == pytest.approx(length_px**2 / 12, rel=0.1, abs=0.4)
    assert abs(across) < 0.4


def test_frames_do_not_depend_on_the_order_and_each_camera_has_its_own_noise(scene):
    renderer, again = OnboardRenderer(scene, 1), OnboardRenderer(scene, 1)
    first, second = renderer.frame(3), renderer.frame(40)
    np.testing.assert_array_equal(again.frame(40), second)
    np.testing.assert_array_equal(again.frame(3), first)
    assert first.dtype == np.uint8
    assert (first != second).mean() > 0.5
    grey = np.full((renderer.height, renderer.width, 3), 120, np.uint8)
    shown = (each.sensor.expose(grey, 5, 0.2) for each in (renderer, OnboardRenderer(scene, 0)))
    a, b = (each - each.mean() for each in shown)
    # With half a million partly correlated numbers, independent noise has a correlation below 0.01.
    assert abs((a * b).mean() / (a.std() * b.std())) < 0.02


SIZE_WH = (640, 360)
FOV_DEG = (92.45, 60.83)


def made(scale=0.5, **onboard):
    """A scene without shadows and noise whose drones carry cameras of 640 x 360 pixels."""
    size_wh = tuple(round(side / scale) for side in SIZE_WH)
    quiet = {"shadows": False, "read_noise": 0.0, "shot_noise": 0.0, "antialiasing": False}
    fields = {"image_size_wh": size_wh, "fov_deg": FOV_DEG, "shutter_s": 1 / 10_000, "pitch_deg": 10.0}
    imaging, camera = msgspec.structs.replace(S02.imaging, **quiet), OnboardCamera(**{**fields, **onboard})
    return build(msgspec.structs.replace(S02, imaging=imaging, onboard=camera), scale=scale, seed=1)


@pytest.mark.parametrize(("height", "motion_px"), [(360, 0.01), (361, 0.3), (17, 5.0), (360, 0.0)])
def test_strips_cover_each_row_once_and_its_time_on_average(height, motion_px):
    rows = np.arange(height)
    times = np.zeros(height)
    for sample in range(8):
        covered = np.zeros(height, int)
        for strip in strips(height, motion_px, sample, 8):
            covered[strip.rows] += 1
            times[strip.rows] += strip.middle / 8
        np.testing.assert_array_equal(covered, 1)
    if motion_px:
        # The samples' strips begin at different rows, up to the rounding to whole rows.
        assert np.abs(times - rows).max() <= 0.5 + max(0.5 / motion_px, 4) / 16


def test_each_row_is_what_a_global_shutter_shows_at_its_time():
    line_time_s, frame = 0.03 / SIZE_WH[1], 40
    fixed = made()

    def shown(scene):
        return OnboardRenderer(scene, 0).clean_frame(frame).astype(float)

    # At half the size, a row of the image stands for two rows of the camera.
    rolled, still = shown(made(line_time_s=line_time_s / 2)), shown(fixed)
    for row in (0, 359):
        moment = shown(replace(fixed, start_s=line_time_s * (row - (SIZE_WH[1] - 1) / 2)))
        # Motion within a strip is at most half a pixel; at edges of markers a grey level may differ.
        assert np.abs(rolled[row] - moment[row]).mean() < 2.0
        assert np.abs(rolled[row] - moment[row]).mean() < 0.3 * np.abs(rolled[row] - still[row]).mean()
    # Half way down, both are exposed at the time of the frame.
    assert np.abs(rolled[180] - still[180]).mean() < 1.0


@pytest.mark.slow
def test_markers_of_a_distorting_lens_are_detected_at_their_projection():
    """OpenCV detects and OpenCV projects."""
    distortion = np.array([-0.1, 0.03, 0.0005, -0.0004])
    scene = made(1.0, distortion=tuple(distortion), image_size_wh=(1280, 720))
    renderer = OnboardRenderer(scene, 0)
    found = find_markers(cv2.cvtColor(renderer.frame(40), cv2.COLOR_BGR2GRAY))
    assert len(found) >= 4
    cam = renderer.cam_at(scene.time_s(40))
    off_px, straight_px = (
        np.array(
            [
                corners - opencv_pixels(cam, scene.room.marker_corners_m[marker], dist)
                for marker, corners in found.items()
            ]
        )
        for dist in (distortion, None)
    )
    # Measured 0.3 px, by OpenCV's refinement of corners, which moves each corner inwards; without the distortion tens
    # of pixels.
    assert np.median(np.linalg.norm(off_px, axis=-1)) < 0.7
    assert np.abs(straight_px).max() > 20
    # A common shift of all corners would be an error of the simulator (measured 0.08 px): the mean of at least 16
    # corners has a standard error of 0.1 px.
    assert np.abs(off_px.mean(axis=(0, 1))).max() < 0.15
    # The lens of the package is the same.
    points_m = scene.room.marker_corners_m[next(iter(found))]
    own = project(lens(scene), points_m @ cam.R.T + cam.t_m)[0]
    np.testing.assert_allclose(own, opencv_pixels(cam, points_m, distortion), atol=1e-3)


def test_the_exposure_swings_between_its_limits():
    renderer = OnboardRenderer(made(exposure=(0.3, 2.0), exposure_period_s=2.0), 0)
    times_s = np.linspace(0, 2, 400)
    factors = np.array([renderer.sensor.exposure(time_s) for time_s in times_s])
    assert factors.min() == pytest.approx(0.3, rel=1e-3)
    assert factors.max() == pytest.approx(2.0, rel=1e-3)
    assert OnboardRenderer(made(), 0).sensor.exposure(0.7) == 1.0


def test_a_simulated_sequence_with_distortion_has_the_lens_of_each_drone(tmp_path):
    camera = {"image_size_wh": list(SIZE_WH), "fov_deg": list(FOV_DEG), "distortion": [-0.1, 0.03, 0.0, 0.0]}
    changes = {"onboard": camera, "image_size_wh": [320, 320], "cameras": "laboratory_corners"}
    settings = SimulationSettings(num_frames=2, scale=0.1)
    folder = simulate(change_scenario(S02, changes), tmp_path, settings, jobs=1)
    lenses = folder / "drone_cameras.toml"
    found = choose_lens((64, 36), path=lenses, fov_deg=None, name="dron1", scale=False)
    np.testing.assert_allclose(found.dist[:4], camera["distortion"])
    # The table without distortion is absent, so that no command takes the lens for ideal.
    assert not (folder / "drone_cameras_calibration.csv").exists()
