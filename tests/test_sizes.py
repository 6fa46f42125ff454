"""Sizes from silhouettes: ellipsoids of known size, a float64 oracle for other outlines, and how sizes are learned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same, draw_coverage, float32, ring_rig
from hypothesis import given
from hypothesis import strategies as st

from psotrack.geometry import look_at, make_camera, make_rig
from psotrack.tracking import sizes
from psotrack.tracking.sizes import HALF_PER_STD, MIN_FRAMES, RANGE, SizeMeasurements, SizeProgram

PROGRAM = SizeProgram(reduction=2)
#: Learned length of a filled ellipsoid divided by its true length.
LENGTH_RATIO = HALF_PER_STD / 2
RIG = ring_rig(5, image_size_wh=(640, 480))
SIZE_M = np.array([0.5, 0.5, 0.2])
PLACES_M = np.array([[0.0, 0.0, 1.2], [0.7, -0.5, 0.9], [-0.6, 0.4, 1.5], [0.3, 0.8, 1.1], [-0.9, -0.7, 1.0]])

#: Relative error of drawn sizes: edges are good to a quarter of a pixel, and drones are at least 25 pixels high.
DRAWING_ERROR = 0.01


def images(position_m, size_m=SIZE_M, rig=RIG):
    """Silhouettes, (frames, cameras, height, width), of drones; positions and sizes are (frames, [drones,] 3)."""
    return np.stack([draw_coverage(rig, at, size_m, PROGRAM.reduction) for at in position_m])


def measure(coverage, position_m, believed_m, well_seen=None, rig=RIG):
    """Size measurements, NumPy arrays, of drones at positions (frames, [drones,] 3) with `believed_m` as sizes."""
    position_m = position_m if position_m.ndim == 3 else position_m[:, None]
    seen = np.ones(position_m.shape[:2], bool) if well_seen is None else well_seen
    believed_m = np.broadcast_to(believed_m, position_m.shape[1:])
    arrays = float32((np.where(seen[..., None], position_m, np.nan), believed_m, rig.cameras))
    return jax.tree.map(np.asarray, sizes.measure_sizes(coverage, *arrays, PROGRAM))


def initial_sizes(size_m, pinned=(False, False, False)):
    size_m = np.atleast_2d(size_m)
    return sizes.init(
        jnp.asarray(size_m, jnp.float32), np.broadcast_to(pinned, size_m.shape), len(PROGRAM.windows)
    )


def chunk(size_m):
    """Measurements of one drone with the given sizes (frames, 3); all windows are half full."""
    size_m = jnp.asarray(size_m, jnp.float32)[:, None]
    return SizeMeasurements(size_m, jnp.full((*size_m.shape[:2], len(PROGRAM.windows)), 0.5))


@pytest.mark.parametrize(
    ("size_m", "coefficients"), [((0.5, 0.5, 0.2), 0), ((0.35, 0.35, 0.3), 5), ((0.6, 0.6, 0.4), 5)]
)
@pytest.mark.slow
def test_an_ellipsoid_has_the_same_measured_size_everywhere(size_m, coefficients):
    rig = ring_rig(5, image_size_wh=(640, 480), coefficients=coefficients)
    shown = measure(images(PLACES_M, np.array(size_m), rig), PLACES_M, size_m, rig=rig).size_m
    # The lens bends outlines: moments are of the bent outline, boxes of the bent middles of the sides. Measured 0.6 %.
    np.testing.assert_allclose(shown / size_m, LENGTH_RATIO, rtol=1.5 * DRAWING_ERROR)


def test_the_expected_position_hardly_changes_the_measured_size():
    coverage = images(PLACES_M)
    there = measure(coverage, PLACES_M, SIZE_M).size_m
    beside = measure(coverage, PLACES_M + np.array([0.03, -0.03, 0.03]), SIZE_M).size_m
    # An error of 5 cm at 3 m or more changes distances by up to 1.5 % and elevations by a degree. Measured 1.6 %.
    np.testing.assert_allclose(beside, there, rtol=0.025)


@pytest.mark.slow
def test_close_above_the_floor_nothing_is_learned():
    """Foreground close to the floor may be a drone together with its shadow. The drone is 0.5 m wide."""
    positions = float32(PLACES_M[:, None])
    shown = [
        sizes.measure_sizes(
            images(PLACES_M), positions, *float32((SIZE_M[None], RIG.cameras)), PROGRAM, *floor
        )
        for floor in ((jnp.float32(0.75),), (jnp.float32(0.0),), ())
    ]
    low = PLACES_M[:, 2] - 0.75 < SIZE_M[0]
    assert 0 < low.sum() < len(low)
    assert np.isnan(shown[0].size_m[low]).all()
    np.testing.assert_array_equal(shown[0].size_m[~low], shown[2].size_m[~low])
    assert_same(shown[1], shown[2])


def outline_halves2(cam, centre_m, size_m):
    """Squared half sides (2,) and centre (2,) of the box of an ellipsoid's outline, from its dual conic P Q* P^T."""
    P = cam.K @ cam.T_cam_world[:3]
    middle = np.concatenate([centre_m, [1.0]])
    Q = np.diag([*np.square(np.asarray(size_m) / 2), 0.0]) - np.outer(middle, middle)
    C = -(P @ Q @ P.T)
    C = C / C[2, 2]
    return np.array([C[0, 2] ** 2 - C[0, 0], C[1, 2] ** 2 - C[1, 1]]), C[:2, 2]


