"""What fixed and on-board cameras show, lenses and rolling shutters included.

The oracles are projections by OpenCV and a depth buffer.
"""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from helpers import opencv_pixels as projected_by_opencv
from helpers import posed, project_points, simple_lens
from placed_drones import (
    BLACK,
    CORNERS_M,
    PLAIN,
    S02,
    assert_drawn_at,
    centre_and_area,
    cube,
    find_markers,
    hidden_by_drones,
    hidden_share,
    hovering,
    laboratory,
    mean_and_variance,
    number_image,
    opencv_pixels,
    ray_point,
    straight_flight,
    with_drones,
    with_imaging,
)
from scipy.spatial.transform import Rotation

from psotrack.geometry import make_rig, project, undistort
from psotrack.inside_out import choose_lens
from psotrack.recordings.datasets import onboard_pose_file, open_recording, read_poses, write_poses
from psotrack.simulation import CameraRenderer, SimulationSettings, build, change_scenario, simulate
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.imaging import backdrop, raster, sensor
from psotrack.simulation.imaging.backdrop import LIGHT_UNIT, RoomPainter
from psotrack.simulation.imaging.floor import FloorLight
from psotrack.simulation.imaging.renderer import OnboardRenderer, intrinsics, lens, onboard_poses
from psotrack.simulation.labels import lens_silhouettes
from psotrack.simulation.scenarios import OnboardCamera
from psotrack.simulation.world.rooms import HALLS, room


@pytest.fixture
def scene():
    return laboratory()


# --- the room


def test_markers_are_detected_at_their_projection():
    scene = laboratory(0.6)
    # The image is in linear light, because gamma spreads white over black and moves each corner inwards by 0.2 px.
    light = CameraRenderer(scene, 0).views[0].backdrop.light
    found = find_markers(np.clip(250 * light, 0, 255).astype(np.uint8))
    corners_m = scene.room.marker_corners_m
    assert set(found) <= set(corners_m)
    assert len(found) >= 6
    errors = []
    for marker, corners in found.items():
        expected, _ = project(scene.rig.cameras[0], corners_m[marker])
        errors.append(corners - expected)
    # OpenCV finds the corners of a blurred black square 0.2 to 0.4 px inside the square (measured median 0.40 px). A
    # common shift of all corners would be an error of the renderer; the mean of 60 corners has a standard error of
    # 0.05 px (measured shift 0.07 px).
    assert np.median(np.linalg.norm(errors, axis=-1)) < 0.5
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.15


# --- drones in frames


@pytest.mark.parametrize("velocity_m_s", [(0.0, 0.0, 0.0), (1.0, -2.0, 1.0)])
@pytest.mark.parametrize("index", [0, 6])
def test_a_drone_of_known_centre_is_drawn_at_its_projection(scene, index, velocity_m_s):
    """Frames before encoding have no shift; the blur of a moving drone is centred on the projection."""
    centre = np.array([0.3, -0.2, 1.45])
    flight = straight_flight(centre, velocity_m_s)
    share = hidden_by_drones(with_drones(scene, (cube(0.3), flight, BLACK)), index)
    corners, _ = project(scene.rig.cameras[index], 0.3 * CORNERS_M + centre)
    # Rounding to 8 bits, and 8 samples per pixel over an edge of about 60 pixels, give errors of a few hundredths. The
    # area agrees within the uncertainty of the edge, so edge pixels are covered partly.
    assert_drawn_at(share, corners, atol_px=0.08, area_rel=0.05)


def test_a_pillar_hides_a_drone_behind_it(scene):
    pillar = np.array([-1.975, 2.875, 1.4])
    pixel, depth_m = project(scene.rig.cameras[3], pillar)
    x, y = pixel.astype(int)
    for behind_m, visible in ((0.8, False), (-0.8, True)):
        place_m = ray_point(scene, 3, pixel, depth_m + behind_m)
        hidden = with_drones(scene, hovering(cube(0.1), place_m))
        assert number_image(CameraRenderer(hidden, 3)).any() == visible
        assert (hidden_by_drones(hidden, 3)[y, x] > 0.5) == visible


