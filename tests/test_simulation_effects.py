"""What each effect of `scenarios.Imaging` does to pictures, against formulas and geometry of other origin."""

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
from psotrack.simulation.imaging import reflections, sensor, shadows
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.world.lighting import AMBIENT

S02 = scenario("S02_D4_A")
#: Edges without stairs, and nothing else.
PLAIN = Imaging(
    shutter_s=0.0,
    lens_blur_px=0.0,
    shadows=False,
    contact_shadows=False,
    reflections=0.0,
    exposure_drift=0.0,
    white_balance_drift=0.0,
    flicker=0.0,
    read_noise=0.0,
    shot_noise=0.0,
)
BLACK = (0.0, 0.0, 0.0)


def imaging(**changes):
    return msgspec.structs.replace(PLAIN, **changes)


@pytest.fixture(scope="module")
def scene():
    return build(S02, scale=0.25)


def renderer(scene, settings, *placed, index=0):
    """The camera of a scene with other settings, and with only these drones: (model, flight, paint) each."""
    recipe = msgspec.structs.replace(scene.scenario, imaging=settings)
    return CameraRenderer(with_drones(replace(scene, scenario=recipe), *placed), index)


def standing(model, position_m, paint=BLACK):
    return model, straight_flight(position_m), paint


def share_covered(scene, settings, *placed, index=0):
    """(height, width): the share of the backdrop's light that black drones take away."""
    one = renderer(scene, settings, *placed, index=index)
    empty = sensor.undevelop(sensor.develop(one.backdrop.light)).sum(axis=-1)
    return 1 - sensor.undevelop(one.clean_frame(0)).sum(axis=-1) / empty


def moments(weight):
    """Mean (x, y) and variance along x and y."""
    rows, columns = np.indices(weight.shape)
    mean = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    variance = [
        (weight * (axis - middle) ** 2).sum() for axis, middle in zip((columns, rows), mean, strict=True)
    ]
    return mean, np.array(variance) / weight.sum()


def test_grey_levels_survive_the_way_to_light_and_back():
    levels = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=-1)
    back = sensor.develop(sensor.undevelop(levels))
    # Level 1 is a hundred-thousandth of the light of level 255: black.
    np.testing.assert_array_equal(back[0, 2:], levels[0, 2:])


# --- off is off


def test_with_everything_off_there_are_only_the_colours_of_the_room_and_of_the_drones(scene):
    settings = imaging(antialiasing=False)
    one = renderer(scene, settings, standing(cube(0.3), (0.3, -0.2, 1.4)))
    frame, empty = one.clean_frame(0), sensor.develop(one.backdrop.light)
    covered = drone_masks(one.scene, one.cam, one.backdrop.depth_m, 0) > 0
    assert covered.sum() > 300
    # A black body under samples at pixel centres: pixels are either its or the room's.
    assert not frame[covered].any()
    np.testing.assert_array_equal(frame[~covered], empty[~covered])
    np.testing.assert_array_equal(one.frame(0), frame)


@pytest.mark.parametrize(
    ("effect", "places"),
    [
        ({"antialiasing": True}, "edges"),
        ({"lens_blur_px": 1.0}, "edges"),
        ({"shadows": True}, "floor"),
        ({"contact_shadows": True}, "floor"),
        ({"reflections": 0.04}, "floor"),
    ],
)
def test_an_effect_of_optics_changes_something_and_only_where_it_should(scene, effect, places):
    cubes = standing(cube(0.3), (0.3, -0.2, 0.4))
    without = imaging(antialiasing=False)
    off = renderer(scene, without, cubes)
    on = renderer(scene, msgspec.structs.replace(without, **effect), cubes)
    changed = (off.clean_frame(0) != on.clean_frame(0)).any(axis=-1)
    assert changed.sum() > 100
    if places == "floor":
        assert not changed[~off.backdrop.floor].any()


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
def test_an_effect_of_the_sensor_changes_something_and_is_all_there_is(effect):
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), (0, 0), 2)
    off, on = (sensor.Sensor(settings, 0, 0, (48, 64)) for settings in (PLAIN, imaging(**effect)))
    np.testing.assert_array_equal(off.expose(image, 3, 0.12), image)
    assert (on.expose(image, 3, 0.12) != image).mean() > 0.2