def textbook_size(rig, coverage, centre_m, believed_m):
    """The size from one frame: central moments by plain sums, and least squares by LAPACK, three times."""
    rows, values = [], []
    for index in range(len(rig)):
        halves2, middle = outline_halves2(rig.cameras[index], centre_m, believed_m)
        step = 1e-4
        slopes = []
        for scaled in ((1 + step, 1 + step, 1.0), (1.0, 1.0, 1 + step)):
            more, _ = outline_halves2(rig.cameras[index], centre_m, believed_m * np.sqrt(scaled))
            slopes.append((more - halves2) / step)
        slopes = np.stack(slopes, axis=-1)
        height, width = coverage[index].shape
        x, y = ((np.arange(n) + 0.5) * PROGRAM.reduction for n in (width, height))
        inside = [
            np.clip((PROGRAM.ring * half - np.abs(at - m - 0.5)) / PROGRAM.reduction + 0.5, 0, 1)
            for at, m, half in zip((x, y), middle, np.sqrt(halves2), strict=True)
        ]
        share = coverage[index] * inside[0] * inside[1][:, None]
        for axis, at in enumerate((x, y)):
            line = share.sum(axis=axis) / share.sum()
            variance = line @ np.square(at - line @ at) - PROGRAM.reduction**2 / 12
            rows.append(slopes[axis] / slopes[axis].sum())
            values.append(HALF_PER_STD**2 * variance / halves2[axis])
    rows, values, weight = np.array(rows), np.array(values), np.ones(len(values))
    for _ in range(1 + sizes.REWEIGHTINGS):
        root = np.sqrt(weight)[:, None]
        start = np.sqrt(sizes.PRIOR_VIEWS) * np.eye(2)
        factors = np.linalg.lstsq(
            np.concatenate([root * rows, start]),
            np.concatenate([root[:, 0] * values, start.sum(axis=1)]),
        )[0]
        weight = 1 / (1 + np.square((values - rows @ factors) / sizes.VIEW_STD))
    return believed_m * np.sqrt(factors)[[0, 0, 1]]


def test_the_size_of_any_outline_agrees_with_float64():
    """Two crossed beams: the cameras' views differ widely, so reweighting has an effect."""
    place = PLACES_M[1]
    beams = np.array([[0.6, 0.12, 0.1], [0.12, 0.3, 0.25]])
    coverage = draw_coverage(RIG, np.stack([place, place]), beams, PROGRAM.reduction)
    shown = measure(coverage[None], place[None], SIZE_M).size_m[0, 0]
    # float32 sums over 64 x 64 cells of tables in pixels. Measured 2e-6.
    np.testing.assert_allclose(shown, textbook_size(RIG, coverage, place, SIZE_M), rtol=2e-5)


def test_windows_have_the_fill_of_an_ellipse():
    """Windows of 0.4 and 0.7 of the box lie inside the ellipse (0.7 sqrt 2 < 1), which fills pi / 4 of the box."""
    fill = measure(images(PLACES_M), PLACES_M, SIZE_M).fill
    expected = np.broadcast_to([1.0, 1.0, np.pi / 4], fill.shape)
    # A near ellipse seen from the side leans and misses corners of the window of 0.7; cells are a tenth of a half side.
    np.testing.assert_allclose(fill, expected, atol=0.03)


@pytest.mark.parametrize("wrong", [0.8, 1.2])
def test_a_wrong_initial_size_is_corrected_within_three_chunks(wrong):
    state = initial_sizes(wrong * LENGTH_RATIO * SIZE_M)
    coverage = images(PLACES_M)
    for _ in range(3):
        # Five positions, five times each: a chunk of 25 frames.
        measured = measure(coverage, PLACES_M, np.asarray(state.size_m))
        state = sizes.learn_sizes(state, jax.tree.map(lambda value: jnp.tile(value, (5, 1, 1)), measured))
    # After 75 frames, 5 / 80 of the initial error of 20 % remains; the first chunk had windows of a wrong size.
    np.testing.assert_allclose(state.size_m[0], LENGTH_RATIO * SIZE_M, rtol=0.0125 + DRAWING_ERROR)
    assert (np.abs(np.asarray(state.size_m)[0] / (LENGTH_RATIO * SIZE_M) - 1) < np.abs(wrong - 1) / 8).all()