def test_rotors_dim_the_background_in_either_order_and_walls_hide_rotors(scene):
    rotor = replace(cube(0.02), rotor_radii_m=np.array([0.3]))

    def hidden_beside_the_hub(*depths_m):
        places_m = [ray_point(scene, 0, (240.0, 150.0), depth_m) for depth_m in depths_m]
        rotors = [hovering(rotor, place_m) for place_m in places_m]
        return hidden_by_drones(with_drones(scene, *rotors))[150, 252]

    near = hidden_beside_the_hub(3.5)
    far = hidden_beside_the_hub(6.0)
    assert 0.1 < near < 0.6
    both = hidden_beside_the_hub(3.5, 6.0)
    assert max(near, far) + 0.05 < both < near + far
    assert hidden_beside_the_hub(6.0, 3.5) == both
    assert hidden_beside_the_hub(30.0) == 0.0, "the rotor is behind the wall"


# --- lenses with distortion


#: Sizes of the images of fixed and of on-board cameras, and the angles of view of the latter.
SIZE_WH, ONBOARD_WH, FOV_DEG = (480, 270), (640, 360), (92.45, 60.83)
PRISM = (-0.28, 0.11, 0.0007, -0.0011, -0.02, 0.02, -0.01, 0.003, 0.0011, -0.0004, -0.0008, 0.0003)
#: Focal length in pixels, coefficients, and whether the lens is a fisheye.
LENSES = {
    "5": (270.0, (0.21, -0.02, -0.0004, 0.0009, 0.03), False),
    "8": (230.0, (0.3, 0.05, 0.0004, -0.0002, 0.01, 0.6, 0.2, 0.02), False),
    "14": (270.0, (*PRISM, 0.06, -0.04), False),
    "fisheye": (200.0, (-0.012, 0.021, -0.018, 0.004), True),
}


def with_lens(name):
    """A scene without blur, motion and shadows, with one camera in the middle of the room that has a lens."""
    focal_px, dist, fisheye = LENSES[name]
    K = np.array([[focal_px, 3.0, 236.0], [0.0, 1.02 * focal_px, 137.0], [0.0, 0.0, 1.0]])
    lens = replace(simple_lens(focal_px, SIZE_WH, dist, fisheye=fisheye), K=K)
    rig = make_rig({"cam1": posed(lens, (0.3, -1.5, 1.6), (0.0, 3.0, 1.3))})
    return replace(with_imaging(laboratory(), PLAIN), rig=rig)


def lens_pixels(lens, points_m):
    """Pixels of points by OpenCV, which has no skew: the skew is added to normalised coordinates."""
    flat = projected_by_opencv(replace(lens, K=np.eye(3)), points_m)
    return flat @ lens.K[:2, :2].T + lens.K[:2, 2]


@pytest.mark.parametrize("name", LENSES)
def test_small_drones_are_drawn_where_opencv_projects_them(name):
    scene = with_lens(name)
    lens = scene.rig.cameras[0]
    T = lens.T_cam_world
    # In the middle, near the left border and near a corner.
    pixels = np.array([[240.0, 130.0], [25.0, 140.0], [450.0, 240.0]])
    rays = np.column_stack([undistort(lens, pixels), np.ones(3)])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    places_m = (1.5 * rays - T[:3, 3]) @ T[:3, :3]
    scene = with_drones(scene, *(hovering(cube(0.06), place_m) for place_m in places_m))
    renderer = CameraRenderer(scene, 0)
    views = renderer.views
    if name == "fisheye":
        assert (renderer.lens.face >= 0).all(), "the picture has no holes"
    empty = renderer.lens.assemble([sensor.develop(view.backdrop.light) for view in views])
    share = hidden_share(renderer.clean_frame(0), empty)
    depths_m = [view.backdrop.depth_m for view in views]
    masks = lens_silhouettes(scene, renderer.cam, renderer.lens, depths_m, 0)
    for place_m, silhouette in zip(places_m, masks, strict=True):
        corners = lens_pixels(lens, place_m + 0.06 * CORNERS_M)
        # The cube's edges are straight over so short a distance. The cubes are 6 to 25 px wide. Interpolation, 8 bits
        # and 8 samples per pixel cost a tenth of a pixel.
        window = assert_drawn_at(share, corners, atol_px=0.15, area_rel=0.08)
        # The mask of the drone is where the drone is drawn; they differ by a part of the pixels at the edge.
        mask = silhouette.mask()[window]
        drawn = share[window] > 0.5
        assert (mask != drawn).sum() <= 0.2 * mask.sum()
        assert silhouette.seen_share > 0.9


