"""Sizes from silhouettes: ellipsoids of known size, a float64 oracle for outlines that are none, then how it learns."""

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
#: What a learned length is of a filled ellipsoid's.
LONGER = HALF_PER_STD / 2
RIG = ring_rig(5, image_size_wh=(640, 480))
SIZE_M = np.array([0.5, 0.5, 0.2])
PLACES_M = np.array([[0.0, 0.0, 1.2], [0.7, -0.5, 0.9], [-0.6, 0.4, 1.5], [0.3, 0.8, 1.1], [-0.9, -0.7, 1.0]])

#: Edges of drawn silhouettes are good to a quarter of a pixel, drones are 25 pixels high or more.
DRAWN = 0.01


def images(position_m, size_m=SIZE_M, rig=RIG):
    """(frames, cameras, height, width); positions and sizes are (frames, [drones,] 3)."""
    return np.stack([draw_coverage(rig, at, size_m, PROGRAM.reduction) for at in position_m])


def looks_at(coverage, position_m, believed_m, well_seen=None, rig=RIG):
    """SizeMeasurements at drones where they are, or where they are said to be; NumPy."""
    position_m = position_m if position_m.ndim == 3 else position_m[:, None]
    seen = np.ones(position_m.shape[:2], bool) if well_seen is None else well_seen
    believed_m = np.broadcast_to(believed_m, position_m.shape[1:])
    arrays = float32((position_m, believed_m, rig.cameras))
    return jax.tree.map(
        np.asarray, sizes.measure_sizes(coverage, arrays[0], seen, arrays[1], arrays[2], PROGRAM)
    )


def started(size_m, pinned=(False, False, False)):
    size_m = np.atleast_2d(size_m)
    return sizes.init(
        jnp.asarray(size_m, jnp.float32), np.broadcast_to(pinned, size_m.shape), len(PROGRAM.windows)
    )


def chunk(size_m):
    """SizeMeasurements of one drone that showed these sizes (frames, 3), whatever its windows held."""
    size_m = jnp.asarray(size_m, jnp.float32)[:, None]
    return SizeMeasurements(size_m, jnp.full((*size_m.shape[:2], len(PROGRAM.windows)), 0.5))


@pytest.mark.parametrize(
    ("size_m", "coefficients"), [((0.5, 0.5, 0.2), 0), ((0.35, 0.35, 0.3), 5), ((0.6, 0.6, 0.4), 5)]
)
def test_an_ellipsoid_shows_its_size_wherever_it_is(size_m, coefficients):
    rig = ring_rig(5, image_size_wh=(640, 480), coefficients=coefficients)
    shown = looks_at(images(PLACES_M, np.array(size_m), rig), PLACES_M, size_m, rig=rig).size_m
    # Moments are of bent outlines, boxes of the bent middles of their sides: measured 0.6 % of the height at most.
    np.testing.assert_allclose(shown / size_m, LONGER, rtol=1.5 * DRAWN)


def test_where_the_drone_is_thought_to_be_does_not_matter():
    coverage = images(PLACES_M)
    there = looks_at(coverage, PLACES_M, SIZE_M).size_m
    beside = looks_at(coverage, PLACES_M + np.array([0.03, -0.03, 0.03]), SIZE_M).size_m
    # 5 cm at 3 m and more: distances change by up to 1.5 %, elevations by a degree. Measured 1.6 %, of the height.
    np.testing.assert_allclose(beside, there, rtol=0.025)


def test_low_over_the_floor_nothing_is_learned():
    """What is seen there may be drone and shadow together. The drone is 0.5 m wide."""
    positions = float32(PLACES_M[:, None])
    seen = np.ones((len(PLACES_M), 1), bool)
    shown = [
        sizes.measure_sizes(
            images(PLACES_M), positions, seen, *float32((SIZE_M[None], RIG.cameras)), PROGRAM, *floor
        )
        for floor in ((jnp.float32(0.75),), (jnp.float32(0.0),), ())
    ]
    low = PLACES_M[:, 2] - 0.75 < SIZE_M[0]
    assert 0 < low.sum() < len(low)
    assert np.isnan(shown[0].size_m[low]).all()
    np.testing.assert_array_equal(shown[0].size_m[~low], shown[2].size_m[~low])
    assert_same(shown[1], shown[2])


