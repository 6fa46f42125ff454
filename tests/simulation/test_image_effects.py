"""Effects of `Imaging` and `Surroundings`, compared with formulas and geometry that the simulator does not use."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from placed_drones import (
    BLACK,
    CORNERS_M,
    PLAIN,
    S02,
    around,
    centre_and_area,
    cube,
    hidden_by_drones,
    hovering,
    laboratory,
    mean_and_variance,
    number_image,
    opencv_pixels,
    pixel_of,
    straight_flight,
    with_drones,
    with_imaging,
)

from psotrack.geometry import project
from psotrack.simulation import (
    RESTLESS,
    CameraRenderer,
    SimulationSettings,
    build,
    change_scenario,
    simulate,
)
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.imaging import reflections, sensor
from psotrack.simulation.imaging.scenery import Scenery
from psotrack.simulation.scenarios import Imaging, Surroundings
from psotrack.simulation.world.lighting import AMBIENT

#: A place in the middle of the room, metres.
MIDDLE = np.array([0.3, -0.2, 1.4])


def made(*placed, **imaging):
    """The laboratory with other drones and without effects, except for those given."""
    return with_drones(with_imaging(laboratory(), PLAIN, **imaging), *placed)


def plain(**changes):
    return made(**changes).scenario.imaging


def make_renderer(*placed, index=0, **imaging):
    return CameraRenderer(made(*placed, **imaging), index)


def test_develop_inverts_undevelop():
    levels = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=-1)
    back = sensor.develop(sensor.undevelop(levels))
    # Levels 0 and 1 are left out: level 1 has a hundred-thousandth of the light of level 255.
    np.testing.assert_array_equal(back[0, 2:], levels[0, 2:])


def test_without_effects_pixels_have_the_colour_of_the_room_or_of_a_drone():
    renderer = make_renderer(hovering(cube(0.3), MIDDLE), antialiasing=False)
    frame, empty = renderer.clean_frame(0), sensor.develop(renderer.backdrop.light)
    covered = number_image(renderer) > 0
    assert covered.sum() > 300
    # Each pixel is sampled once, at its centre, so it shows either the black body or the room.
    assert not frame[covered].any()
    np.testing.assert_array_equal(frame[~covered], empty[~covered])
    np.testing.assert_array_equal(renderer.frame(0), frame)


def test_frames_do_not_depend_on_the_order_of_rendering():
    imaging = msgspec.structs.replace(Imaging(), jpeg_quality=60, flicker=0.3, exposure_drift=0.05)
    recipe = msgspec.structs.replace(S02, imaging=imaging, surroundings=EVERYTHING)
    scene = replace(laboratory(), scenario=recipe)
    one, other = CameraRenderer(scene, 2), CameraRenderer(scene, 2)
    forward = [one.frame(frame) for frame in (5, 130)]
    backward = [other.frame(frame) for frame in (130, 5)]
    np.testing.assert_array_equal(forward, backward[::-1])
    assert (CameraRenderer(scene, 3).frame(5) != forward[0]).any()


# --- optics


@pytest.mark.parametrize("sigma_px", [1.0, 2.0])
def test_lens_blur_adds_its_variance_to_the_silhouette(sigma_px):
    window, _ = around(pixel_of(laboratory(), 0, MIDDLE), 24)
    spreads = []
    for blur_px in (0.0, sigma_px):
        blurred = made(hovering(cube(0.2), MIDDLE), lens_blur_px=blur_px)
        spreads.append(mean_and_variance(hidden_by_drones(blurred, least=-1.0)[window])[1])
    # Rounding to 8 bits cuts off the tails of the blur: measured 0.94 to 0.97 of the variance.
    np.testing.assert_allclose(np.subtract(*spreads[::-1]), sigma_px**2, rtol=0.1)


def test_motion_blur_is_as_long_as_the_motion_during_the_exposure():
    speed_m_s, shutter_s, camera = 4.0, 1 / 40, laboratory().rig.cameras[0]
    flight = straight_flight(
        MIDDLE, tuple(speed_m_s * camera.T_cam_world[0, :3])
    )  # along the camera's x axis
    still, moving = (
        hidden_by_drones(made((cube(0.1), flight, BLACK), shutter_s=time_s)) for time_s in (0.0, shutter_s)
    )
    np.testing.assert_array_equal(still, hidden_by_drones(made(hovering(cube(0.1), MIDDLE))))
    window, _ = around(pixel_of(laboratory(), 0, MIDDLE), 20)
    (middle, before), (moved, after) = mean_and_variance(still[window]), mean_and_variance(moving[window])
    length_px = float(camera.K[0, 0] / project(camera, MIDDLE)[1] * speed_m_s * shutter_s)
    # Eight positions, spaced evenly over a length L, have the variance L^2 / 12 (1 - 1 / 64); 8 bits at the edge.
    assert after[0] - before[0] == pytest.approx(length_px**2 / 12 * 63 / 64, rel=0.1)
    assert after[1] - before[1] == pytest.approx(0, abs=0.1)
    np.testing.assert_allclose(moved, middle, atol=0.1)


# --- the floor as a mirror


def test_the_floor_mirrors_more_where_it_is_seen_at_a_lower_angle():
    renderer = make_renderer(reflections=0.1)
    eye = -renderer.cam.R.T @ renderer.cam.t_m
    for floor_m in ((-1.5, -1.0, 0.0), (0.5, 0.0, 0.0), (2.5, 2.0, 0.0)):
        x, y = pixel_of(laboratory(), 0, floor_m).round().astype(int)
        cosine = eye[2] / np.linalg.norm(eye - floor_m)
        # Rounding to the pixel, up to half a pixel, changes the distance by up to one percent here.
        assert renderer.mirror.share[y, x] == pytest.approx(0.1 + 0.9 * (1 - cosine) ** 5, rel=0.02)
    assert not renderer.mirror.share[~renderer.backdrop.floor].any()


def hidden_in_the_mirror(renderer):
    """The share of the mirrored light that the mirror image of a black body hides, (height, width)."""
    room = sensor.undevelop(sensor.develop(renderer.backdrop.light))
    change = sensor.undevelop(renderer.clean_frame(0)) - room
    mirrored = renderer.mirror.share * renderer.mirror.light.sum(axis=-1)
    return -change.sum(axis=-1) / np.maximum(mirrored, 1e-3)


@pytest.mark.parametrize("index", [0, 6])
def test_the_mirror_image_is_the_drone_reflected_at_the_floor(index):
    centre = np.array([0.3, -0.2, 0.9])
    renderer = make_renderer(hovering(cube(0.3), centre), index=index, reflections=0.5, lens_blur_px=0.5)
    expected, area = centre_and_area(opencv_pixels(renderer.cam, (0.3 * CORNERS_M + centre) * [1, 1, -1]))
    window, first = around(expected, 24)
    covered = hidden_in_the_mirror(renderer)[window]
    covered = np.where(covered > 0.03, covered, 0)
    # Rounding to 8 bits and the four blur passes at the edge shift the centre: measured 0.10 px at most.
    np.testing.assert_allclose(mean_and_variance(covered)[0] + first, expected, atol=0.15)
    assert covered.sum() == pytest.approx(area, rel=0.08)
    assert number_image(renderer)[window][24, 24] == 0


@pytest.mark.parametrize("height_m", [0.7, 1.2])
def test_a_rough_floor_blurs_the_mirror_image_of_a_higher_drone_more(monkeypatch, height_m):
    centre, rough_rad = np.array([0.3, -0.2, height_m]), 0.02
    window, _ = around(pixel_of(laboratory(), 0, centre * [1, 1, -1]), 24)
    widths = []
    for roughness_rad in (0.0, rough_rad):
        monkeypatch.setattr(reflections, "ROUGHNESS_RAD", roughness_rad)
        renderer = make_renderer(hovering(cube(0.3), centre), reflections=0.5)
        widths.append(mean_and_variance(hidden_in_the_mirror(renderer)[window])[1])
    # Seen by the camera, an angle at the floor is reduced by the ratio of drone-floor distance to the whole path.
    eye_m = -renderer.cam.R.T @ renderer.cam.t_m
    sigma_px = rough_rad * renderer.cam.K[0, 0] * height_m / (height_m + eye_m[2])
    # Rounding to 8 bits cuts off the tails of the blur: measured 0.92 to 0.95 of the variance.
    np.testing.assert_allclose(np.subtract(*widths[::-1]), sigma_px**2, rtol=0.15)


def test_a_rough_floor_blurs_the_mirror_image_of_distant_walls_more(monkeypatch):
    """The foot of a wall is not blurred.

    A point half as far behind the mirroring floor point as the camera is in front of it is blurred by a third of the
    largest blur.
    """
    rough = make_renderer(reflections=0.5).mirror
    monkeypatch.setattr(reflections, "ROUGHNESS_RAD", 0.0)
    renderer = make_renderer(reflections=0.5)
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
def test_mirrored_furniture_hides_what_is_behind_it(beyond_m, seen):
    """The floor mirrors the front of a pillar; a cube is on the same mirrored ray, before or behind the pillar."""
    renderer = make_renderer(index=1, reflections=0.5)
    pixel, depth_m = project(laboratory().rig.cameras[1], np.array([-1.975, 2.875, -1.0]))
    assert renderer.backdrop.floor[around(pixel, 5)[0]].all(), "the floor mirrors the pillar here"
    ray = renderer.cam.R.T @ np.linalg.inv(renderer.cam.K) @ [*pixel, 1.0]
    position_m = (-renderer.cam.R.T @ renderer.cam.t_m + (depth_m + beyond_m) * ray) * [1, 1, -1]
    with_cube = make_renderer(hovering(cube(0.15), position_m), index=1, reflections=0.5)
    x, y = pixel.round().astype(int)
    darker = sensor.develop(renderer.backdrop.light)[y, x].astype(int) - with_cube.clean_frame(0)[y, x]
    assert (darker.max() > 10) == seen


# --- shadows


def test_shadows_dim_only_the_diffuse_light_of_the_floor():
    placed, at_m = hovering(cube(0.4), (1.0, -0.5, 0.5)), np.array([1.0, -0.5, 0.5])
    renderer = make_renderer(placed, reflections=0.5, shadows=True)
    dull = make_renderer(placed, shadows=True).backdrop.light
    gain = renderer.shadows.floor_gain(0.0)
    assert gain.min() < 0.9
    # The darkest point of the floor. The cube and its mirror image, which reach 20 px, do not hide it.
    row, column = np.unravel_index(gain.argmin(), gain.shape)
    cell_m = 10.0 / gain.shape[1]
    foot_m = ((column + 0.5) * cell_m - 5.0, 4.0 - (row + 0.5) * cell_m, 0.0)
    x, y = pixel_of(laboratory(), 0, foot_m).round().astype(int)
    for sign in (1, -1):
        assert np.linalg.norm(pixel_of(laboratory(), 0, at_m * [1, 1, sign]) - [x, y]) > 22
    share = renderer.mirror.share[y, x]
    expected = gain.min() * (1 - share) * dull[y, x] + share * renderer.mirror.light[y, x]
    # The tolerance covers pixels that are four cells wide and two roundings to 8 bits.
    np.testing.assert_allclose(sensor.undevelop(renderer.clean_frame(0))[y, x], expected, rtol=0.04)


def test_a_rotor_lets_three_quarters_of_the_light_through():
    foot = np.array([[0.41, 0.21, 0.0]])
    rotor = replace(cube(0.01), rotor_radii_m=np.array([0.3]))
    gain = make_renderer(hovering(rotor, (*foot[0, :2], 0.05)), shadows=True).shadows.floor_gain(0.0)
    panels, up = laboratory().room.panels, np.array([[0.0, 0.0, 1.0]])
    direct = np.array([panels.direct(foot, up, lamp)[0] for lamp in panels.centres_m])
    expected = np.prod(1 - 0.25 * direct / (direct.sum() + AMBIENT))
    # Half way between the hub, which is solid, and the rim; the shadows of all lamps overlap there.
    row, column = int((4.0 - 0.21) / 0.02), int((0.41 + 0.15 + 5.0) / 0.02)
    assert gain[row, column] == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("yaw_rad", [0.6, -1.1])
def test_shadows_turn_with_their_drone(yaw_rad):
    bar = replace(cube(0.3), triangles_m=cube(0.3).triangles_m * [2.0, 0.2, 0.2])
    flight = straight_flight((0.4, 0.2, 0.02), heading=Heading(yaw_rad))
    lost = 1 - make_renderer((bar, flight, BLACK), shadows=True).shadows.floor_gain(0.0)
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
    settings = plain(flicker=flicker, mains_hz=mains_hz, shutter_s=shutter_s)
    during_s = time_s + shutter_s * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    lamps = 1 - flicker * np.cos(2 * np.pi * mains_hz * during_s + phase_rad / 2) ** 2
    # The error of the midpoint rule is (pi / 4000)^2 / 6 with at most about one wave per exposure; the mean over time
    # is 1 - flicker / 2.
    expected = lamps.mean() / (1 - flicker / 2)
    assert sensor.flicker_gain(settings, phase_rad, time_s) == pytest.approx(expected, abs=1e-5)


def test_flicker_is_equal_in_all_cameras():
    (first, *others), (other_seed,) = (
        [sensor.Sensor(plain(flicker=0.4), seed, stream, (8, 8)).gains(1.23) for stream in streams]
        for seed, streams in ((5, (0, 3, 1001)), (6, (0,)))
    )
    np.testing.assert_array_equal(others, [first] * 2)
    assert other_seed[0] != first[0]


@pytest.mark.parametrize("effect", ["exposure_drift", "white_balance_drift"])
def test_drift_is_slow_and_has_the_given_standard_deviation(effect):
    sigma, times_s = 0.02, (3.0, 50.0, 200.0, 1000.0)
    sensors = [sensor.Sensor(plain(**{effect: sigma}), 0, stream, (8, 8)) for stream in range(400)]
    gains = np.array([[each.gains(time_s) for time_s in times_s] for each in sensors]) - 1
    # 400 cameras at four distant times give at least 1600 independent numbers: a standard error of 2 %.
    assert gains.std() == pytest.approx(sigma, rel=0.06)
    assert abs(gains.mean()) < 4 * sigma / np.sqrt(1600)
    if effect == "exposure_drift":
        assert np.ptp(gains, axis=-1).max() < 1e-12, "all channels have the same gain"
    else:
        np.testing.assert_allclose(gains.mean(axis=-1), 0, atol=1e-12)  # colours change, brightness does not
    course = np.array([sensors[0].gains(t) for t in np.arange(0, 60, 0.04)])
    # The shortest period of the sinusoids is 5 s, which limits the change of their sum from frame to frame.
    fastest = 0.04 * 2 * np.pi / 5 * sigma * np.sqrt(2 * 6) * np.sqrt(1.5)
    assert np.abs(np.diff(course, axis=0)).max() < fastest
    assert course.std() > 0.2 * sigma


def test_gains_multiply_linear_light():
    camera_sensor = sensor.Sensor(plain(exposure_drift=0.1, white_balance_drift=0.1), 2, 1, (16, 16))
    image = np.full((16, 16, 3), 150, np.uint8)
    for time_s in (0.0, 7.0, 31.0):
        ratio = sensor.undevelop(camera_sensor.expose(image, 0, time_s)) / sensor.undevelop(image)
        # Half a grey level of 150 is 0.33 %, which gamma multiplies in linear light.
        np.testing.assert_allclose(ratio[0, 0], camera_sensor.gains(time_s), rtol=0.008)


def test_an_automatic_exposure_swings_by_the_stated_factors():
    imaging = plain(exposure=(0.7, 1.36), exposure_period_s=7.0)
    times_s = np.arange(0, 14, 0.04)
    gains = []
    for stream in range(8):
        gain = np.array([sensor.Sensor(imaging, 0, stream, (8, 8)).gains(time_s) for time_s in times_s])
        assert gain.min() == pytest.approx(0.7, rel=1e-3)
        assert gain.max() == pytest.approx(1.36, rel=1e-3)
        np.testing.assert_allclose(gain[175:], gain[:175], rtol=1e-9)
        # The fastest change of a sinusoid from log 0.7 to log 1.36 in 7 s, per frame.
        assert np.abs(np.diff(np.log(gain), axis=0)).max() < 0.04 * np.pi / 7 * np.log(1.36 / 0.7) * 1.01
        gains.append(gain[:, 0])
    assert np.ptp(gains, axis=0).max() > 0.5, "cameras do not swing together"


# --- noise and JPEG


@pytest.mark.parametrize(("read", "shot"), [(0.0, 0.0), (1.0, 3.0), (0.0, 5.0), (2.5, 0.0)])
def test_noise_variance_is_the_sum_of_read_and_shot_noise(read, shot):
    camera_sensor = sensor.Sensor(plain(read_noise=read, shot_noise=shot), 0, 0, (120, 160))
    for level in (16, 100, 220):
        image = np.full((120, 160, 3), level, np.uint8)
        frames = np.stack([camera_sensor.expose(image, frame, frame / 25) for frame in range(8)]).astype(
            float
        )
        if read == shot == 0:
            np.testing.assert_array_equal(frames, level)
            continue
        # Rounding to whole grey levels adds 1/12. Neighbouring pixels are correlated; measured within 2 %.
        assert frames.var() == pytest.approx(read**2 + shot**2 * level / 255 + 1 / 12, rel=0.05)
        assert frames.mean() == pytest.approx(level, abs=0.1)


def test_noise_depends_on_seed_camera_and_frame_only():
    image = np.full((60, 80, 3), 120, np.uint8)

    def expose(seed, index, frame):
        return sensor.Sensor(S02.imaging, seed, index, (60, 80)).expose(image, frame, 0.0).astype(float)

    np.testing.assert_array_equal(expose(1, 2, 3), expose(1, 2, 3))
    for other in ((1, 2, 4), (1, 3, 3), (2, 2, 3)):
        a, b = (shown - shown.mean() for shown in (expose(1, 2, 3), expose(*other)))
        # With 14,400 numbers and correlated neighbours, independent noise has a correlation of about 0.01.
        assert abs((a * b).mean() / (a.std() * b.std())) < 0.06


def test_lower_jpeg_quality_shows_more_blocks():
    """The difference of neighbours across borders of blocks, relative to that inside blocks."""
    image = make_renderer(hovering(cube(0.3), MIDDLE), lens_blur_px=1.0).clean_frame(0)
    found = []
    for quality in (0, 90, 40, 10):
        shown = sensor.Sensor(plain(jpeg_quality=quality), 0, 0, image.shape[:2]).expose(image, 0, 0.0)
        steps = np.abs(np.diff(shown.astype(float), axis=1)).mean(axis=(0, 2))
        border = np.arange(len(steps)) % 8 == 7
        found.append(steps[border].mean() / steps[~border].mean())
    assert found[0] < 1.1
    assert found[0] < found[1] < found[2] < found[3]
    assert found[3] > 1.5


# --- surroundings: places, sizes, times, and what stays as it is


SHAPE = (270, 480)
EVERYTHING = Surroundings(lamp_drop=0.2, screen=0.03, foliage=0.03, person=0.5)


def covered(seen_layers, shape=SHAPE):
    """Return the share of each pixel that layers cover, (height, width): white over black is their coverage."""
    rest = np.ones(shape, np.float32)
    for layer in seen_layers:
        rows, columns = layer.seen.shape[:2]
        for row in range(max(layer.y, 0), min(layer.y + rows, shape[0])):
            left, right = max(layer.x, 0), min(layer.x + columns, shape[1])
            if right > left:
                rest[row, left:right] *= layer.seen[row - layer.y, left - layer.x : right - layer.x, 3]
    return 1 - rest


def scenery(stream=0, seed=0, blur_px=0.0, **settings):
    return Scenery(Surroundings(**settings), seed, stream, SHAPE, blur_px)


def calm_and_restless(index, **settings):
    """Renderers of a camera that sees one black cube and no other effects, without and with surroundings."""
    calm = made(hovering(cube(0.3), MIDDLE))
    recipe = msgspec.structs.replace(calm.scenario, surroundings=Surroundings(**settings))
    return CameraRenderer(calm, index), CameraRenderer(replace(calm, scenario=recipe), index)


@pytest.mark.parametrize("share", [0.025, 0.1, 0.4])
def test_screens_and_leaves_cover_the_stated_share(share):
    for stream in range(2):
        (screen,) = scenery(stream, screen=share).layers(1.0)
        lit = screen.seen[..., :3].max(axis=-1) > 0.011
        # Sides are rounded to whole pixels: half a pixel of 40 on each.
        assert np.count_nonzero(lit) == pytest.approx(share * SHAPE[0] * SHAPE[1], rel=0.03)
        leaves = scenery(stream, foliage=share)
        found = np.mean([covered(leaves.layers(time_s)).mean() for time_s in np.arange(0, 5, 0.71)])
        # Leaves sway over the border of the image and over each other; measured within 4 %.
        assert found == pytest.approx(share, rel=0.08)
        # Leaves far apart sway independently: the mean of their phases on the unit circle, measured 0.18 at most for
        # 0.4 of the image, is far from 1.
        assert np.hypot(*(wave.mean() for wave in leaves._things[0]._waves[0])) < 0.45


def test_a_person_is_as_tall_as_stated_and_walks_in_and_out():
    sides = set()
    for stream in range(8):
        one = scenery(stream, person=0.5, person_period_s=6.0)
        assert not one.layers(0.0), "nobody is in the image at the beginning"
        tall, middles = [], []
        for time_s in np.arange(0, 6, 0.1):
            rows, columns = np.nonzero(covered(one.layers(time_s)) > 0.6)
            if len(rows) and 4 < columns.mean() < SHAPE[1] - 5:
                tall.append(np.ptp(rows) + 1)
                middles.append(columns.mean() / SHAPE[1])
        assert max(tall) == pytest.approx(0.5 * SHAPE[0], rel=0.06)
        side = np.round(middles[0])
        sides.add(side)
        inside = np.abs(np.array(middles) - side)
        # In from the side, at most a third of the width, and out on the same side.
        assert inside[0] < 0.1
        assert inside[-1] < 0.1
        assert 0.1 < inside.max() < 0.33
    assert sides == {0.0, 1.0}


def test_all_scales_show_the_same():
    """A twice larger image, reduced, shows what the small image shows."""
    small = Scenery(EVERYTHING, 1, 0, SHAPE, 0.0)
    large = Scenery(EVERYTHING, 1, 0, (2 * SHAPE[0], 2 * SHAPE[1]), 0.0)
    time_s = 6.0
    here, reduced = (
        covered(small.layers(time_s)),
        cv2.resize(covered(large.layers(time_s), (540, 960)), SHAPE[::-1], interpolation=cv2.INTER_AREA),
    )
    # Edges differ by the rounding to pixels; the inside does not.
    assert np.mean(np.abs(here - reduced) > 0.5) < 0.006
    assert here.mean() == pytest.approx(reduced.mean(), rel=0.06)


def test_a_screen_shows_another_scene_after_a_while():
    one = scenery(screen=0.03)
    shown = np.stack([one.layers(time_s)[0].seen[..., :3] for time_s in np.arange(0, 6, 0.04)])
    change = np.abs(np.diff(shown, axis=0)).mean(axis=(1, 2, 3))
    assert np.all(change > 0), "the content moves in every frame"
    cuts = np.flatnonzero(change > 3 * np.median(change))
    assert len(cuts) in {3, 4}
    np.testing.assert_allclose(np.diff(cuts) * 0.04, 1.7, atol=0.05)


def test_a_lamp_darkens_half_of_the_image_while_it_is_off():
    calm, restless = calm_and_restless(3, lamp_drop=0.25, lamp_s=(1.0, 2.0))
    for time_s in (0.96, 2.0):
        np.testing.assert_array_equal(*(one.clean_frame(round(25 * time_s)) for one in (calm, restless)))
    for time_s in (1.0, 1.96):
        frame = round(25 * time_s)
        before, after = (one.clean_frame(frame).astype(float) for one in (calm, restless))
        bright = before.min(axis=-1) > 60
        light = ((after / np.maximum(before, 1)) ** sensor.GAMMA).mean(axis=-1)
        # Rounding of grey levels of 60 and more, and of the factor, to 8 bits.
        assert light[bright].min() == pytest.approx(0.75, abs=0.03)
        assert light[bright].max() == 1.0
        lost = np.array((restless.scenery._dark[..., 0] / 255.0) ** sensor.GAMMA)
        assert np.mean(lost < 0.875) == pytest.approx(0.5, abs=0.01)
        assert 0.02 < np.mean((lost > 0.76) & (lost < 0.99)) < 0.2, "the edge is soft"


def test_the_lamp_darkens_drones_and_scenery_too():
    _, shown = calm_and_restless(0, lamp_drop=1.0, lamp_s=(0.0,), screen=0.1, foliage=0.1)
    frame = shown.clean_frame(5)
    assert not frame[shown.scenery._dark[..., 0] == 0].any()


def test_the_halves_and_places_differ_between_cameras_and_seeds():
    first, other, seed = (Scenery(EVERYTHING, *which, SHAPE, 0.0) for which in ((0, 0), (0, 1), (1, 0)))
    for one in (other, seed):
        assert (one._dark != first._dark).mean() > 0.1
        places = [[(layer.x, layer.y) for layer in each.layers(0.0)] for each in (first, one)]
        assert places[0] != places[1]


def test_drones_are_in_front_and_masks_are_theirs():
    calm, restless = calm_and_restless(0, foliage=0.9, screen=0.25, person=1.0)
    inside = cv2.erode((number_image(calm) > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert inside.sum() > 100
    for frame in (0, 60):
        assert not restless.clean_frame(frame)[inside].any(), "the cube is black"
        np.testing.assert_array_equal(number_image(restless, frame), number_image(calm, frame))


def test_sequences_have_the_same_masks_truth_and_rig(tmp_path):
    # The comment of RESTLESS says what these factors of light are in grey levels: 15 % and 12 %.
    grey = np.array([0.7, 1.36, 1 - RESTLESS["surroundings.lamp_drop"]]) ** (1 / sensor.GAMMA)
    np.testing.assert_allclose(grey, [0.85, 1.15, 0.88], atol=0.001)
    recipe = change_scenario(S02, {"cameras": "laboratory_corners"})
    settings = SimulationSettings(num_frames=2, scale=0.04, onboard=False)
    calm = simulate(recipe, tmp_path / "calm", settings, jobs=1)
    restless = simulate(change_scenario(recipe, RESTLESS), tmp_path / "restless", settings, jobs=1)
    names = {path.relative_to(calm) for path in calm.rglob("*") if path.is_file()}
    assert names == {path.relative_to(restless) for path in restless.rglob("*") if path.is_file()}
    for name in names:
        same = (calm / name).read_bytes() == (restless / name).read_bytes()
        assert same == (name.suffix != ".avi" and name.name != "simulation.json"), name


def test_a_lens_with_distortion_shows_the_scenery_at_the_same_pixels():
    """Scenery has its place in the image, whatever the lens."""
    lens = {"focal_length_px": 700.0, "distortion": (0.02, 0.01, 0.0, 0.0), "fisheye": True}
    place = {"position_m": (-4.7, -3.7, 3.1), "target_m": (0.1, 0.0, 1.25)}
    recipe = change_scenario(S02, {"cameras": [place | lens], "imaging": msgspec.to_builtins(PLAIN)})
    leaves = change_scenario(recipe, {"surroundings.foliage": 0.2, "surroundings.screen": 0.05})
    shown, empty = (CameraRenderer(build(each, scale=0.25), 0) for each in (leaves, recipe))
    assert shown.lens is not None
    changed = (shown.clean_frame(7) != empty.clean_frame(7)).any(axis=-1)
    wanted = covered(shown.scenery.layers(shown.scene.time_s(7)), changed.shape)
    # The image is put together with cubic interpolation, whose edges reach two pixels farther.
    near = cv2.dilate((wanted > 0).astype(np.uint8), np.ones((9, 9))) > 0
    inside = cv2.erode((wanted > 0.99).astype(np.uint8), np.ones((5, 5))) > 0
    seen = shown.lens.face >= 0
    assert inside.sum() > 300
    assert changed[inside & seen].mean() > 0.99
    assert changed[seen & ~near].mean() < 0.02