def test_a_simulated_sequence_of_any_lenses_is_a_recording(tmp_path):
    """The dataset's tables cannot hold these lenses; the recording has them, and a file has those of the drones."""
    fisheye = {"position_m": (3.0, -2.5, 2.6), "distortion": (-0.01, 0.02, 0.0, 0.0), "fisheye": True}
    prism = {"position_m": (-3.0, -2.5, 2.6), "distortion": PRISM, "aspect": 1.01, "skew_px": 2.0}
    for camera in (fisheye, prism):
        camera |= {"target_m": (0.0, 0.0, 1.2), "focal_length_px": 800.0}
    onboard = {"image_size_wh": ONBOARD_WH, "fov_deg": FOV_DEG, "distortion": (-0.1, 0.03, 0.0, 0.0)}
    recipe = change_scenario(S02, {"cameras": [fisheye, prism], "onboard": onboard})
    folder = simulate(recipe, tmp_path, SimulationSettings(num_frames=2, scale=0.1, masks=False), jobs=1)
    found = open_recording(folder).rig
    expected = build(recipe, scale=0.1).rig
    assert found.names == expected.names == ("cam1", "cam2")
    assert found.cameras.fisheye.tolist() == [True, False]
    points_m = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 2), (9, 3))
    shown, true = project_points(found, points_m), project_points(expected, points_m)
    np.testing.assert_allclose(shown, true, atol=1e-6)
    lenses = folder / "drone_cameras.toml"
    on_drone = choose_lens((64, 36), path=lenses, fov_deg=None, name="dron1", scale=False)
    np.testing.assert_allclose(on_drone.dist[:4], onboard["distortion"])
    # The table without distortion is absent, so that no command takes the lens for ideal.
    assert not (folder / "drone_cameras_calibration.csv").exists()


# --- on-board cameras: where the camera is


TILT = Rotation.from_rotvec([0.4, 0.3, 0.5]).as_matrix()
#: Position of the on-board camera in the middle of the laboratory, looking along x, metres.
MIDDLE = (-1.0, 0.3, 1.5)


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
    carrier = (cube(0.2), flight, BLACK)
    return OnboardRenderer(with_drones(replace(scene, scenario=recipe), carrier, *placed), 0)


def hidden(flight, *placed, **onboard):
    """The share of the room's light that black drones hide in frame 0, (height, width)."""
    shown = seen_by(flight, *placed, **onboard).clean_frame(0)
    empty = seen_by(flight, **onboard).clean_frame(0)
    return hidden_share(shown, empty)


