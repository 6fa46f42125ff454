"""Effects of `scenarios.Imaging` on images, compared with formulas and geometry that the simulator does not use."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from placed_drones import cube, drone_masks, pixel_of, straight_flight, with_drones

from psotrack.geometry import project
from psotrack.simulation import CameraRenderer, build, scenario
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.imaging import reflections, sensor
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.world.lighting import AMBIENT

S02 = scenario("S02_D4_A")
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
BLACK = (0.0, 0.0, 0.0)


def plain_imaging(**changes):
    return msgspec.structs.replace(PLAIN, **changes)


@pytest.fixture(scope="module")
def scene():
    return build(S02, scale=0.25)


def make_renderer(scene, settings, *placed, index=0):
    """Make the renderer of a camera for other imaging settings and other drones.

    Args:
        scene: scene whose room and cameras are used.
        settings: imaging settings.
        placed: drones that replace the scene's drones, each as (model, flight, paint).
        index: index of the camera.
    """
    recipe = msgspec.structs.replace(scene.scenario, imaging=settings)
    return CameraRenderer(with_drones(replace(scene, scenario=recipe), *placed), index)


def hovering(model, position_m, paint=BLACK):
    return model, straight_flight(position_m), paint


def covered_share(scene, settings, *placed, index=0):
    """Return the share of the backdrop's light that black drones hide, (height, width)."""
    renderer = make_renderer(scene, settings, *placed, index=index)
    empty = sensor.undevelop(sensor.develop(renderer.backdrop.light)).sum(axis=-1)
    return 1 - sensor.undevelop(renderer.clean_frame(0)).sum(axis=-1) / empty


def mean_and_variance(weight):
    """Return the weighted mean (x, y) and the variances along x and y, pixels and squared pixels."""
    rows, columns = np.indices(weight.shape)
    mean = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    variance = [
        (weight * (axis - middle) ** 2).sum() for axis, middle in zip((columns, rows), mean, strict=True)
    ]
    return mean, np.array(variance) / weight.sum()


def test_develop_inverts_undevelop():
    levels = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=-1)
    back = sensor.develop(sensor.undevelop(levels))
    # Levels 0 and 1 are left out: level 1 has a hundred-thousandth of the light of level 255.
    np.testing.assert_array_equal(back[0, 2:], levels[0, 2:])


# --- effects that are switched off


def test_without_effects_pixels_have_the_colour_of_the_room_or_of_a_drone(scene):
    settings = plain_imaging(antialiasing=False)
    renderer = make_renderer(scene, settings, hovering(cube(0.3), (0.3, -0.2, 1.4)))
    frame, empty = renderer.clean_frame(0), sensor.develop(renderer.backdrop.light)
    covered = drone_masks(renderer.scene, renderer.cam, renderer.backdrop.depth_m, 0) > 0
    assert covered.sum() > 300
    # Each pixel is sampled once, at its centre, so it shows either the black body or the room.
    assert not frame[covered].any()
    np.testing.assert_array_equal(frame[~covered], empty[~covered])
    np.testing.assert_array_equal(renderer.frame(0), frame)


@pytest.mark.parametrize(
    ("effect", "places"),
    [
        ({"antialiasing": True}, "edges"),
        ({"lens_blur_px": 1.0}, "edges"),
        ({"shadows": True}, "floor"),
        ({"reflections": 0.04}, "floor"),
    ],
)
def test_an_optical_effect_changes_only_the_expected_pixels(scene, effect, places):
    cubes = hovering(cube(0.3), (0.3, -0.2, 0.4))
    without = plain_imaging(antialiasing=False)
    without_effect = make_renderer(scene, without, cubes)
    with_effect = make_renderer(scene, msgspec.structs.replace(without, **effect), cubes)
    changed = (without_effect.clean_frame(0) != with_effect.clean_frame(0)).any(axis=-1)
    assert changed.sum() > 100
    if places == "floor":
        assert not changed[~without_effect.backdrop.floor].any()


@pytest.mark.parametrize(
    "effect",
    [
        {"exposure_drift": 0.05},
        {"white_balance_drift": 0.05},
        {"flicker": 0.3},
        {"read_noise": 2.0},
        {"shot_noise": 4.0},
        {"jpeg_quality": 50},
    ],
)
def test_each_sensor_effect_changes_the_image(effect):
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), (0, 0), 2)
    without_effect, with_effect = (
        sensor.Sensor(settings, 0, 0, (48, 64)) for settings in (PLAIN, plain_imaging(**effect))
    )
    np.testing.assert_array_equal(without_effect.expose(image, 3, 0.12), image)
    assert (with_effect.expose(image, 3, 0.12) != image).mean() > 0.2