def test_frames_are_the_same_alone_and_in_any_order_with_everything_on(scene):
    settings = msgspec.structs.replace(Imaging(), jpeg_quality=60, flicker=0.3, exposure_drift=0.05)
    recipe = msgspec.structs.replace(S02, imaging=settings)
    everything = replace(scene, scenario=recipe)
    one, other = CameraRenderer(everything, 2), CameraRenderer(everything, 2)
    forwards = [one.frame(frame) for frame in (5, 90)]
    backwards = [other.frame(frame) for frame in (90, 5)]
    np.testing.assert_array_equal(forwards, backwards[::-1])


# --- optics


@pytest.mark.parametrize("sigma_px", [1.0, 2.0])
def test_the_lens_widens_what_it_draws_by_its_variance(scene, sigma_px):
    placed = standing(cube(0.2), (0.3, -0.2, 1.4))
    x, y = pixel_of(scene, 0, (0.3, -0.2, 1.4)).astype(int)
    window = np.s_[y - 24 : y + 25, x - 24 : x + 25]
    widths = []
    for blur_px in (0.0, sigma_px):
        widths.append(moments(share_covered(scene, imaging(lens_blur_px=blur_px), placed)[window])[1])
    # The tails of the blur are rounded off with 8 bits: measured 0.94 to 0.97 of the variance.
    np.testing.assert_allclose(np.subtract(*widths[::-1]), sigma_px**2, rtol=0.1)


def test_motion_blur_is_as_long_as_the_way_during_the_exposure(scene):
    speed_m_s, shutter_s = 4.0, 1 / 40
    along = np.array(scene.rig.cameras[0].T_cam_world)[0, :3]  # the camera's own x axis
    flight = straight_flight((0.3, -0.2, 1.4), tuple(speed_m_s * along))
    still, moving = (
        share_covered(scene, imaging(shutter_s=time_s), (cube(0.1), flight, BLACK))
        for time_s in (0.0, shutter_s)
    )
    frozen = share_covered(scene, PLAIN, standing(cube(0.1), (0.3, -0.2, 1.4)))
    np.testing.assert_array_equal(still, frozen)
    x, y = pixel_of(scene, 0, (0.3, -0.2, 1.4)).astype(int)
    window = np.s_[y - 20 : y + 21, x - 20 : x + 21]
    (middle, before), (moved, after) = moments(still[window]), moments(moving[window])
    depth_m = project(scene.rig.cameras[0], np.array([0.3, -0.2, 1.4]))[1]
    length_px = float(scene.rig.cameras.K[0, 0, 0] / depth_m * speed_m_s * shutter_s)
    # Eight positions, evenly over the way L, have the variance L^2 / 12 (1 - 1 / 64).
    assert after[0] - before[0] == pytest.approx(length_px**2 / 12 * 63 / 64, rel=0.1)  # 8 bits at the rim
    assert after[1] - before[1] == pytest.approx(0, abs=0.1)
    np.testing.assert_allclose(moved, middle, atol=0.1)


def test_a_drone_without_rotors_is_drawn(scene):
    bare = replace(cube(0.3), rotor_centres_m=np.zeros((0, 3)), rotor_radii_m=np.zeros(0))
    settings = msgspec.structs.replace(Imaging(), exposure_drift=0.0)
    frame = renderer(scene, settings, standing(bare, (0.3, -0.2, 0.4))).clean_frame(0)
    x, y = pixel_of(scene, 0, (0.3, -0.2, 0.4)).round().astype(int)
    assert not frame[y, x].any()


# --- the floor as a mirror