def test_bad_frames_in_a_fifth_of_a_chunk_have_little_effect():
    """In one frame of five, the left half of each silhouette is missing."""
    good = images(PLACES_M)
    bad = good.copy()
    column = np.arange(good.shape[-1])
    for view in bad[2]:
        view[:, column < np.median(np.nonzero(view)[1])] = 0
    pair = measure(good, PLACES_M, SIZE_M), measure(bad, PLACES_M, SIZE_M)
    assert np.abs(pair[1].size_m[2] / pair[0].size_m[2] - 1).max() > 0.2
    learned = [
        sizes.learn_sizes(
            initial_sizes(SIZE_M), jax.tree.map(lambda value: jnp.tile(value, (5, 1, 1)), measured)
        ).size_m
        for measured in pair
    ]
    # The median is another good frame, and good frames differ by the errors of drawing.
    np.testing.assert_allclose(learned[1], learned[0], rtol=2 * DRAWING_ERROR)


@given(
    st.lists(st.floats(0.9, 1.1), min_size=13, max_size=13),
    st.lists(st.floats(0.01, 100.0), min_size=12, max_size=12),
)
def test_a_minority_of_bad_frames_does_not_move_the_size_out_of_the_good_range(good, bad):
    """Twelve of 25 frames have any sizes; the learned size stays between the initial size and the other 13 sizes."""
    shown = np.array([*good, *bad])[:, None] * SIZE_M
    learned = np.asarray(sizes.learn_sizes(initial_sizes(SIZE_M), chunk(shown)).size_m)[0] / SIZE_M
    # Several roundings of float32 logarithms.
    assert (learned >= min(*good, 1.0) - 1e-5).all()
    assert (learned <= max(*good, 1.0) + 1e-5).all()


def test_frames_without_a_measurement_change_nothing():
    state = initial_sizes(SIZE_M)
    nothing = sizes.learn_sizes(
        state, jax.tree.map(lambda value: value * jnp.nan, chunk(np.tile(SIZE_M, (25, 1))))
    )
    assert_same(nothing, state)
    few = np.full((25, 3), np.nan)
    few[: MIN_FRAMES - 1] = 3 * SIZE_M
    np.testing.assert_array_equal(sizes.learn_sizes(state, chunk(few)).size_m, state.size_m)


@pytest.mark.parametrize(("shown", "bound"), [(100.0, RANGE), (0.01, 1 / RANGE)])
def test_lengths_stay_within_a_range_about_the_initial_length(shown, bound):
    state = initial_sizes(SIZE_M)
    for _ in range(3):
        state = sizes.learn_sizes(state, chunk(np.tile(shown * SIZE_M, (25, 1))))
    np.testing.assert_allclose(state.size_m[0], bound * SIZE_M, rtol=1e-6)


@pytest.mark.parametrize(
    ("pinned", "kept"),
    [((True, True, True), (0, 1, 2)), ((False, False, True), (2,)), ((False, True, False), (0, 1))],
)
def test_pinned_lengths_do_not_change(pinned, kept):
    """A pinned horizontal length pins both horizontal lengths, because they are learned together."""
    state = sizes.learn_sizes(initial_sizes(SIZE_M, pinned), chunk(np.tile(1.5 * SIZE_M, (25, 1))))
    changed = ~np.isclose(state.size_m[0], SIZE_M, rtol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(~changed), kept)
    np.testing.assert_array_equal(np.asarray(state.std_m)[0] == 0, ~changed)
    assert state.num_frames[0, 0] == 25


def test_horizontal_lengths_change_by_the_same_factor():
    state = sizes.learn_sizes(initial_sizes([0.6, 0.3, 0.2]), chunk(np.tile([0.66, 0.33, 0.2], (25, 1))))
    np.testing.assert_allclose(state.size_m[0, 0] / state.size_m[0, 1], 2.0, rtol=1e-6)