def test_frames_do_not_depend_on_the_order_of_rendering(scene):
    settings = msgspec.structs.replace(Imaging(), jpeg_quality=60, flicker=0.3, exposure_drift=0.05)
    recipe = msgspec.structs.replace(S02, imaging=settings)
    all_effects_scene = replace(scene, scenario=recipe)
    renderer, other_renderer = CameraRenderer(all_effects_scene, 2), CameraRenderer(all_effects_scene, 2)
    forward = [renderer.frame(frame) for frame in (5, 90)]
    backward = [other_renderer.frame(frame) for frame in (90, 5)]
    np.testing.assert_array_equal(forward, backward[::-1])


# --- optics


@pytest.mark.parametrize("sigma_px", [1.0, 2.0])
def test_lens_blur_adds_its_variance_to_the_silhouette(scene, sigma_px):
    placed = hovering(cube(0.2), (0.3, -0.2, 1.4))
    x, y = pixel_of(scene, 0, (0.3, -0.2, 1.4)).astype(int)
    window = np.s_[y - 24 : y + 25, x - 24 : x + 25]
    widths = []
    for blur_px in (0.0, sigma_px):
        widths.append(
            mean_and_variance(covered_share(scene, plain_imaging(lens_blur_px=blur_px), placed)[window])[1]
        )
    # Rounding to 8 bits cuts off the tails of the blur: measured 0.94 to 0.97 of the variance.
    np.testing.assert_allclose(np.subtract(*widths[::-1]), sigma_px**2, rtol=0.1)


def test_motion_blur_is_as_long_as_the_motion_during_the_exposure(scene):
    speed_m_s, shutter_s = 4.0, 1 / 40
    along = np.array(scene.rig.cameras[0].T_cam_world)[0, :3]  # the camera's own x axis
    flight = straight_flight((0.3, -0.2, 1.4), tuple(speed_m_s * along))
    still, moving = (
        covered_share(scene, plain_imaging(shutter_s=time_s), (cube(0.1), flight, BLACK))
        for time_s in (0.0, shutter_s)
    )
    frozen = covered_share(scene, PLAIN, hovering(cube(0.1), (0.3, -0.2, 1.4)))
    np.testing.assert_array_equal(still, frozen)
    x, y = pixel_of(scene, 0, (0.3, -0.2, 1.4)).astype(int)
    window = np.s_[y - 20 : y + 21, x - 20 : x + 21]
    (middle, before), (moved, after) = mean_and_variance(still[window]), mean_and_variance(moving[window])
    depth_m = project(scene.rig.cameras[0], np.array([0.3, -0.2, 1.4]))[1]
    length_px = float(scene.rig.cameras.K[0, 0, 0] / depth_m * speed_m_s * shutter_s)
    # Eight positions, spaced evenly over a length L, have the variance L^2 / 12 (1 - 1 / 64).
    assert after[0] - before[0] == pytest.approx(
        length_px**2 / 12 * 63 / 64, rel=0.1
    )  # rounding to 8 bits at the edge
    assert after[1] - before[1] == pytest.approx(0, abs=0.1)
    np.testing.assert_allclose(moved, middle, atol=0.1)


def test_a_drone_without_rotors_is_drawn(scene):
    bare = replace(cube(0.3), rotor_centres_m=np.zeros((0, 3)), rotor_radii_m=np.zeros(0))
    settings = msgspec.structs.replace(Imaging(), exposure_drift=0.0)
    frame = make_renderer(scene, settings, hovering(bare, (0.3, -0.2, 0.4))).clean_frame(0)
    x, y = pixel_of(scene, 0, (0.3, -0.2, 0.4)).round().astype(int)
    assert not frame[y, x].any()


# --- the floor as a mirror


def test_fresnel_agrees_with_glass():
    """The oracle is Fresnel's equations for unpolarised light; an index of 1.5 reflects 4 % at normal incidence."""
    index = 1.5
    cosine = np.linspace(0, 1, 50)
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (inside - index * cosine) / (inside + index * cosine)
    exact = (across**2 + along**2) / 2
    schlick = reflections.fresnel(cosine, 0.04)
    assert schlick[-1] == pytest.approx(0.04)
    assert schlick[0] == pytest.approx(1.0)
    # Schlick's formula is an approximation; the largest measured error is 0.03.
    np.testing.assert_allclose(schlick, exact, atol=0.04)