def test_the_share_that_is_mirrored_is_that_of_glass():
    """Fresnel's equations for unpolarised light, refractive index 1.5: 4 % at normal incidence."""
    index = 1.5
    cosine = np.linspace(0, 1, 50)
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (inside - index * cosine) / (inside + index * cosine)
    exact = (across**2 + along**2) / 2
    schlick = reflections.fresnel(cosine, 0.04)
    assert schlick[-1] == pytest.approx(0.04)
    assert schlick[0] == pytest.approx(1.0)
    # It is an approximation, within a few hundredths; measured 0.03 at most.
    np.testing.assert_allclose(schlick, exact, atol=0.04)


def test_the_floor_mirrors_more_where_it_is_seen_at_a_lower_angle(scene):
    one = renderer(scene, imaging(reflections=0.1))
    eye = -one.cam.R.T @ one.cam.t_m
    for floor_m in ((-1.5, -1.0, 0.0), (0.5, 0.0, 0.0), (2.5, 2.0, 0.0)):
        x, y = pixel_of(scene, 0, floor_m).round().astype(int)
        cosine = eye[2] / np.linalg.norm(eye - floor_m)
        # Half a pixel is up to a percent of the distance here.
        assert one.mirror.share[y, x] == pytest.approx(0.1 + 0.9 * (1 - cosine) ** 5, rel=0.02)
    assert not one.mirror.share[~one.backdrop.floor].any()


@pytest.mark.parametrize("index", [0, 4, 6])
def test_a_mirror_image_is_where_the_drone_would_be_below_the_floor(scene, index):
    centre = np.array([0.3, -0.2, 0.9])
    one = renderer(
        scene, imaging(reflections=0.5, lens_blur_px=0.5), standing(cube(0.3), centre), index=index
    )
    change = sensor.undevelop(one.clean_frame(0)) - sensor.undevelop(sensor.develop(one.backdrop.light))
    # A black body takes away mirrored light: the share of it is what the mirror image covers.
    covered = -change.sum(axis=-1) / np.maximum(one.mirror.share * one.mirror.light.sum(axis=-1), 1e-3)
    corners = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * 0.15 + centre
    below = corners * [1, 1, -1]
    pixels = cv2.projectPoints(below, cv2.Rodrigues(one.cam.R)[0], one.cam.t_m, one.cam.K, None)[0][:, 0]
    (x, y), reach = pixels.mean(axis=0).round().astype(int), 24
    window = np.s_[y - reach : y + reach + 1, x - reach : x + reach + 1]
    covered = np.where(covered[window] > 0.03, covered[window], 0)
    shape = cv2.moments(cv2.convexHull((64 * pixels).round().astype(np.int32)))
    expected = np.array([shape["m10"], shape["m01"]]) / shape["m00"] / 64
    # 8 bits, four passes over a rim of some 60 pixels, and the mean of those passes: measured 0.10 px at most.
    np.testing.assert_allclose(moments(covered)[0] + [x - reach, y - reach], expected, atol=0.15)
    assert covered.sum() == pytest.approx(shape["m00"] / 64**2, rel=0.08)
    assert drone_masks(one.scene, one.cam, one.backdrop.depth_m, 0)[y, x] == 0


@pytest.mark.parametrize("height_m", [0.7, 1.2])
def test_a_rough_floor_blurs_what_it_mirrors_the_more_the_higher_it_is(scene, monkeypatch, height_m):
    centre, rough_rad = np.array([0.3, -0.2, height_m]), 0.02
    x, y = pixel_of(scene, 0, centre * [1, 1, -1]).astype(int)
    window = np.s_[y - 24 : y + 25, x - 24 : x + 25]
    widths = []
    for roughness_rad in (0.0, rough_rad):
        monkeypatch.setattr(reflections, "ROUGHNESS_RAD", roughness_rad)
        one = renderer(scene, imaging(reflections=0.5), standing(cube(0.3), centre))
        change = sensor.undevelop(one.clean_frame(0)) - sensor.undevelop(sensor.develop(one.backdrop.light))
        covered = -change.sum(axis=-1) / (one.mirror.share * one.mirror.light.sum(axis=-1) + 1e-9)
        widths.append(moments(covered[window])[1])
    # A direction that is off by an angle at the floor is off by the floor's share of the way at the eye.
    eye_m = -one.cam.R.T @ one.cam.t_m
    sigma_px = rough_rad * one.cam.K[0, 0] * height_m / (height_m + eye_m[2])
    # The tails of the blur are rounded off with 8 bits: measured 0.92 to 0.95 of the variance.
    np.testing.assert_allclose(np.subtract(*widths[::-1]), sigma_px**2, rtol=0.15)