def outline_halves2(cam, centre_m, size_m):
    """Squared halves of the box of an ellipsoid's outline, from its dual conic P Q* P^T, float64."""
    P = cam.K @ cam.T_cam_world[:3]
    middle = np.concatenate([centre_m, [1.0]])
    Q = np.diag([*np.square(np.asarray(size_m) / 2), 0.0]) - np.outer(middle, middle)
    C = -(P @ Q @ P.T)
    C = C / C[2, 2]
    return np.array([C[0, 2] ** 2 - C[0, 0], C[1, 2] ** 2 - C[1, 1]]), C[:2, 2]


def textbook_size(rig, coverage, centre_m, believed_m):
    """The size that one frame shows: central moments by plain sums, least squares by LAPACK, three times."""
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


def test_any_outline_shows_the_size_that_float64_says():
    """Two beams across: their views differ widely, so that reweighting has something to do."""
    place = PLACES_M[1]
    beams = np.array([[0.6, 0.12, 0.1], [0.12, 0.3, 0.25]])
    coverage = draw_coverage(RIG, np.stack([place, place]), beams, PROGRAM.reduction)
    shown = looks_at(coverage[None], place[None], SIZE_M).size_m[0, 0]
    # float32 sums over 64 x 64 cells of tables in pixels: measured 2e-6.
    np.testing.assert_allclose(shown, textbook_size(RIG, coverage, place, SIZE_M), rtol=2e-5)


def test_windows_are_as_full_as_an_ellipse_fills_them():
    """Corners of 0.4 and 0.7 of the box are within the ellipse (0.7 sqrt 2 < 1); of the box it fills pi / 4."""
    fill = looks_at(images(PLACES_M), PLACES_M, SIZE_M).fill
    expected = np.broadcast_to([1.0, 1.0, np.pi / 4], fill.shape)
    # Seen near and from the side the ellipse leans, so that 0.7 loses corners; a cell is a tenth of the smallest half.
    np.testing.assert_allclose(fill, expected, atol=0.03)


@pytest.mark.parametrize("wrong", [0.8, 1.2])
def test_a_wrong_start_is_mended_within_three_chunks(wrong):
    state = started(wrong * LONGER * SIZE_M)
    coverage = images(PLACES_M)
    for _ in range(3):
        # Five places, five times each: a chunk of 25 frames.
        looks = looks_at(coverage, PLACES_M, np.asarray(state.size_m))
        state = sizes.learn_sizes(state, jax.tree.map(lambda value: jnp.tile(value, (5, 1, 1)), looks))
    # What is left of the start after 75 frames is 5 / 80 of 20 %; its surroundings were measured in wrong windows once.
    np.testing.assert_allclose(state.size_m[0], LONGER * SIZE_M, rtol=0.0125 + DRAWN)
    assert (np.abs(np.asarray(state.size_m)[0] / (LONGER * SIZE_M) - 1) < np.abs(wrong - 1) / 8).all()


def test_a_fifth_of_bad_frames_changes_little():
    """Silhouettes of which the left half is missing, or that have something attached, one frame in five."""
    good = images(PLACES_M)
    bad = good.copy()
    column = np.arange(good.shape[-1])
    for view in bad[2]:
        view[:, column < np.median(np.nonzero(view)[1])] = 0
    five = looks_at(good, PLACES_M, SIZE_M), looks_at(bad, PLACES_M, SIZE_M)
    assert np.abs(five[1].size_m[2] / five[0].size_m[2] - 1).max() > 0.2
    learned = [
        sizes.learn_sizes(
            started(SIZE_M), jax.tree.map(lambda value: jnp.tile(value, (5, 1, 1)), looks)
        ).size_m
        for looks in five
    ]
    # The median is now another of the good frames, which differ by what drawing costs.
    np.testing.assert_allclose(learned[1], learned[0], rtol=2 * DRAWN)