def test_the_floor_mirrors_more_where_it_is_seen_at_a_lower_angle(scene):
    renderer = make_renderer(scene, plain_imaging(reflections=0.1))
    eye = -renderer.cam.R.T @ renderer.cam.t_m
    for floor_m in ((-1.5, -1.0, 0.0), (0.5, 0.0, 0.0), (2.5, 2.0, 0.0)):
        x, y = pixel_of(scene, 0, floor_m).round().astype(int)
        cosine = eye[2] / np.linalg.norm(eye - floor_m)
        # Rounding to the pixel, up to half a pixel, changes the distance by up to one percent here.
        assert renderer.mirror.share[y, x] == pytest.approx(0.1 + 0.9 * (1 - cosine) ** 5, rel=0.02)
    assert not renderer.mirror.share[~renderer.backdrop.floor].any()


@pytest.mark.parametrize("index", [0, 4, 6])
def test_the_mirror_image_is_the_drone_reflected_at_the_floor(scene, index):
    centre = np.array([0.3, -0.2, 0.9])
    renderer = make_renderer(
        scene, plain_imaging(reflections=0.5, lens_blur_px=0.5), hovering(cube(0.3), centre), index=index
    )
    change = sensor.undevelop(renderer.clean_frame(0)) - sensor.undevelop(
        sensor.develop(renderer.backdrop.light)
    )
    # The mirror image of a black body hides mirrored light; the hidden share is the coverage of the mirror image.
    covered = -change.sum(axis=-1) / np.maximum(
        renderer.mirror.share * renderer.mirror.light.sum(axis=-1), 1e-3
    )
    corners = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * 0.15 + centre
    below = corners * [1, 1, -1]
    pixels = cv2.projectPoints(
        below, cv2.Rodrigues(renderer.cam.R)[0], renderer.cam.t_m, renderer.cam.K, None
    )[0][:, 0]
    (x, y), reach = pixels.mean(axis=0).round().astype(int), 24
    window = np.s_[y - reach : y + reach + 1, x - reach : x + reach + 1]
    covered = np.where(covered[window] > 0.03, covered[window], 0)
    shape = cv2.moments(cv2.convexHull((64 * pixels).round().astype(np.int32)))
    expected = np.array([shape["m10"], shape["m01"]]) / shape["m00"] / 64
    # Rounding to 8 bits and the four blur passes at the edge shift the centre: measured 0.10 px at most.
    np.testing.assert_allclose(mean_and_variance(covered)[0] + [x - reach, y - reach], expected, atol=0.15)
    assert covered.sum() == pytest.approx(shape["m00"] / 64**2, rel=0.08)
    assert drone_masks(renderer.scene, renderer.cam, renderer.backdrop.depth_m, 0)[y, x] == 0


@pytest.mark.parametrize("height_m", [0.7, 1.2])
def test_a_rough_floor_blurs_the_mirror_image_of_a_higher_drone_more(scene, monkeypatch, height_m):
    centre, rough_rad = np.array([0.3, -0.2, height_m]), 0.02
    x, y = pixel_of(scene, 0, centre * [1, 1, -1]).astype(int)
    window = np.s_[y - 24 : y + 25, x - 24 : x + 25]
    widths = []
    for roughness_rad in (0.0, rough_rad):
        monkeypatch.setattr(reflections, "ROUGHNESS_RAD", roughness_rad)
        renderer = make_renderer(scene, plain_imaging(reflections=0.5), hovering(cube(0.3), centre))
        change = sensor.undevelop(renderer.clean_frame(0)) - sensor.undevelop(
            sensor.develop(renderer.backdrop.light)
        )
        covered = -change.sum(axis=-1) / (renderer.mirror.share * renderer.mirror.light.sum(axis=-1) + 1e-9)
        widths.append(mean_and_variance(covered[window])[1])
    # Seen by the camera, an angle at the floor is reduced by the ratio of drone-floor distance to the whole path.
    eye_m = -renderer.cam.R.T @ renderer.cam.t_m
    sigma_px = rough_rad * renderer.cam.K[0, 0] * height_m / (height_m + eye_m[2])
    # Rounding to 8 bits cuts off the tails of the blur: measured 0.92 to 0.95 of the variance.
    np.testing.assert_allclose(np.subtract(*widths[::-1]), sigma_px**2, rtol=0.15)