def test_a_rough_floor_blurs_the_room_the_more_the_farther_behind_it(scene, monkeypatch):
    """What stands on it not at all; what is half as far behind it as the eye is before it, by a third of the most."""
    rough = renderer(scene, imaging(reflections=0.5)).mirror
    monkeypatch.setattr(reflections, "ROUGHNESS_RAD", 0.0)
    one = renderer(scene, imaging(reflections=0.5))
    smooth = one.mirror
    beyond = 1 - one.backdrop.depth_m / smooth.depth_m
    blurred = cv2.GaussianBlur(smooth.light, (0, 0), 0.006 * one.cam.K[0, 0] / 3)
    foot, third = (one.backdrop.floor & (np.abs(beyond - share) < 0.01) for share in (0.0, 1 / 3))
    assert min(foot.sum(), third.sum()) > 100
    # Within 0.01 of those shares: measured 0.001 and 0.004, of light up to 3.
    np.testing.assert_allclose(rough.light[foot], smooth.light[foot], atol=0.01)
    np.testing.assert_allclose(rough.light[third], blurred[third], atol=0.01)
    assert np.abs(blurred - smooth.light)[third].max() > 0.1, "an edge, or the test would say nothing"


@pytest.mark.parametrize(("beyond_m", "seen"), [(-0.6, True), (0.6, False)])
def test_mirrored_furniture_hides_what_is_behind_it(scene, beyond_m, seen):
    pillar = np.array([-1.975, 2.875, 0.0])
    index, found = 1, None
    one = renderer(scene, imaging(reflections=0.5), index=index)
    for height_m in np.arange(0.3, 2.0, 0.1):
        pixel = pixel_of(scene, index, pillar - [0, 0, height_m])
        x, y = pixel.round().astype(int)
        if (
            5 < x < one.cam.width - 5
            and 5 < y < one.cam.height - 5
            and one.backdrop.floor[y - 4 : y + 5, x - 4 : x + 5].all()
        ):
            found = pixel, height_m
            break
    assert found, "the foot of a pillar must be mirrored somewhere"
    pixel, height_m = found
    ray = one.cam.R.T @ np.linalg.inv(one.cam.K) @ [*pixel, 1.0]
    depth_m = project(scene.rig.cameras[index], pillar - [0, 0, height_m])[1]
    eye = -one.cam.R.T @ one.cam.t_m
    position = (eye + (depth_m + beyond_m) * ray) * [1, 1, -1]
    with_cube = renderer(scene, imaging(reflections=0.5), standing(cube(0.15), position), index=index)
    x, y = pixel.round().astype(int)
    darker = sensor.develop(one.backdrop.light)[y, x].astype(int) - with_cube.clean_frame(0)[y, x]
    assert (darker.max() > 10) == seen