def test_the_height_of_a_flat_drone_seen_from_above_keeps_its_initial_value():
    """Cameras on the ceiling look straight down, so the height has almost no effect on their views."""
    overhead = {}
    for i in range(3):
        R, t_m = look_at((0.3 * i, -0.2 * i, 5.0), (0.3 * i, -0.2 * i + 0.01, 0.0), up=(0.0, 1.0, 0.0))
        K = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
        overhead[f"c{i}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(640, 480))
    rig = make_rig(overhead)
    places = np.array([[0.3, -0.2, 1.0]])
    flat = np.array([0.5, 0.5, 0.08])
    shown = measure(images(places, flat, rig), places, flat * [1, 1, 2], rig=rig).size_m[0, 0]
    np.testing.assert_allclose(shown[:2], LENGTH_RATIO * flat[:2], rtol=2 * DRAWING_ERROR)
    assert np.isnan(shown[2])
    state = sizes.learn_sizes(initial_sizes(flat * [0.9, 0.9, 2]), chunk(np.tile(shown, (25, 1))))
    np.testing.assert_allclose(state.size_m[0, 2], 2 * flat[2], rtol=1e-6)
    assert state.num_frames[0].tolist() == [25, 25, 0]


def test_only_unclear_drones_have_nan():
    """Two drones side by side; one that all images cut off; one that was not found and has no position; one alone."""
    at = np.array([[0.9, 0.0, 1.2], [0.9, 0.12, 1.2], [0.1, -0.1, 3.3], [np.nan] * 3, [-0.9, -0.7, 1.0]])
    there = np.isfinite(at).all(axis=-1)
    measured = measure(images([at[there]]), at[None], SIZE_M, well_seen=there[None])
    assert np.isfinite(measured.size_m[0]).all(axis=-1).tolist() == [False, False, False, False, True]
    assert np.isfinite(measured.fill[0]).all(axis=-1).tolist() == [False, False, False, False, True]


def test_empty_images_show_nothing():
    blank = np.zeros((1, len(RIG), 240, 320), np.uint8)
    assert np.isnan(measure(blank, PLACES_M[:1], SIZE_M).size_m).all()


def test_the_order_of_drones_and_cameras_does_not_matter():
    at = np.array([[[0.8, 0.0, 1.2], [-0.6, 0.4, 1.4], [-0.2, -0.9, 1.0]]])
    believed = np.array([[0.5, 0.5, 0.2], [0.4, 0.4, 0.3], [0.6, 0.6, 0.2]])
    coverage = draw_coverage(RIG, at[0], believed, PROGRAM.reduction)[None]
    order, cameras = [2, 0, 1], [3, 1, 4, 0, 2]
    plain = measure(coverage, at, believed)
    other = RIG.select([RIG.names[i] for i in cameras])
    turned = measure(coverage[:, cameras], at[:, order], believed[order], rig=other)
    assert np.isfinite(plain.size_m).all()
    # Sums over cameras have another order, with a few different roundings.
    assert_same(turned, jax.tree.map(lambda value: value[:, order], plain), atol=1e-5)


def test_standard_errors_agree_with_the_errors():
    """Twelve chunks with independent errors of 5 %; all frames of a chunk have the same error."""
    rng = np.random.default_rng(5)
    drones = 400
    off = 0.05 * rng.standard_normal((12, drones, 1))
    state = initial_sizes(np.tile(SIZE_M, (drones, 1)))
    for chunk_off in off:
        shown = np.broadcast_to(SIZE_M * np.exp(chunk_off), (25, drones, 3))
        state = sizes.learn_sizes(
            state, SizeMeasurements(jnp.asarray(shown, jnp.float32), jnp.full((25, drones, 3), 0.5))
        )
    error = np.log(np.asarray(state.size_m) / SIZE_M).std(axis=0)
    stated = np.sqrt(np.square(state.std_m / state.size_m).mean(axis=0))
    # The error of 400 drones is good to 4 %; the exact initial size counts as a thirteenth chunk with an error of 15 %.
    np.testing.assert_allclose(stated, error, rtol=0.15)


def test_the_fill_is_a_mean_over_all_frames():
    state = initial_sizes(SIZE_M)
    shown = jnp.asarray(np.tile(SIZE_M, (25, 1)), jnp.float32)[:, None]
    for value, frames in ((0.2, 25), (0.6, 15)):
        state = sizes.learn_sizes(state, SizeMeasurements(shown[:frames], jnp.full((frames, 1, 3), value)))
    np.testing.assert_allclose(state.fill, (25 * 0.2 + 15 * 0.6) / 40, rtol=1e-6)


def test_added_drones_begin_with_their_own_initial_size():
    before = sizes.learn_sizes(initial_sizes(SIZE_M), chunk(np.tile(1.1 * SIZE_M, (25, 1))))
    both = sizes.with_added_drones(before, initial_sizes(2 * SIZE_M))
    assert_same(jax.tree.map(lambda value: value[:1], both), before)
    assert_same(jax.tree.map(lambda value: value[1:], both), initial_sizes(2 * SIZE_M))