def test_a_rough_floor_blurs_the_mirror_image_of_distant_walls_more(scene, monkeypatch):
    """The foot of a wall is not blurred.

    A point half as far behind the mirroring floor point as the camera is in front of it is blurred by a third of the
    largest blur.
    """
    rough = make_renderer(scene, plain_imaging(reflections=0.5)).mirror
    monkeypatch.setattr(reflections, "ROUGHNESS_RAD", 0.0)
    renderer = make_renderer(scene, plain_imaging(reflections=0.5))
    smooth = renderer.mirror
    beyond = 1 - renderer.backdrop.depth_m / smooth.depth_m
    blurred = cv2.GaussianBlur(smooth.light, (0, 0), 0.006 * renderer.cam.K[0, 0] / 3)
    foot, third = (renderer.backdrop.floor & (np.abs(beyond - share) < 0.01) for share in (0.0, 1 / 3))
    assert min(foot.sum(), third.sum()) > 100
    # Pixels are within 0.01 of the two shares: measured differences 0.001 and 0.004, at light values up to 3.
    np.testing.assert_allclose(rough.light[foot], smooth.light[foot], atol=0.01)
    np.testing.assert_allclose(rough.light[third], blurred[third], atol=0.01)
    assert np.abs(blurred - smooth.light)[third].max() > 0.1, "the region must contain an edge"


@pytest.mark.parametrize(("beyond_m", "seen"), [(-0.6, True), (0.6, False)])
def test_mirrored_furniture_hides_what_is_behind_it(scene, beyond_m, seen):
    pillar = np.array([-1.975, 2.875, 0.0])
    index, found = 1, None
    renderer = make_renderer(scene, plain_imaging(reflections=0.5), index=index)
    for height_m in np.arange(0.3, 2.0, 0.1):
        pixel = pixel_of(scene, index, pillar - [0, 0, height_m])
        x, y = pixel.round().astype(int)
        if (
            5 < x < renderer.cam.width - 5
            and 5 < y < renderer.cam.height - 5
            and renderer.backdrop.floor[y - 4 : y + 5, x - 4 : x + 5].all()
        ):
            found = pixel, height_m
            break
    assert found, "the foot of a pillar must be mirrored somewhere"
    pixel, height_m = found
    ray = renderer.cam.R.T @ np.linalg.inv(renderer.cam.K) @ [*pixel, 1.0]
    depth_m = project(scene.rig.cameras[index], pillar - [0, 0, height_m])[1]
    eye = -renderer.cam.R.T @ renderer.cam.t_m
    position = (eye + (depth_m + beyond_m) * ray) * [1, 1, -1]
    with_cube = make_renderer(
        scene, plain_imaging(reflections=0.5), hovering(cube(0.15), position), index=index
    )
    x, y = pixel.round().astype(int)
    darker = sensor.develop(renderer.backdrop.light)[y, x].astype(int) - with_cube.clean_frame(0)[y, x]
    assert (darker.max() > 10) == seen


def test_shadows_dim_only_the_diffuse_light_of_the_floor(scene):
    model, at_m = cube(0.4), np.array([1.0, -0.5, 0.5])
    renderer = make_renderer(scene, plain_imaging(reflections=0.5, shadows=True), hovering(model, at_m))
    dull = make_renderer(scene, plain_imaging(shadows=True), hovering(model, at_m))
    gain = renderer.shadows.floor_gain(0.0)
    row, column = np.unravel_index(gain.argmin(), gain.shape)
    cell_m = 10.0 / gain.shape[1]
    foot = np.array([(column + 0.5) * cell_m - 5.0, 4.0 - (row + 0.5) * cell_m, 0.0])
    checked = 0
    for offset_m in ((0.0, 0.0), (-0.25, 0.0), (-0.3, 0.2), (0.0, -0.3)):
        point = foot + np.array([*offset_m, 0.0])
        x, y = pixel_of(scene, 0, point).round().astype(int)
        # Skip points where the cube or its mirror image hides the floor.
        cubes = [pixel_of(scene, 0, at_m * [1, 1, sign]) for sign in (1, -1)]
        if min(np.hypot(*(cube_px - [x, y])) for cube_px in cubes) < 26:
            continue
        i, j = int((4.0 - point[1]) / cell_m), int((point[0] + 5.0) / cell_m)
        share = renderer.mirror.share[y, x]
        expected = gain[i, j] * (1 - share) * dull.backdrop.light[y, x] + share * renderer.mirror.light[y, x]
        # The tolerance covers pixels that are four cells wide and two roundings to 8 bits.
        np.testing.assert_allclose(sensor.undevelop(renderer.clean_frame(0))[y, x], expected, rtol=0.04)
        checked += 1
    assert checked >= 1
    assert gain.min() < 0.9