@given(
    st.lists(st.floats(0.9, 1.1), min_size=13, max_size=13),
    st.lists(st.floats(0.01, 100.0), min_size=12, max_size=12),
)
def test_bad_frames_move_nothing_while_they_are_the_fewer(good, bad):
    """Whatever twelve of 25 frames show, the estimate stays among what start and the others say."""
    shown = np.array([*good, *bad])[:, None] * SIZE_M
    learned = np.asarray(sizes.learn_sizes(started(SIZE_M), chunk(shown)).size_m)[0] / SIZE_M
    # Some roundings of float32 logarithms.
    assert (learned >= min(*good, 1.0) - 1e-5).all()
    assert (learned <= max(*good, 1.0) + 1e-5).all()


def test_frames_that_show_nothing_change_nothing():
    state = started(SIZE_M)
    nothing = sizes.learn_sizes(
        state, jax.tree.map(lambda value: value * jnp.nan, chunk(np.tile(SIZE_M, (25, 1))))
    )
    assert_same(nothing, state)
    few = np.full((25, 3), np.nan)
    few[: MIN_FRAMES - 1] = 3 * SIZE_M
    np.testing.assert_array_equal(sizes.learn_sizes(state, chunk(few)).size_m, state.size_m)


@pytest.mark.parametrize(("shown", "bound"), [(100.0, RANGE), (0.01, 1 / RANGE)])
def test_lengths_stay_within_range_of_the_start(shown, bound):
    state = started(SIZE_M)
    for _ in range(3):
        state = sizes.learn_sizes(state, chunk(np.tile(shown * SIZE_M, (25, 1))))
    np.testing.assert_allclose(state.size_m[0], bound * SIZE_M, rtol=1e-6)


@pytest.mark.parametrize(
    ("pinned", "kept"),
    [((True, True, True), (0, 1, 2)), ((False, False, True), (2,)), ((False, True, False), (0, 1))],
)
def test_what_is_pinned_stays(pinned, kept):
    """One level length pins both: they are learned together."""
    state = sizes.learn_sizes(started(SIZE_M, pinned), chunk(np.tile(1.5 * SIZE_M, (25, 1))))
    changed = ~np.isclose(state.size_m[0], SIZE_M, rtol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(~changed), kept)
    np.testing.assert_array_equal(np.asarray(state.std_m)[0] == 0, ~changed)
    assert state.num_frames[0, 0] == 25


def test_level_lengths_change_by_the_same_share():
    state = sizes.learn_sizes(started([0.6, 0.3, 0.2]), chunk(np.tile([0.66, 0.33, 0.2], (25, 1))))
    np.testing.assert_allclose(state.size_m[0, 0] / state.size_m[0, 1], 2.0, rtol=1e-6)


