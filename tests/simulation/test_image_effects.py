"""Effects of `Imaging` and `Surroundings`, compared with formulas and geometry that the simulator does not use."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from helpers import content_of
from hypothesis import given
from hypothesis import strategies as st
from placed_drones import (
    BLACK,
    CORNERS_M,
    PLAIN,
    S02,
    around,
    assert_drawn_at,
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
from psotrack.simulation import RESTLESS, CameraRenderer, SimulationSettings, change_scenario, simulate
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.imaging import sensor
from psotrack.simulation.imaging.scenery import Scenery
from psotrack.simulation.scenarios import Surroundings
from psotrack.simulation.world.rooms import AMBIENT

#: A place in the middle of the room, metres.
MIDDLE = np.array([0.3, -0.2, 1.4])
#: Side of a cell of the map of light on the floor, metres.
CELL_M = 0.02


def made(*placed, **imaging):
    """The laboratory with other drones and without effects, except for those given."""
    return with_drones(with_imaging(laboratory(), PLAIN, **imaging), *placed)


def plain(**changes):
    return made(**changes).scenario.imaging


def make_renderer(*placed, index=0, **imaging):
    return CameraRenderer(made(*placed, **imaging), index)


def test_without_effects_pixels_have_the_colour_of_the_room_or_of_a_drone():
    renderer = make_renderer(hovering(cube(0.3), MIDDLE), antialiasing=False)
    frame, empty = renderer.clean_frame(0), sensor.develop(renderer.views[0].backdrop.light)
    covered = number_image(renderer) > 0
    assert covered.sum() > 300
    # Each pixel is sampled once, at its centre, so it shows either the black body or the room.
    assert not frame[covered].any()
    np.testing.assert_array_equal(frame[~covered], empty[~covered])
    np.testing.assert_array_equal(renderer.frame(0), frame)


# --- optics


@pytest.mark.parametrize("sigma_px", [1.0, 2.0])
def test_lens_blur_adds_its_variance_to_the_silhouette(sigma_px):
    window, _ = around(pixel_of(laboratory(), 0, MIDDLE), 24)
    variances = []
    for blur_px in (0.0, sigma_px):
        blurred = made(hovering(cube(0.2), MIDDLE), lens_blur_px=blur_px)
        share = hidden_by_drones(blurred, least=-1.0)
        _, variance = mean_and_variance(share[window])
        variances.append(variance)
    # Rounding to 8 bits cuts off the tails of the blur: measured 0.94 to 0.97 of the variance.
    np.testing.assert_allclose(variances[1] - variances[0], sigma_px**2, rtol=0.1)


def test_motion_blur_is_as_long_as_the_motion_during_the_exposure():
    speed_m_s, shutter_s = 4.0, 1 / 40
    camera = laboratory().rig.cameras[0]
    along_x = speed_m_s * camera.T_cam_world[0, :3]
    moving = (cube(0.1), straight_flight(MIDDLE, tuple(along_x)), BLACK)
    pixel, depth_m = project(camera, MIDDLE)
    window, _ = around(pixel, 20)
    sharp = hidden_by_drones(made(moving, shutter_s=0.0))
    np.testing.assert_array_equal(sharp, hidden_by_drones(made(hovering(cube(0.1), MIDDLE))))
    blurred = hidden_by_drones(made(moving, shutter_s=shutter_s))
    middle, before = mean_and_variance(sharp[window])
    moved, after = mean_and_variance(blurred[window])
    length_px = camera.K[0, 0] / depth_m * speed_m_s * shutter_s
    # Eight positions, spaced evenly over a length L, have the variance L^2 / 12 (1 - 1 / 64); 8 bits at the edge.
    along, across = after - before
    assert along == pytest.approx(length_px**2 / 12 * 63 / 64, rel=0.1)
    assert across == pytest.approx(0, abs=0.1)
    np.testing.assert_allclose(moved, middle, atol=0.1)


# --- the floor as a mirror


def test_the_floor_mirrors_more_where_it_is_seen_at_a_lower_angle():
    renderer = make_renderer(reflections=0.1)
    eye_m = laboratory().rig.cameras.centre_world[0]
    for floor_m in ((-1.5, -1.0, 0.0), (0.5, 0.0, 0.0), (2.5, 2.0, 0.0)):
        x, y = pixel_of(laboratory(), 0, floor_m).round().astype(int)
        cosine = eye_m[2] / np.linalg.norm(eye_m - floor_m)
        expected = 0.1 + 0.9 * (1 - cosine) ** 5
        # Rounding to the pixel, up to half a pixel, changes the distance by up to one percent here.
        assert renderer.views[0].mirror.share[y, x] == pytest.approx(expected, rel=0.02)
    assert not renderer.views[0].mirror.share[~renderer.views[0].backdrop.floor].any()


def hidden_in_the_mirror(renderer):
    """The share of the mirrored light that the mirror image of a black body hides, (height, width)."""
    room = sensor.undevelop(sensor.develop(renderer.views[0].backdrop.light))
    change = sensor.undevelop(renderer.clean_frame(0)) - room
    mirrored = renderer.views[0].mirror.share * renderer.views[0].mirror.light.sum(axis=-1)
    return -change.sum(axis=-1) / np.maximum(mirrored, 1e-3)


@pytest.mark.parametrize("index", [0, 6])
def test_the_mirror_image_is_the_drone_reflected_at_the_floor(index):
    centre = np.array([0.3, -0.2, 0.9])
    renderer = make_renderer(hovering(cube(0.3), centre), index=index, reflections=0.5, lens_blur_px=0.5)
    below_m = (0.3 * CORNERS_M + centre) * [1, 1, -1]
    share = hidden_in_the_mirror(renderer)
    share[share < 0.03] = 0.0
    # Rounding to 8 bits and the four blur passes at the edge shift the centre: measured 0.10 px at most.
    window = assert_drawn_at(share, opencv_pixels(renderer.cam, below_m), atol_px=0.15, area_rel=0.08)
    assert number_image(renderer)[window][24, 24] == 0


# --- shadows


def test_shadows_dim_only_the_diffuse_light_of_the_floor():
    at_m = np.array([1.0, -0.5, 0.5])
    placed = hovering(cube(0.4), at_m)
    renderer = make_renderer(placed, reflections=0.5, shadows=True)
    dull = make_renderer(placed, shadows=True).views[0].backdrop.light
    gain = renderer.views[0].shadows.floor_gain(0.0)
    assert gain.min() < 0.9
    # The darkest point of the floor. The cube and its mirror image, which reach 20 px, do not hide it.
    row, column = np.unravel_index(gain.argmin(), gain.shape)
    foot_m = ((column + 0.5) * CELL_M - 5.0, 4.0 - (row + 0.5) * CELL_M, 0.0)
    pixel = pixel_of(laboratory(), 0, foot_m).round().astype(int)
    for body_m in (at_m, at_m * [1, 1, -1]):
        assert np.linalg.norm(pixel_of(laboratory(), 0, body_m) - pixel) > 22
    x, y = pixel
    share = renderer.views[0].mirror.share[y, x]
    expected = gain.min() * (1 - share) * dull[y, x] + share * renderer.views[0].mirror.light[y, x]
    found = sensor.undevelop(renderer.clean_frame(0))[y, x]
    # The tolerance covers pixels that are four cells wide and two roundings to 8 bits.
    np.testing.assert_allclose(found, expected, rtol=0.04)


def test_a_rotor_lets_three_quarters_of_the_light_through():
    x_m, y_m = 0.41, 0.21
    rotor = replace(cube(0.01), rotor_radii_m=np.array([0.3]))
    renderer = make_renderer(hovering(rotor, (x_m, y_m, 0.05)), shadows=True)
    panels = laboratory().room.panels
    foot, up = np.array([[x_m, y_m, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    direct = np.array([panels.direct(foot, up, lamp)[0] for lamp in panels.centres_m])
    of_all_light = direct / (direct.sum() + AMBIENT)
    # Half way between the hub, which is solid, and the rim; the shadows of all lamps overlap there.
    row, column = int((4.0 - y_m) / CELL_M), int((x_m + 0.15 + 5.0) / CELL_M)
    gain = renderer.views[0].shadows.floor_gain(0.0)[row, column]
    assert gain == pytest.approx(np.prod(1 - 0.25 * of_all_light), abs=0.005)


@pytest.mark.parametrize("yaw_rad", [0.6, -1.1])
def test_shadows_turn_with_their_drone(yaw_rad):
    solid = cube(0.3)
    bar = replace(solid, triangles_m=solid.triangles_m * [2.0, 0.2, 0.2])
    flight = straight_flight((0.4, 0.2, 0.02), heading=Heading(yaw_rad))
    lost = 1 - make_renderer((bar, flight, BLACK), shadows=True).views[0].shadows.floor_gain(0.0)
    assert lost.max() > 0.1
    # Row numbers of the floor's map grow in the direction of -y.
    rows, columns = np.indices(lost.shape)
    covariance = np.cov([columns.ravel(), -rows.ravel()], aweights=lost.ravel())
    _, directions = np.linalg.eigh(covariance)
    longest = directions[:, 1]
    # The bar covers 30 x 3 cells; the tolerance covers the rasterisation of its axis, and lamps 1.5 cm apart.
    across = longest @ [-np.sin(yaw_rad), np.cos(yaw_rad)]
    assert across == pytest.approx(0, abs=0.02)


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
    def gains(seed, stream):
        return sensor.Sensor(plain(flicker=0.4), seed, stream, (8, 8)).gains(1.23).tolist()

    first = gains(5, 0)
    assert gains(5, 3) == first
    assert gains(5, 1001) == first
    assert gains(6, 0) != first


@pytest.mark.parametrize("effect", ["exposure_drift", "white_balance_drift"])
def test_drift_is_slow_and_has_the_given_standard_deviation(effect):
    sigma = 0.02
    settings = plain(**{effect: sigma})
    sensors = [sensor.Sensor(settings, 0, stream, (8, 8)) for stream in range(400)]
    changes = []
    for time_s in (3.0, 50.0, 200.0, 1000.0):
        changes += [each.gains(time_s) - 1 for each in sensors]
    # 400 cameras at four distant times give at least 1600 independent numbers: a standard error of 2 %.
    assert np.std(changes) == pytest.approx(sigma, rel=0.06)
    assert abs(np.mean(changes)) < 4 * sigma / np.sqrt(1600)
    if effect == "exposure_drift":
        assert np.ptp(changes, axis=-1).max() < 1e-12, "all channels have the same gain"
    else:
        np.testing.assert_allclose(np.mean(changes, axis=-1), 0, atol=1e-12)  # brightness does not change
    course = np.array([sensors[0].gains(time_s) for time_s in np.arange(0, 60, 0.04)])
    # The shortest period of the sinusoids is 5 s, which limits the change of their sum from frame to frame.
    fastest = 0.04 * 2 * np.pi / 5 * sigma * np.sqrt(2 * 6) * np.sqrt(1.5)
    assert np.abs(np.diff(course, axis=0)).max() < fastest
    assert course.std() > 0.2 * sigma


def test_an_automatic_exposure_swings_by_the_stated_factors():
    low, high, period_s = 0.7, 1.36, 7.0
    settings = plain(exposure=(low, high), exposure_period_s=period_s)
    gains = []
    for stream in range(8):
        one = sensor.Sensor(settings, 0, stream, (8, 8))
        gains.append([one.gains(time_s)[0] for time_s in np.arange(0, period_s, 0.04)])
    np.testing.assert_allclose(np.min(gains, axis=1), low, rtol=1e-3)
    np.testing.assert_allclose(np.max(gains, axis=1), high, rtol=1e-3)
    # The fastest change of a sinusoid from log 0.7 to log 1.36 in 7 s, per frame.
    fastest = 0.04 * np.pi / period_s * np.log(high / low)
    assert np.abs(np.diff(np.log(gains), axis=1)).max() < 1.01 * fastest
    assert np.ptp(gains, axis=0).max() > 0.5, "cameras do not swing together"


# --- noise and JPEG


@pytest.mark.parametrize(("read", "shot"), [(0.0, 0.0), (1.0, 3.0), (0.0, 5.0), (2.5, 0.0)])
def test_noise_variance_is_the_sum_of_read_and_shot_noise(read, shot):
    camera_sensor = sensor.Sensor(plain(read_noise=read, shot_noise=shot), 0, 0, (120, 160))
    for level in (16, 100, 220):
        image = np.full((120, 160, 3), level, np.uint8)
        frames = np.array([camera_sensor.expose(image, frame, frame / 25) for frame in range(8)])
        if read == shot == 0:
            np.testing.assert_array_equal(frames, level)
            continue
        # Rounding to whole grey levels adds 1/12. Neighbouring pixels are correlated; measured within 2 %.
        variance = read**2 + shot**2 * level / 255 + 1 / 12
        assert frames.var() == pytest.approx(variance, rel=0.05)
        assert frames.mean() == pytest.approx(level, abs=0.1)


def test_noise_depends_on_seed_camera_and_frame_only():
    def expose(seed, index, frame):
        image = np.full((60, 80, 3), 120, np.uint8)
        return sensor.Sensor(S02.imaging, seed, index, (60, 80)).expose(image, frame, 0.0).ravel()

    first = expose(1, 2, 3)
    np.testing.assert_array_equal(expose(1, 2, 3), first)
    for other in (expose(1, 2, 4), expose(1, 3, 3), expose(2, 2, 3)):
        # With 14,400 numbers and correlated neighbours, independent noise has a correlation of about 0.01.
        assert abs(np.corrcoef(first, other)[0, 1]) < 0.06


def test_lower_jpeg_quality_shows_more_blocks():
    """The difference of neighbours across borders of blocks, relative to that inside blocks."""
    image = make_renderer(hovering(cube(0.3), MIDDLE), lens_blur_px=1.0).clean_frame(0)
    ratios = []
    for quality in (0, 90, 40, 10):
        shown = sensor.Sensor(plain(jpeg_quality=quality), 0, 0, image.shape[:2]).expose(image, 0, 0.0)
        differences = np.abs(np.diff(shown.astype(float), axis=1))
        steps = differences.mean(axis=(0, 2))
        border = np.arange(len(steps)) % 8 == 7
        ratios.append(steps[border].mean() / steps[~border].mean())
    assert ratios[0] < 1.1
    assert ratios == sorted(ratios)
    assert ratios[3] > 1.5


# --- surroundings: places, sizes, times, and what stays as it is


SHAPE = (270, 480)


def covered(seen_layers, shape=SHAPE):
    """Return the share of each pixel that layers cover, (height, width)."""
    margin = 1000
    height, width = shape
    clear = np.ones((height + 2 * margin, width + 2 * margin), np.float32)
    for layer in seen_layers:
        rows, columns = layer.seen.shape[:2]
        top, left = layer.y + margin, layer.x + margin
        clear[top : top + rows, left : left + columns] *= layer.seen[..., 3]
    return 1 - clear[margin:-margin, margin:-margin]


def scenery(stream=0, seed=0, blur_px=0.0, **settings):
    return Scenery(Surroundings(**settings), seed, stream, SHAPE, blur_px)


def calm_and_restless(index, **settings):
    """Renderers of a camera that sees one black cube and no other effects, without and with surroundings."""
    calm = made(hovering(cube(0.3), MIDDLE))
    recipe = msgspec.structs.replace(calm.scenario, surroundings=Surroundings(**settings))
    return CameraRenderer(calm, index), CameraRenderer(replace(calm, scenario=recipe), index)


def lamp_off(one):
    """The share of the light (height, width) that surroundings leave of white light at time 0."""
    white = np.full((*SHAPE, 3), 255, np.uint8)
    one.light(white, 0.0)
    return sensor.undevelop(white)[..., 0]


@pytest.mark.parametrize("share", [0.025, 0.1, 0.4])
def test_screens_and_leaves_cover_the_stated_share(share):
    for stream in range(2):
        (screen,) = scenery(stream, screen=share).layers(1.0)
        lit = screen.seen[..., :3].max(axis=-1) > 0.011
        # Sides are rounded to whole pixels: half a pixel of 40 on each.
        assert np.count_nonzero(lit) == pytest.approx(share * SHAPE[0] * SHAPE[1], rel=0.03)
        leaves = scenery(stream, foliage=share)
        found = [covered(leaves.layers(time_s)).mean() for time_s in np.arange(0, 5, 0.71)]
        # Leaves sway over the border of the image and over each other; measured within 4 %.
        assert np.mean(found) == pytest.approx(share, rel=0.08)


@pytest.mark.parametrize("share", [0.025, 0.4])
def test_leaves_far_apart_sway_independently(share):
    """Leaves that swayed together would all stand still at once; measured 0.49 to 0.80."""
    for stream in range(2):
        leaves = scenery(stream, foliage=share)
        moved = []
        for time_s in np.arange(0, 10, 0.2):
            (now,), (soon,) = leaves.layers(time_s), leaves.layers(time_s + 0.02)
            moved.append(np.abs(soon.seen - now.seen).mean())
        assert min(moved) > 0.4 * max(moved)


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


def test_a_lamp_darkens_half_of_the_image_while_it_is_off():
    calm, restless = calm_and_restless(3, lamp_drop=0.25, lamp_s=(1.0, 2.0))
    for frame in (24, 50):
        np.testing.assert_array_equal(restless.clean_frame(frame), calm.clean_frame(frame))
    for frame in (25, 49):
        before = calm.clean_frame(frame)
        light = sensor.undevelop(restless.clean_frame(frame)) / sensor.undevelop(np.maximum(before, 1))
        bright = light[before.min(axis=-1) > 60].mean(axis=-1)
        # Rounding of grey levels of 60 and more, and of the factor, to 8 bits.
        assert bright.min() == pytest.approx(0.75, abs=0.03)
        assert bright.max() == 1.0
    left = lamp_off(scenery(lamp_drop=0.25, lamp_s=(0.0,)))
    assert np.mean(left < 0.875) == pytest.approx(0.5, abs=0.01)
    edge = (left > 0.76) & (left < 0.99)
    assert 0.02 < edge.mean() < 0.2, "the edge is soft"


def test_the_lamp_darkens_drones_and_scenery_too():
    _, shown = calm_and_restless(0, lamp_drop=1.0, lamp_s=(0.0,), screen=0.1, foliage=0.1)
    dark = lamp_off(shown.scenery) == 0
    assert dark.any()
    assert not shown.clean_frame(5)[dark].any()


def test_the_halves_and_places_differ_between_cameras_and_seeds():
    def light_and_places(stream, seed):
        one = scenery(stream, seed, lamp_drop=0.2, lamp_s=(0.0,), screen=0.03, foliage=0.03)
        return lamp_off(one), [(layer.x, layer.y) for layer in one.layers(0.0)]

    light, places = light_and_places(0, 0)
    for stream, seed in ((1, 0), (0, 1)):
        other_light, other_places = light_and_places(stream, seed)
        assert (other_light != light).mean() > 0.1
        assert other_places != places


def test_drones_are_in_front_and_masks_are_theirs():
    calm, restless = calm_and_restless(0, foliage=0.9, screen=0.25, person=1.0)
    drone = number_image(calm)
    inside = cv2.erode((drone > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert inside.sum() > 100
    for frame in (0, 60):
        assert not restless.clean_frame(frame)[inside].any(), "the cube is black"
        np.testing.assert_array_equal(number_image(restless, frame), drone)


def test_sequences_have_the_same_masks_truth_and_rig(tmp_path):
    recipe = change_scenario(S02, {"cameras": "laboratory_corners"})
    settings = SimulationSettings(num_frames=2, scale=0.04, onboard=False)
    calm = content_of(simulate(recipe, tmp_path / "calm", settings, jobs=1))
    recipe = change_scenario(recipe, RESTLESS)
    restless = content_of(simulate(recipe, tmp_path / "restless", settings, jobs=1))
    assert restless.keys() == calm.keys()
    changed = {name for name in calm if restless[name] != calm[name]}
    assert changed == {"simulation.json", *(name for name in calm if name.endswith(".avi"))}