def test_the_camera_is_fixed_to_the_body_and_looks_forward():
    flight = turning_flight(MIDDLE, yaw_rad=0.7)
    cam = seen_by(flight, position_m=(0.1, 0.05, -0.02), pitch_deg=20.0).cam_at(0.0)
    # The drone does not accelerate and is level, so the body's axes are the world's axes, turned by the heading.
    ahead, left, up = Rotation.from_euler("z", 0.7).as_matrix().T
    centre = np.array(MIDDLE) + 0.1 * ahead + 0.05 * left - 0.02 * up
    optical_axis = np.cos(np.radians(20)) * ahead + np.sin(np.radians(20)) * up
    np.testing.assert_allclose(cam.R, [-left, np.cross(optical_axis, -left), optical_axis], atol=1e-12)
    np.testing.assert_allclose(-cam.R.T @ cam.t_m, centre, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_the_field_of_view_does_not_depend_on_the_scale(scale):
    K, size_wh = intrinsics(laboratory(scale))
    assert tuple(size_wh) == (round(1920 * scale), round(1080 * scale))
    # The field of view reaches from the outer edge of the first pixel to the outer edge of the last pixel.
    for axis, fov_deg in enumerate((92.45, 60.83)):
        edges_px = np.array([-0.5, size_wh[axis] - 0.5])
        angles_rad = np.arctan((edges_px - K[axis, 2]) / K[axis, axis])
        np.testing.assert_allclose(np.degrees(angles_rad), [-fov_deg / 2, fov_deg / 2], atol=1e-9)


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


# --- on board: the room


@pytest.mark.parametrize("hall", HALLS)
def test_a_hall_is_painted_from_far_to_near_wherever_the_eye_is(hall):
    """The painter draws surfaces without depth; the oracle is a depth buffer with full textures."""
    surfaces = room(hall, True, 0.1).surfaces
    painter, rng = RoomPainter(surfaces), np.random.default_rng(0)
    K = np.array([[92.0, 0, 95.5], [0, 92, 53.5], [0, 0, 1]])
    ahead = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    for _ in range(5):
        eye_m = rng.uniform([-0.4, -0.4, 0.3], [0.4, 0.4, 0.9]) * HALLS[hall].size_m
        angles_rad = rng.uniform([0, -0.5, -0.5], [2 * np.pi, 0.5, 0.5])
        R = ahead @ Rotation.from_euler("zyx", angles_rad).as_matrix()
        cam = raster.Pinhole(R, -R @ eye_m, K, 192, 108)
        view = raster.full_view(cam)
        painted = np.empty((cam.height, cam.width, 4), np.uint16)
        painter.paint(view, painted)
        expected = backdrop.render_light(surfaces, cam, antialiasing=False)
        difference = np.abs(painted[..., :3] / LIGHT_UNIT - expected).max(axis=-1)
        wrong = (difference > 0.2).astype(np.uint8)
        # Without single pixels on edges, where the reduced textures differ; measured at most 3.9e-4.
        patches = cv2.morphologyEx(wrong, cv2.MORPH_OPEN, np.ones((2, 2)))
        assert patches.mean() < 1e-3
        number, _ = backdrop.numbers_and_depth(surfaces, view)
        floor = painted[..., 3] > LIGHT_UNIT // 2
        # Pixels on an edge may differ because the depth buffer is float32.
        assert (floor != (number == 0)).mean() < 2e-4


def test_colours_agree_with_a_fixed_camera_at_the_same_pose(scene):
    """The renderer of fixed cameras draws the same room from the same pose, with the same sensor."""
    renderer = seen_by(turning_flight(MIDDLE), imaging=PLAIN)
    still = backdrop.render(scene.room, renderer.cam_at(0.0), PLAIN)
    difference = renderer.clean_frame(0).astype(float) - sensor.develop(still.light)
    # The two renderers sample edges differently; colours agree to one grey level.
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.5
    assert np.median(np.abs(difference)) <= 1.0


# --- on board: other drones


@pytest.mark.parametrize(
    ("speed_rad_s", "velocity_m_s"),
    [(0.0, (0.0, 0.0, 0.0)), (0.0, (0.5, -2.0, 1.0)), (0.8, (0.5, -2.0, 1.0))],
)
def test_a_drone_is_seen_at_its_projection(speed_rad_s, velocity_m_s):
    """Motion blur is centred on the projection, for still and moving drones and for still and turning cameras."""
    position_m = np.array([1.2, 0.5, 1.7])
    flight = turning_flight(MIDDLE, speed_rad_s)
    share = hidden(flight, tilted_cube(0.25, position_m, velocity_m_s), shutter_s=1 / 100)
    corners_m = 0.25 * CORNERS_M @ TILT.T + position_m
    expected, _ = centre_and_area(opencv_pixels(seen_by(flight).cam_at(0.0), corners_m))
    middle, _ = mean_and_variance(share)
    # The tolerance covers 4 samples per pixel over an edge of about 100 pixels, and rounding to 8 bits.
    np.testing.assert_allclose(middle, expected, atol=0.15)


def test_pillars_and_near_drones_hide_far_drones_and_the_carrier_is_not_drawn():
    # A pillar of 0.22 m is at (1.81, -2.89).
    beside_it = turning_flight((0.0, -2.89, 1.4))
    behind = hidden(beside_it, tilted_cube(0.1, (2.6, -2.89, 1.45)))
    assert behind.max() < 0.5
    in_front = hidden(beside_it, tilted_cube(0.1, (1.2, -2.89, 1.45)))
    assert in_front.max() > 0.5
    near = tilted_cube(0.3, (0.5, 0.3, 1.5))
    far = tilted_cube(0.3, (2.0, 0.35, 1.55))
    alone = seen_by(turning_flight(MIDDLE), near)
    expected = alone.clean_frame(0)
    both = seen_by(turning_flight(MIDDLE), far, near)
    np.testing.assert_array_equal(both.clean_frame(0), expected)
    large_carrier = replace(alone.scene, models=(cube(1.0), *alone.scene.models[1:]))
    np.testing.assert_array_equal(OnboardRenderer(large_carrier, 0).clean_frame(0), expected)


def test_drones_cast_shadows_on_the_visible_floor(scene):
    position_m = np.array([1.0, 0.3, 0.25])
    light = {}
    for shadows in (False, True):
        target = tilted_cube(0.3, position_m)
        renderer = seen_by(turning_flight(MIDDLE), target, shadows=shadows, pitch_deg=-20.0)
        light[shadows] = sensor.undevelop(renderer.clean_frame(0)).sum(axis=-1)
    cam = renderer.cam_at(0.0)
    gain = FloorLight(renderer.scene).floor_gain(0.0)
    # Compare floor pixels only, away from the cube and its edges.
    clear = cv2.erode(light[False], np.ones((3, 3))) > 0.3
    ratios, expected = [], []
    for x_m in np.arange(0.5, 1.6, 0.1):
        for y_m in np.arange(-0.2, 0.9, 0.1):
            column, row = opencv_pixels(cam, [x_m, y_m, 0.0])[0].round().astype(int)
            if clear[row, column]:
                ratios.append(light[True][row, column] / light[False][row, column])
                expected.append(gain[int((4.0 - y_m) / 0.02), int((x_m + 5.0) / 0.02)])
    assert len(ratios) > 50
    assert min(expected) < 0.8
    # A pixel covers about 2 cm of the floor, across which soft shadows change by a few per cent.
    np.testing.assert_allclose(ratios, expected, rtol=0, atol=0.06)
    number, _ = backdrop.numbers_and_depth(scene.room.surfaces, raster.full_view(cam))
    near_floor = cv2.dilate((number == 0).astype(np.uint8), np.ones((3, 3))) > 0
    np.testing.assert_array_equal(light[True][~near_floor], light[False][~near_floor])


# --- on board: motion blur, rolling shutter, exposure, noise


def made(scale=0.5, **onboard):
    """A scene without shadows and noise whose drones carry cameras of 640 x 360 pixels."""
    imaging = msgspec.structs.replace(
        S02.imaging, shadows=False, read_noise=0.0, shot_noise=0.0, antialiasing=False
    )
    camera = {
        "image_size_wh": tuple(round(side / scale) for side in ONBOARD_WH),
        "fov_deg": FOV_DEG,
        "shutter_s": 1 / 10_000,
        "pitch_deg": 10.0,
    }
    recipe = msgspec.structs.replace(S02, imaging=imaging, onboard=OnboardCamera(**camera | onboard))
    return build(recipe, scale=scale, seed=1)


def test_each_row_is_what_a_global_shutter_shows_at_its_time():
    line_time_s, frame = 0.03 / ONBOARD_WH[1], 40
    fixed = made()

    def shown(scene):
        return OnboardRenderer(scene, 0).clean_frame(frame).astype(float)

    # At half the size, a row of the image stands for two rows of the camera.
    rolled = shown(made(line_time_s=line_time_s / 2))
    still = shown(fixed)
    for row in (0, 359):
        start_s = line_time_s * (row - (ONBOARD_WH[1] - 1) / 2)
        moment = shown(replace(fixed, start_s=start_s))
        wrong = np.abs(rolled[row] - moment[row]).mean()
        moved = np.abs(rolled[row] - still[row]).mean()
        # Motion within a strip is at most half a pixel; at edges of markers a grey level may differ.
        assert wrong < 2.0
        assert wrong < 0.3 * moved
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
    off_px = []
    for marker, corners in found.items():
        points_m = scene.room.marker_corners_m[marker]
        expected = opencv_pixels(cam, points_m, distortion)
        off_px.append(corners - expected)
        # The lens of the package is the same.
        own, _ = project(lens(scene), points_m @ cam.R.T + cam.t_m)
        np.testing.assert_allclose(own, expected, atol=1e-3)
    # Measured 0.3 px, by OpenCV's refinement of corners, which moves each corner inwards; without distortion, tens
    # of pixels.
    assert np.median(np.linalg.norm(off_px, axis=-1)) < 0.7
    # A common shift of all corners would be an error of the simulator (measured 0.08 px): the mean of at least 16
    # corners has a standard error of 0.1 px.
    assert np.abs(np.mean(off_px, axis=(0, 1))).max() < 0.15


def test_each_camera_on_a_drone_has_its_own_noise_and_exposes_as_stated(scene):
    swinging = OnboardRenderer(made(exposure=(0.3, 2.0), exposure_period_s=2.0), 0).sensor
    factors = [swinging.exposure(time_s) for time_s in np.linspace(0, 2, 400)]
    assert min(factors) == pytest.approx(0.3, rel=1e-3)
    assert max(factors) == pytest.approx(2.0, rel=1e-3)
    grey = np.full((270, 480, 3), 120, np.uint8)
    noise = [OnboardRenderer(scene, drone).sensor.expose(grey, 5, 0.2) for drone in (0, 1)]
    # With half a million partly correlated numbers, independent noise has a correlation below 0.01.
    correlation = np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]
    assert abs(correlation) < 0.02