def test_the_height_of_a_flat_drone_seen_from_above_stays_at_the_start():
    """Cameras on the ceiling, straight above: heights change their views by next to nothing."""
    overhead = {}
    for i in range(3):
        R, t_m = look_at((0.3 * i, -0.2 * i, 5.0), (0.3 * i, -0.2 * i + 0.01, 0.0), up=(0.0, 1.0, 0.0))
        K = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
        overhead[f"c{i}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(640, 480))
    rig = make_rig(overhead)
    places = np.array([[0.3, -0.2, 1.0]])
    flat = np.array([0.5, 0.5, 0.08])
    shown = looks_at(images(places, flat, rig), places, flat * [1, 1, 2], rig=rig).size_m[0, 0]
    np.testing.assert_allclose(shown[:2], LONGER * flat[:2], rtol=2 * DRAWN)
    assert np.isnan(shown[2])
    state = sizes.learn_sizes(started(flat * [0.9, 0.9, 2]), chunk(np.tile(shown, (25, 1))))
    np.testing.assert_allclose(state.size_m[0, 2], 2 * flat[2], rtol=1e-6)
    assert state.num_frames[0].tolist() == [25, 25, 0]


def test_what_is_unclear_is_nan_and_nothing_else():
    """Two drones side by side, one that all images cut, one that was not found and is nowhere, one that is alone."""
    at = np.array([[0.9, 0.0, 1.2], [0.9, 0.12, 1.2], [0.1, -0.1, 3.3], [np.nan] * 3, [-0.9, -0.7, 1.0]])
    there = np.isfinite(at).all(axis=-1)
    looks = looks_at(images([at[there]]), at[None], SIZE_M, well_seen=there[None])
    assert np.isfinite(looks.size_m[0]).all(axis=-1).tolist() == [False, False, False, False, True]
    assert np.isfinite(looks.fill[0]).all(axis=-1).tolist() == [False, False, False, False, True]


def test_empty_images_show_nothing():
    blank = np.zeros((1, len(RIG), 240, 320), np.uint8)
    assert np.isnan(looks_at(blank, PLACES_M[:1], SIZE_M).size_m).all()


def test_the_order_of_drones_and_cameras_does_not_matter():
    at = np.array([[[0.8, 0.0, 1.2], [-0.6, 0.4, 1.4], [-0.2, -0.9, 1.0]]])
    believed = np.array([[0.5, 0.5, 0.2], [0.4, 0.4, 0.3], [0.6, 0.6, 0.2]])
    coverage = draw_coverage(RIG, at[0], believed, PROGRAM.reduction)[None]
    order, cameras = [2, 0, 1], [3, 1, 4, 0, 2]
    plain = looks_at(coverage, at, believed)
    other = RIG.select([RIG.names[i] for i in cameras])
    turned = looks_at(coverage[:, cameras], at[:, order], believed[order], rig=other)
    assert np.isfinite(plain.size_m).all()
    # Sums over cameras in another order: a few roundings.
    assert_same(turned, jax.tree.map(lambda value: value[:, order], plain), atol=1e-5)


def test_standard_errors_are_as_large_as_the_errors():
    """Twelve chunks that are off by 5 % each, all their frames alike."""
    rng = np.random.default_rng(5)
    drones = 400
    off = 0.05 * rng.standard_normal((12, drones, 1))
    state = started(np.tile(SIZE_M, (drones, 1)))
    for chunk_off in off:
        shown = np.broadcast_to(SIZE_M * np.exp(chunk_off), (25, drones, 3))
        state = sizes.learn_sizes(
            state, SizeMeasurements(jnp.asarray(shown, jnp.float32), jnp.full((25, drones, 3), 0.5))
        )
    error = np.log(np.asarray(state.size_m) / SIZE_M).std(axis=0)
    stated = np.sqrt(np.square(state.std_m / state.size_m).mean(axis=0))
    # 400 drones tell their errors to 4 %; the start, here exact, counts as a thirteenth chunk that was off by 15 %.
    np.testing.assert_allclose(stated, error, rtol=0.15)


def test_the_profile_is_a_mean_over_all_frames():
    state = started(SIZE_M)
    shown = jnp.asarray(np.tile(SIZE_M, (25, 1)), jnp.float32)[:, None]
    for value, frames in ((0.2, 25), (0.6, 15)):
        state = sizes.learn_sizes(state, SizeMeasurements(shown[:frames], jnp.full((frames, 1, 3), value)))
    np.testing.assert_allclose(state.fill, (25 * 0.2 + 15 * 0.6) / 40, rtol=1e-6)


def test_drones_that_come_later_begin_at_their_own_start():
    before = sizes.learn_sizes(started(SIZE_M), chunk(np.tile(1.1 * SIZE_M, (25, 1))))
    both = sizes.with_added_drones(before, started(2 * SIZE_M))
    assert_same(jax.tree.map(lambda value: value[:1], both), before)
    assert_same(jax.tree.map(lambda value: value[1:], both), started(2 * SIZE_M))