def test_shadows_dim_only_what_the_floor_does_not_mirror(scene):
    model, at_m = cube(0.4), np.array([1.0, -0.5, 0.5])
    one = renderer(scene, imaging(reflections=0.5, shadows=True), standing(model, at_m))
    dull = renderer(scene, imaging(shadows=True), standing(model, at_m))
    gain = one.shadows.floor_gain(0.0)
    row, column = np.unravel_index(gain.argmin(), gain.shape)
    cell_m = 10.0 / gain.shape[1]
    foot = np.array([(column + 0.5) * cell_m - 5.0, 4.0 - (row + 0.5) * cell_m, 0.0])
    checked = 0
    for aside in ((0.0, 0.0), (-0.25, 0.0), (-0.3, 0.2), (0.0, -0.3)):
        point = foot + np.array([*aside, 0.0])
        x, y = pixel_of(scene, 0, point).round().astype(int)
        # Only where neither the cube nor its mirror image is before the floor.
        cubes = [pixel_of(scene, 0, at_m * [1, 1, sign]) for sign in (1, -1)]
        if min(np.hypot(*(cube_px - [x, y])) for cube_px in cubes) < 26:
            continue
        i, j = int((4.0 - point[1]) / cell_m), int((point[0] + 5.0) / cell_m)
        share = one.mirror.share[y, x]
        expected = gain[i, j] * (1 - share) * dull.backdrop.light[y, x] + share * one.mirror.light[y, x]
        # A pixel is four cells wide, and two roundings to 8 bits.
        np.testing.assert_allclose(sensor.undevelop(one.clean_frame(0))[y, x], expected, rtol=0.04)
        checked += 1
    assert checked >= 1
    assert gain.min() < 0.9


# --- contact shadows


@pytest.mark.parametrize("height_m", [0.06, 0.2, 0.6])
def test_ambient_light_that_a_thing_blocks_is_what_random_rays_hit(height_m):
    """Rays from floor points, as many as the cosine of their angle says (Malley's method)."""
    cell_m, half = 0.02, 100
    outline = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    outline[half - 8 : half + 7, half - 3 : half + 13] = 0.6
    low, high = np.array([-3.5, -8.5]) * cell_m, np.array([12.5, 6.5]) * cell_m  # x and y of its edges
    blocked = shadows.ambient_blocked(outline, cell_m, height_m)
    rng = np.random.default_rng(1)
    radius, angle = np.sqrt(rng.uniform(size=200_000)), rng.uniform(0, 2 * np.pi, 200_000)
    reach = height_m * radius / np.sqrt(1 - radius**2)
    rays = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=-1)
    for column, row in ((0, 0), (5, -1), (13, 0), (20, 10), (-30, 4)):
        at = rays + np.array([column, row]) * cell_m
        expected = 0.6 * np.mean(np.all((at > low) & (at < high), axis=-1))
        # 200,000 rays know a share to 0.001; measured 0.0011 at most.
        assert blocked[half + row, half + column] == pytest.approx(expected, abs=0.004)


def test_under_the_middle_of_a_disc_the_blocked_share_is_the_known_form_factor():
    cell_m, half, radius_m, height_m = 0.02, 120, 0.3, 0.4
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1] * cell_m
    disc = (np.hypot(rows, columns) < radius_m).astype(np.float32)
    blocked = shadows.ambient_blocked(disc, cell_m, height_m)
    # 0.01 is a third of a cell at the rim.
    assert blocked[half, half] == pytest.approx(radius_m**2 / (radius_m**2 + height_m**2), abs=0.01)


def square_above(side_m, height_m):
    """Form factor of a level square whose middle is straight above: four times that of its quarter, by its corner."""
    half = side_m / 2
    slant = np.hypot(half, height_m)
    return 4 * 2 * half / slant * np.arctan(half / slant) / (2 * np.pi)


def test_contact_shadows_are_dark_on_the_floor_and_gone_above(scene):
    side_m, foot = 0.3, np.array([0.41, 0.21, 0.0])  # in the middle of a cell
    all_light = scene.room.panels.on_faces(foot, np.array([[0.0, 0.0, 1.0]]))[0]
    for height_m in (0.05, 0.15, 0.35, 0.7):
        flying = standing(cube(side_m), (*foot[:2], height_m + side_m / 2))
        gain = renderer(scene, imaging(contact_shadows=True), flying).shadows.floor_gain(0.0)
        expected = 1 - AMBIENT / all_light * square_above(side_m, height_m)
        # The outline is up to a cell of 0.01 m wider: 7 % of what is blocked.
        assert gain.min() == pytest.approx(expected, abs=0.08 * (1 - expected) + 0.002)
    high = standing(cube(side_m), (*foot[:2], 1.9))
    assert renderer(scene, imaging(contact_shadows=True), high).shadows.floor_gain(0.0).min() == 1.0