def test_a_rotor_lets_three_quarters_of_the_light_through(scene):
    foot = np.array([[0.41, 0.21, 0.0]])
    rotor = replace(cube(0.01), rotor_radii_m=np.array([0.3]))
    flying = hovering(rotor, (*foot[0, :2], 0.05))
    gain = make_renderer(scene, plain_imaging(shadows=True), flying).shadows.floor_gain(0.0)
    panels, up = scene.room.panels, np.array([[0.0, 0.0, 1.0]])
    direct = np.array([panels.direct(foot, up, lamp)[0] for lamp in panels.centres_m])
    expected = np.prod(1 - 0.25 * direct / (direct.sum() + AMBIENT))
    # Half way between the hub, which is solid, and the rim; the shadows of all lamps overlap there.
    row, column = int((4.0 - 0.21) / 0.02), int((0.41 + 0.15 + 5.0) / 0.02)
    assert gain[row, column] == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.6, -1.1])
def test_shadows_turn_with_their_drone(scene, yaw_rad):
    bar = replace(cube(0.3), triangles_m=cube(0.3).triangles_m * [2.0, 0.2, 0.2])
    flight = replace(straight_flight((0.4, 0.2, 0.02)), heading=Heading(yaw_rad))
    renderer = make_renderer(scene, plain_imaging(shadows=True), (bar, flight, BLACK))
    lost = 1 - renderer.shadows.floor_gain(0.0)
    assert lost.max() > 0.1
    # Row numbers of the floor's map grow in the direction of -y.
    rows, columns = np.indices(lost.shape)
    spread = np.cov(np.stack([columns, -rows]).reshape(2, -1), aweights=lost.ravel())
    angle_rad = np.arctan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1]) / 2
    # The bar covers 30 x 3 cells; the tolerance covers the rasterisation of its axis, and lamps 1.5 cm apart.
    assert angle_rad == pytest.approx(yaw_rad, abs=0.02)


# --- lamps and gains


@given(
    flicker=st.floats(0, 1),
    mains_hz=st.floats(16, 65),
    shutter_s=st.floats(1e-4, 0.03),
    time_s=st.floats(0, 100),
    phase_rad=st.floats(0, 6),
)
def test_flicker_is_the_mean_of_the_lamps_over_the_exposure(flicker, mains_hz, shutter_s, time_s, phase_rad):
    settings = plain_imaging(flicker=flicker, mains_hz=mains_hz, shutter_s=shutter_s)
    during_s = time_s + shutter_s * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    lamps = 1 - flicker * np.cos(2 * np.pi * mains_hz * during_s + phase_rad / 2) ** 2
    # The error of the midpoint rule is (pi / 4000)^2 / 6 with at most about one wave per exposure; the mean over time
    # is 1 - flicker / 2.
    expected = lamps.mean() / (1 - flicker / 2)
    assert sensor.flicker_gain(settings, phase_rad, time_s) == pytest.approx(expected, abs=1e-5)


def test_flicker_beats_with_the_frame_rate_and_vanishes_at_whole_half_waves():
    frames_s = np.arange(0, 50, 0.04)
    slow = [sensor.flicker_gain(plain_imaging(flicker=0.4, shutter_s=1 / 500), 0.3, t) for t in frames_s]
    slow = np.array(slow)
    # Lamps flicker at 100.04 Hz and frames come at 25 Hz, which beats at 0.04 Hz: one period is 625 frames.
    np.testing.assert_allclose(slow[625:], slow[:-625], atol=1e-6)
    assert np.ptp(slow[:625]) == pytest.approx(0.4 / (1 - 0.2) * np.sinc(0.2), rel=0.01)
    assert np.abs(np.diff(slow)).max() < 0.003
    at_half_waves = [
        sensor.flicker_gain(plain_imaging(flicker=0.4, shutter_s=0.01, mains_hz=50.0), 0.3, t)
        for t in frames_s
    ]
    np.testing.assert_allclose(at_half_waves, 1.0, atol=1e-12)