def test_a_rotor_lets_three_quarters_of_the_light_through(scene):
    radius_m, height_m, foot = 0.3, 0.3, np.array([0.41, 0.21, 0.0])
    rotor = replace(cube(0.01), rotor_radii_m=np.array([radius_m]))
    flying = standing(rotor, (*foot[:2], height_m))
    gain = renderer(scene, imaging(contact_shadows=True), flying).shadows.floor_gain(0.0)
    all_light = scene.room.panels.on_faces(foot, np.array([[0.0, 0.0, 1.0]]))[0]
    expected = 1 - AMBIENT / all_light * 0.25 * radius_m**2 / (radius_m**2 + height_m**2)
    # A cell of 0.01 m at its rim is 7 % of it.
    assert gain.min() == pytest.approx(expected, abs=0.08 * (1 - expected))


@pytest.mark.parametrize("yaw_rad", [0.0, 0.6, -1.1])
def test_shadows_turn_with_their_drone(scene, yaw_rad):
    bar = replace(cube(0.3), triangles_m=cube(0.3).triangles_m * [2.0, 0.2, 0.2])
    flight = replace(straight_flight((0.4, 0.2, 0.08)), heading=Heading(yaw_rad))
    one = renderer(scene, imaging(contact_shadows=True), (bar, flight, BLACK))
    lost = 1 - one.shadows.floor_gain(0.0)
    assert lost.max() > 0.1
    # Rows of the floor's map count down where y counts up.
    rows, columns = np.indices(lost.shape)
    spread = np.cov(np.stack([columns, -rows]).reshape(2, -1), aweights=lost.ravel())
    angle_rad = np.arctan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1]) / 2
    # The axis of a bar of 30 x 3 cells.
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
    settings = imaging(flicker=flicker, mains_hz=mains_hz, shutter_s=shutter_s)
    during_s = time_s + shutter_s * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    lamps = 1 - flicker * np.cos(2 * np.pi * mains_hz * during_s + phase_rad / 2) ** 2
    # The midpoint rule's error is (pi / 4000)^2 / 6 for so few waves per step; means over time are 1 - flicker / 2.
    expected = lamps.mean() / (1 - flicker / 2)
    assert sensor.flicker_gain(settings, phase_rad, time_s) == pytest.approx(expected, abs=1e-5)


def test_lamps_beat_slowly_with_frames_and_not_at_all_at_whole_half_waves():
    frames_s = np.arange(0, 50, 0.04)
    slow = [sensor.flicker_gain(imaging(flicker=0.4, shutter_s=1 / 500), 0.3, t) for t in frames_s]
    slow = np.array(slow)
    # Lamps at 100.04 Hz, frames at 25: a beat of 0.04 Hz, 625 frames long.
    np.testing.assert_allclose(slow[625:], slow[:-625], atol=1e-6)
    assert np.ptp(slow[:625]) == pytest.approx(0.4 / (1 - 0.2) * np.sinc(0.2), rel=0.01)
    assert np.abs(np.diff(slow)).max() < 0.003
    whole = [
        sensor.flicker_gain(imaging(flicker=0.4, shutter_s=0.01, mains_hz=50.0), 0.3, t) for t in frames_s
    ]
    np.testing.assert_allclose(whole, 1.0, atol=1e-12)


def test_all_cameras_see_the_same_lamps():
    gains = [sensor.Sensor(imaging(flicker=0.4), 5, stream, (8, 8)).gains(1.23) for stream in (0, 3, 1001)]
    np.testing.assert_array_equal(gains, [gains[0]] * 3)
    assert sensor.Sensor(imaging(flicker=0.4), 6, 0, (8, 8)).gains(1.23)[0] != gains[0][0]