def test_flicker_is_equal_in_all_cameras():
    gains = [
        sensor.Sensor(plain_imaging(flicker=0.4), 5, stream, (8, 8)).gains(1.23) for stream in (0, 3, 1001)
    ]
    np.testing.assert_array_equal(gains, [gains[0]] * 3)
    assert sensor.Sensor(plain_imaging(flicker=0.4), 6, 0, (8, 8)).gains(1.23)[0] != gains[0][0]


@pytest.mark.parametrize("effect", ["exposure_drift", "white_balance_drift"])
def test_drift_is_slow_and_has_the_given_standard_deviation(effect):
    sigma = 0.02
    sensors = [sensor.Sensor(plain_imaging(**{effect: sigma}), 0, stream, (8, 8)) for stream in range(400)]
    gains = (
        np.array(
            [
                [camera_sensor.gains(time_s) for time_s in (3.0, 50.0, 200.0, 1000.0)]
                for camera_sensor in sensors
            ]
        )
        - 1
    )
    # 400 cameras at four distant times give at least 1600 independent numbers: a standard error of 2 %.
    assert gains.std() == pytest.approx(sigma, rel=0.06)
    assert abs(gains.mean()) < 4 * sigma / np.sqrt(1600)
    if effect == "exposure_drift":
        assert np.ptp(gains, axis=-1).max() < 1e-12, "all channels have the same gain"
    else:
        np.testing.assert_allclose(gains.mean(axis=-1), 0, atol=1e-12)  # colours change, brightness does not
    course = np.array([sensors[0].gains(t) for t in np.arange(0, 60, 0.04)])
    # The shortest period of the sinusoids is 5 s, which limits the change of their sum from frame to frame.
    assert np.abs(np.diff(course, axis=0)).max() < 0.04 * 2 * np.pi / 5 * sigma * np.sqrt(2 * 6) * np.sqrt(
        1.5
    )
    assert course.std() > 0.2 * sigma


def test_gains_multiply_linear_light():
    camera_sensor = sensor.Sensor(plain_imaging(exposure_drift=0.1, white_balance_drift=0.1), 2, 1, (16, 16))
    image = np.full((16, 16, 3), 150, np.uint8)
    for time_s in (0.0, 7.0, 31.0):
        ratio = sensor.undevelop(camera_sensor.expose(image, 0, time_s)) / sensor.undevelop(image)
        # Half a grey level of 150 is 0.33 %, which gamma multiplies in linear light.
        np.testing.assert_allclose(ratio[0, 0], camera_sensor.gains(time_s), rtol=0.008)


# --- noise and JPEG


@pytest.mark.parametrize(("read", "shot"), [(1.0, 3.0), (0.0, 5.0), (2.5, 0.0)])
@pytest.mark.parametrize("level", [16, 100, 220])
def test_noise_variance_is_the_sum_of_read_and_shot_noise(read, shot, level):
    camera_sensor = sensor.Sensor(plain_imaging(read_noise=read, shot_noise=shot), 0, 0, (120, 160))
    image = np.full((120, 160, 3), level, np.uint8)
    frames = np.stack([camera_sensor.expose(image, frame, frame / 25) for frame in range(8)]).astype(float)
    # Rounding to whole grey levels adds 1/12. Neighbouring pixels are correlated; measured within 2 %.
    assert frames.var() == pytest.approx(read**2 + shot**2 * level / 255 + 1 / 12, rel=0.05)
    assert frames.mean() == pytest.approx(level, abs=0.1)


def measure_blockiness(image):
    """Return the ratio of the difference of neighbours across JPEG block borders to the difference inside blocks."""
    steps = np.abs(np.diff(image.astype(float), axis=1)).mean(axis=(0, 2))
    border = np.arange(len(steps)) % 8 == 7
    return steps[border].mean() / steps[~border].mean()


def test_lower_jpeg_quality_shows_more_blocks(scene):
    image = make_renderer(
        scene, plain_imaging(lens_blur_px=1.0), hovering(cube(0.3), (0.3, -0.2, 1.4))
    ).clean_frame(0)
    found = [
        measure_blockiness(
            sensor.Sensor(plain_imaging(jpeg_quality=quality), 0, 0, image.shape[:2]).expose(image, 0, 0.0)
        )
        for quality in (0, 90, 40, 10)
    ]
    assert found[0] < 1.1
    assert found[0] < found[1] < found[2] < found[3]
    assert found[3] > 1.5