@pytest.mark.parametrize("effect", ["exposure_drift", "white_balance_drift"])
def test_drift_has_its_standard_deviation_and_is_slow(effect):
    sigma = 0.02
    sensors = [sensor.Sensor(imaging(**{effect: sigma}), 0, stream, (8, 8)) for stream in range(400)]
    gains = np.array([[one.gains(time_s) for time_s in (3.0, 50.0, 200.0, 1000.0)] for one in sensors]) - 1
    # 400 cameras at four times, far apart: 1600 numbers, or more, know a standard deviation to 2 %.
    assert gains.std() == pytest.approx(sigma, rel=0.06)
    assert abs(gains.mean()) < 4 * sigma / np.sqrt(1600)
    if effect == "exposure_drift":
        assert np.ptp(gains, axis=-1).max() < 1e-12, "all channels alike"
    else:
        np.testing.assert_allclose(gains.mean(axis=-1), 0, atol=1e-12)  # colours change, brightness does not
    course = np.array([sensors[0].gains(t) for t in np.arange(0, 60, 0.04)])
    # The fastest of the sinusoids takes 5 s: their sum cannot change by more than this in a frame.
    assert np.abs(np.diff(course, axis=0)).max() < 0.04 * 2 * np.pi / 5 * sigma * np.sqrt(2 * 6) * np.sqrt(
        1.5
    )
    assert course.std() > 0.2 * sigma


def test_gains_are_gains_of_light():
    one = sensor.Sensor(imaging(exposure_drift=0.1, white_balance_drift=0.1), 2, 1, (16, 16))
    image = np.full((16, 16, 3), 150, np.uint8)
    for time_s in (0.0, 7.0, 31.0):
        ratio = sensor.undevelop(one.expose(image, 0, time_s)) / sensor.undevelop(image)
        # Half a grey level of 150 is 0.33 %, times gamma in light.
        np.testing.assert_allclose(ratio[0, 0], one.gains(time_s), rtol=0.008)


# --- noise and JPEG


@pytest.mark.parametrize(("read", "shot"), [(1.0, 3.0), (0.0, 5.0), (2.5, 0.0)])
@pytest.mark.parametrize("level", [16, 100, 220])
def test_the_variance_of_noise_is_that_of_reading_plus_that_of_light(read, shot, level):
    one = sensor.Sensor(imaging(read_noise=read, shot_noise=shot), 0, 0, (120, 160))
    image = np.full((120, 160, 3), level, np.uint8)
    frames = np.stack([one.expose(image, frame, frame / 25) for frame in range(8)]).astype(float)
    # Rounding to whole grey levels adds 1/12. Of 460,000 numbers, neighbours share some; measured within 2 %.
    assert frames.var() == pytest.approx(read**2 + shot**2 * level / 255 + 1 / 12, rel=0.05)
    assert frames.mean() == pytest.approx(level, abs=0.1)


def blockiness(image):
    """How much more neighbours differ across the borders of JPEG's blocks than within them."""
    steps = np.abs(np.diff(image.astype(float), axis=1)).mean(axis=(0, 2))
    border = np.arange(len(steps)) % 8 == 7
    return steps[border].mean() / steps[~border].mean()


def test_blocks_show_more_the_lower_the_quality(scene):
    image = renderer(scene, imaging(lens_blur_px=1.0), standing(cube(0.3), (0.3, -0.2, 1.4))).clean_frame(0)
    found = [
        blockiness(sensor.Sensor(imaging(jpeg_quality=quality), 0, 0, image.shape[:2]).expose(image, 0, 0.0))
        for quality in (0, 90, 40, 10)
    ]
    assert found[0] < 1.1
    assert found[0] < found[1] < found[2] < found[3]
    assert found[3] > 1.5
