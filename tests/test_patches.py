"""Windows of the silhouettes: NumPy sums of the whole images and masks of ellipses are the oracles.

Cameras are so far away that metres are pixels where anything is worked out by hand.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import draw_coverage, far_camera, float32, rig_of, ring_rig
from hypothesis import example, given
from hypothesis import strategies as st

from psotrack.boxes import extents
from psotrack.fitness import Scene, ScoreSettings, camera_scores, drone_fitness, filled, scene
from psotrack.patches import CLAIM, CORE, FULL, NUM_LEVELS, NUM_NEIGHBOURS, SIDE, cut
from psotrack.summed_area import box_sum, summed_area_table

RING = ScoreSettings().ring

# Four cameras, one per level: 15 to 188 silhouette pixels from the middle of a drone of 1 m to the ring's border. No
# side of the silhouettes is a multiple of 8.
SHAPE = (213, 301)
PIXELS_PER_M = np.array([20.0, 60.0, 120.0, 250.0])
NOISE = np.random.default_rng(0).integers(0, 256, (4, *SHAPE)).astype(np.uint8)
#: At the middle, beside, over the left upper and right lower borders in most cameras, and out of all images.
PLACES_M = np.array([[0.01, 0, 0.02], [0.53, 0, 0.21], [-1.213, 0, 0.83], [1.24, 0, -0.87], [40.0, 0, 3.0]])
SIZES_M = np.array([[1.0, 1.0, 0.5]]).repeat(5, axis=0)


def far_rig(reduction):
    height, width = SHAPE
    sides = (width * reduction, height * reduction)
    return rig_of(*(far_camera(image_size_wh=sides, pixels_per_m=reduction * ppm) for ppm in PIXELS_PER_M))


def cut_at(rig, images, expected_m, size_m, *, reach_m=0.1, claiming=True, reduction=1):
    """Windows as NumPy arrays."""
    count = len(expected_m)
    reach_m, claiming = np.broadcast_to(reach_m, count), np.broadcast_to(claiming, count)
    arrays = float32((rig.cameras, np.asarray(expected_m), np.asarray(size_m), reach_m))
    return jax.tree.map(np.asarray, _cut(images, *arrays, claiming, reduction))


@partial(jax.jit, static_argnums=6)
def _cut(images, cameras, expected_m, size_m, reach_m, claiming, reduction):
    seen = extents(cameras, size_m)
    return cut(images, seen, expected_m, reach_m=reach_m, claiming=claiming, reduction=reduction, ring=RING)


def pixels(patches):
    """(drones, cameras, rows, columns): the windows themselves, from their tables."""
    windows = np.diff(np.diff(patches.tables, axis=0), axis=2).swapaxes(0, 1)
    return windows.reshape(*patches.x_px.shape, SIDE, SIDE)


def evaluate(function, rig, patches, position_m, size_m, reduction):
    arrays = float32((rig.cameras, np.asarray(position_m), np.asarray(size_m)))
    return jax.tree.map(np.asarray, _evaluate(function, ScoreSettings(reduction=reduction), patches, *arrays))


@partial(jax.jit, static_argnums=(0, 1))
def _evaluate(function, settings, patches, cameras, position_m, size_m):
    return function(Scene(extents(cameras, size_m), patches, settings), position_m)


@partial(jax.jit, static_argnums=(0, 1))
def _evaluate_whole(function, settings, images, cameras, position_m, size_m):
    return function(scene(cameras, size_m, summed_area_table(images), settings), position_m)


def levels(patches, reduction=1):
    return np.log2(patches.pixel_px / reduction).astype(int)


# Windows without claims.


@pytest.mark.parametrize("reduction", [1, 4])
def test_windows_are_sums_of_the_whole_image(reduction):
    """Every pixel of every window is the sum of the silhouette over its area, exactly; nothing beyond the image.

    (Or up to seven pixels beyond, where boxes do not reach.)
    """
    rig = far_rig(reduction)
    patches = cut_at(rig, NOISE, PLACES_M, SIZES_M, claiming=False, reduction=reduction)
    level = levels(patches, reduction)
    np.testing.assert_array_equal(level, np.broadcast_to([0, 1, 2, 3], (5, 4)))
    np.testing.assert_array_equal(patches.full, FULL * 4.0**level)
    np.testing.assert_array_equal(patches.clear, 1)
    assert patches.size_wh_px == (SHAPE[1] * reduction, SHAPE[0] * reduction)
    hanging = 0
    for (drone, camera), window in _each(pixels(patches)):
        cell = 2 ** level[drone, camera]
        column, row = (edge[drone, camera] / reduction for edge in (patches.x_px, patches.y_px))
        # Edges of windows are whole pixels, on the grid of their level.
        assert column % cell == 0
        assert row % cell == 0
        expected, whole, outside = _sums(NOISE[camera], int(row), int(column), cell)
        np.testing.assert_array_equal(window[whole], expected[whole])
        assert not window[outside].any()
        hanging += whole.any() and outside.any()
        # The window is about the drone: its middle lies in the pixel right of and below the window's middle.
        x, y = _middle_px(PLACES_M[drone], PIXELS_PER_M[camera])
        assert 0 <= x / cell - column / cell - SIDE / 2 < 1
        assert 0 <= y / cell - row / cell - SIDE / 2 < 1
    assert hanging > 5
    assert not pixels(patches)[-1, :3].any()


def _each(windows):
    return (((d, c), windows[d, c]) for d in range(windows.shape[0]) for c in range(windows.shape[1]))


def _middle_px(position_m, pixels_per_m):
    """In silhouette pixels, counted from the left upper corner: x is to the right, z is up."""
    return SHAPE[1] / 2 + pixels_per_m * position_m[0], SHAPE[0] / 2 - pixels_per_m * position_m[2]


def _sums(image, row, column, cell):
    """Sums over the window's pixels, which of them lie wholly in the image, and which beyond it and its padding."""
    y, x = row + np.arange(SIDE * cell), column + np.arange(SIDE * cell)

    def within(height, width):
        return ((y >= 0) & (y < height))[:, None] & ((x >= 0) & (x < width))

    def cells(fine):
        return fine.reshape(SIDE, cell, SIDE, cell).sum(axis=(1, 3))

    height, width = image.shape
    values = image[np.clip(y, 0, height - 1)[:, None], np.clip(x, 0, width - 1)].astype(int)
    inside, padded = within(height, width), within(height + -height % 8, width + -width % 8)
    return cells(values * inside), cells(inside) == cell**2, cells(padded) == 0


@given(st.integers(0, 2**16))
def test_boxes_on_the_grid_of_a_window_are_slice_sums(seed):
    """Sums over boxes with edges on whole pixels of the windows are NumPy's of the full-size silhouettes."""
    rng = np.random.default_rng(seed)
    patches = cut_at(far_rig(1), NOISE, PLACES_M, SIZES_M, claiming=False)
    ends = np.sort(rng.integers(0, SIDE + 1, (2, 2, *patches.x_px.shape)), axis=1)
    (x0, x1), (y0, y1) = ends
    edges = float32([side[None] for side in (x0, y0, x1, y1)])
    total = np.asarray(_box_sum(patches.tables, np.arange(20, dtype=np.int32).reshape(5, 4), *edges))[0]
    cell = patches.pixel_px.astype(int)
    for d, c in np.ndindex(total.shape):
        (left, right), (top, bottom) = (
            int(first[d, c]) + cell[d, c] * end[:, d, c]
            for first, end in ((patches.x_px, ends[0]), (patches.y_px, ends[1]))
        )
        if right > SHAPE[1] // 8 * 8 or bottom > SHAPE[0] // 8 * 8:
            continue  # The border divides a pixel: the next test.
        expected = NOISE[c, max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)].sum(dtype=int)
        assert total[d, c] == np.float32(expected)


_box_sum = jax.jit(box_sum)


def test_where_the_border_divides_a_pixel_foreground_counts_in_full():
    """All is foreground: every box is filled, whatever the level, up to the border of an odd image."""
    white = np.full_like(NOISE, 255)
    patches = cut_at(far_rig(1), white, PLACES_M, SIZES_M, claiming=False)
    share = evaluate(filled, far_rig(1), patches, PLACES_M, SIZES_M, 1)
    _, weight = evaluate(camera_scores, far_rig(1), patches, PLACES_M, SIZES_M, 1)
    hanging = (weight > 0.5) & (weight < 0.99)
    assert hanging[:, 1:].any()
    # Edges at 1e6 px of focal length are good to 1e-4 px in float32, boxes are 10 px and more.
    np.testing.assert_allclose(share, weight > 0.5, atol=1e-4)


# Scores, in a room.

REDUCTION = 2
RIG = ring_rig(5, image_size_wh=(324, 244))
TRUTH_M = np.array([[0.3, -0.2, 1.3], [-0.6, 0.5, 0.9]])
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
REACH_M = 0.15


@pytest.mark.parametrize("where", ["in the room", "all about"])
def test_scores_are_those_of_whole_images(where):
    """Within reach of where a drone is expected, windows of the finest level hold all that its score reads."""
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (5, 122, 162)).astype(np.uint8)
    expected_m = TRUTH_M if where == "in the room" else np.array([[2.6, -2.1, 0.1], [0.3, 2.9, 2.9]])
    patches = cut_at(RIG, images, expected_m, SIZE_M, reach_m=REACH_M, claiming=False, reduction=REDUCTION)
    fine = levels(patches, REDUCTION) == 0
    offset = rng.standard_normal((50, 2, 3))
    position_m = expected_m + REACH_M * offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    score, weight = evaluate(camera_scores, RIG, patches, position_m, SIZE_M, REDUCTION)
    arrays = float32((RIG.cameras, position_m, SIZE_M))
    whole = _evaluate_whole(camera_scores, ScoreSettings(reduction=REDUCTION), images, *arrays)
    assert (np.asarray(whole[0])[:, fine] > 0.1).any(axis=0).sum() >= 3
    # Edges of boxes are good to 1e-5 px, of 20 px and more.
    np.testing.assert_allclose(score[:, fine], np.asarray(whole[0])[:, fine], atol=1e-5)
    np.testing.assert_array_equal(weight, whole[1])
    # Some of them hang over the border, and some cameras do not see them.
    assert (
        fine.all() if where == "in the room" else ((weight > 0) & (weight < 1)).any() and (weight == 0).any()
    )


@given(
    st.lists(st.floats(-20, 20, width=32), min_size=6, max_size=6),
    st.floats(0, 5, width=32),
    st.integers(0, 4),
)
def test_all_is_finite_wherever_drones_are_expected(expected_m, reach_m, camera):
    """In the room and out of it, behind cameras and inside of them."""
    images = NOISE[:1, :122, :162].repeat(5, axis=0)
    somewhere = np.array(expected_m).reshape(2, 3)
    at_camera = np.stack([RIG.cameras.centre_world[camera], somewhere[1]])
    for expected in (somewhere, at_camera):
        patches = cut_at(RIG, images, expected, SIZE_M, reach_m=reach_m, reduction=REDUCTION)
        for leaf in jax.tree.leaves(patches):
            assert np.isfinite(leaf).all()
        assert ((patches.clear >= 0) & (patches.clear <= 1)).all()
        assert (patches.tables >= 0).all()
        score, weight = evaluate(camera_scores, RIG, patches, expected, SIZE_M, REDUCTION)
        # Sums are exact to 1e-6 of a box.
        assert ((score >= 0) & (score <= 1 + 1e-5)).all()
        assert ((weight >= 0) & (weight <= 1 + 1e-5)).all()
        T_cam_world = RIG.cameras.T_cam_world
        depth = expected @ T_cam_world[:, 2, :3].T + T_cam_world[:, 2, 3]
        assert not weight[depth < 0].any()
        assert not score[depth < 0].any()
        assert not pixels(patches)[depth < 0].any()


@given(
    st.floats(1, 60),
    st.floats(0, 2, width=32),
    st.tuples(st.floats(0, 2), st.floats(0, 2)),
    st.sampled_from([0.2, 0.5, 1.0]),
)
# 31.7 pixels are needed to every side, and the middle is far to the right in its pixel.
@example(11.04, 0.5, (1.9, 0.3), 0.5)
def test_the_level_is_the_finest_that_holds_ring_and_search(distance_m, reach_m, shift_px, size):
    """A ball on the axis of a camera, wherever in a pixel that is."""
    focal_px, radius_m = 800.0, size / 2
    camera = far_camera(image_size_wh=(640, 480), pixels_per_m=focal_px / distance_m, distance_m=distance_m)
    middle_px = camera.K[:2, 2] + shift_px + 0.5
    camera.K[:2, 2] += shift_px
    image = np.zeros((1, 240, 320), np.uint8)
    patches = cut_at(
        rig_of(camera), image, np.zeros((1, 3)), np.full((1, 3), size), reach_m=reach_m, reduction=REDUCTION
    )
    level, pixel_px = levels(patches, REDUCTION).item(), patches.pixel_px.item()
    # The tangents to a ball from outside of it; displaced by as much as its radius it moves by that much, at most.
    half_px = focal_px * radius_m / np.sqrt(distance_m**2 - radius_m**2)
    needed_px = (RING + reach_m / radius_m) * half_px
    assert 0 <= level < NUM_LEVELS
    slack = 1e-4 * needed_px  # float32
    if needed_px < (SIDE / 2 - 1) * REDUCTION * 2 ** (NUM_LEVELS - 1) - slack:
        for first, middle in zip((patches.x_px, patches.y_px), middle_px, strict=True):
            assert first.item() <= middle - needed_px + slack
            assert first.item() + SIDE * pixel_px >= middle + needed_px - slack
    else:
        assert level == NUM_LEVELS - 1
    # A window half as coarse would not hold it wherever its middle is in a pixel.
    assert level == 0 or needed_px >= (SIDE / 2 - 1) * pixel_px / 2 - slack


# Claims.

#: Halves of a drone of 1 m x 0.5 m, per camera.
HALVES_PX = np.stack([PIXELS_PER_M / 2, PIXELS_PER_M / 4], axis=-1)
#: Two that overlap in every camera, and a third that touches the second one's claim only. No centre of a pixel lies on
#: a border.
CLOSE_M = np.array([[0.013, 0, 0.021], [0.613, 0, 0.171], [1.413, 0, -0.133]])


def ellipse2(drone, camera, patches, middle_m, scale):
    """Squared distance of the pixels of a window from a drone's middle, in halves of its scaled ellipse."""
    cell = patches.pixel_px[drone, camera]
    centres = (np.arange(SIDE) + 0.5) * cell
    x, y = _middle_px(middle_m, PIXELS_PER_M[camera])
    half_x, half_y = scale * HALVES_PX[camera]
    across = (patches.x_px[drone, camera] + centres - x) / half_x
    down = (patches.y_px[drone, camera] + centres - y) / half_y
    return across**2 + down[:, None] ** 2


@pytest.mark.parametrize("claiming", [(True, True, True), (True, False, True), (False, True, False)])
def test_what_neighbours_claim_counts_nothing_but_in_the_core(claiming):
    size_m = SIZES_M[:3]
    patches = cut_at(far_rig(1), NOISE, CLOSE_M, size_m, claiming=np.array(claiming))
    free = pixels(cut_at(far_rig(1), NOISE, CLOSE_M, size_m, claiming=False))
    kept_in_core = left_out = 0
    for (drone, camera), window in _each(pixels(patches)):
        claimed = np.zeros((SIDE, SIDE), bool)
        for other in range(3):
            if other != drone and claiming[other]:
                claimed |= ellipse2(drone, camera, patches, CLOSE_M[other], CLAIM) < 1
        core = ellipse2(drone, camera, patches, CLOSE_M[drone], CORE) < 1
        expected = np.where(claimed & ~core, 0, free[drone, camera])
        np.testing.assert_array_equal(window, expected)
        own = ellipse2(drone, camera, patches, CLOSE_M[drone], 1.0) < 1
        # Both are ratios of whole numbers; float32.
        expected_clear = 1 - (own & claimed).sum() / own.sum()
        assert patches.clear[drone, camera] == pytest.approx(expected_clear, abs=1e-6)
        kept_in_core += (claimed & core).any()
        left_out += (claimed & ~core).any()
    assert left_out >= 4
    assert kept_in_core >= 2


def test_a_claim_by_hand():
    """20 pixels a metre, ellipses of 20 x 10 pixels side by side: the row of their middles, pixel by pixel."""
    white = np.full_like(NOISE, 255)
    # 14 px from one to the other. Claims reach 11.5 px from a middle, cores 7 px.
    expected_m = np.array([[-0.3625, 0, -0.0125], [0.3375, 0, -0.0125]])
    patches = cut_at(far_rig(1), white, expected_m, SIZES_M[:2])
    left, right = pixels(patches)[:, 0]
    # In the window of the left drone the middles are at columns 32.25 and 46.25, a quarter of a pixel below the middle
    # of row 32. There the claim reaches 11.5 sqrt(1 - (0.25 / 5.75)²) = 11.49 to either side, columns 34.76 to 57.74,
    # and the core 7 sqrt(1 - (0.25 / 3.5)²) = 6.98, to column 39.23: pixels 35 to 57 are claimed, 35 to 38 kept.
    expected = np.full(SIDE, 255)
    expected[39:58] = 0
    np.testing.assert_array_equal(left[32], expected)
    # In that of the right one, at 32.25 and 18.25: pixels 7 to 29 are claimed, the core from 25.27 on is kept.
    expected = np.full(SIDE, 255)
    expected[7:25] = 0
    np.testing.assert_array_equal(right[32], expected)


def test_with_one_drone_nothing_changes():
    one, alone = (
        cut_at(far_rig(1), NOISE, CLOSE_M[:1], SIZES_M[:1], claiming=claiming) for claiming in (True, False)
    )
    np.testing.assert_array_equal(one.tables, alone.tables)
    np.testing.assert_array_equal(one.clear, 1)


def test_permuting_drones_permutes_windows():
    order = np.array([2, 0, 1])
    patches, permuted = (cut_at(far_rig(1), NOISE, CLOSE_M[to], SIZES_M[:3]) for to in (np.arange(3), order))
    assert patches.clear.min() < 0.9
    np.testing.assert_array_equal(pixels(permuted), pixels(patches)[order])
    np.testing.assert_array_equal(permuted.clear, patches.clear[order])


def test_only_the_nearest_neighbours_claim():
    """Four stand close enough to claim from the first; the farthest of them is not looked at (a bound on the work)."""
    angle = np.array([0.2, 1.9, 3.4, 5.0])
    away_m = np.array([0.50, 0.55, 0.60, 0.65])
    # Half as high as wide: equally near beside and above is half as far above.
    others = np.stack([away_m * np.cos(angle), 0 * angle, away_m * np.sin(angle) / 2], axis=-1)
    expected_m = np.concatenate([np.zeros((1, 3)), others]) + 0.013
    everybody = cut_at(far_rig(1), NOISE, expected_m, SIZES_M)
    assert NUM_NEIGHBOURS == 3
    for silent in range(1, 5):
        claiming = np.arange(5) != silent
        patches = cut_at(far_rig(1), NOISE, expected_m, SIZES_M, claiming=claiming)
        same = [np.array_equal(*pair) for pair in zip(pixels(patches)[0], pixels(everybody)[0], strict=True)]
        # A nearer one that is silent lets the fourth in; that is another window, too.
        assert same == [silent == 4] * 4
    # Alone, the fourth would claim: it is close.
    alone = cut_at(far_rig(1), NOISE, expected_m, SIZES_M, claiming=np.arange(5) == 4)
    assert (alone.clear[0] < 1).all()


def drawn(*position_m, size_m):
    return draw_coverage(RIG, np.array(position_m), size_m, REDUCTION)


def cut_in_room(images, expected_m, *, claiming, reach_m=REACH_M):
    return cut_at(
        RIG, images, expected_m, SMALL_M, reach_m=reach_m, claiming=np.array(claiming), reduction=REDUCTION
    )


SMALL_M = np.array([[0.4, 0.4, 0.25]]).repeat(2, axis=0)


def test_no_drone_lives_on_the_silhouette_of_another():
    """Two are expected where one is. Who does not claim has no score there; who claims keeps all of his."""
    there = TRUTH_M[0]
    images = drawn(there, size_m=SMALL_M[:1])
    expected_m = np.stack([there, there])
    patches = cut_in_room(images, expected_m, claiming=[True, False])
    _, weight = evaluate(camera_scores, RIG, patches, expected_m, SMALL_M, REDUCTION)
    np.testing.assert_allclose(weight[1], 0, atol=1e-6)
    fitness = evaluate(drone_fitness, RIG, patches, expected_m, SMALL_M, REDUCTION)
    free = cut_in_room(images, expected_m, claiming=False)
    unclaimed = evaluate(drone_fitness, RIG, free, expected_m, SMALL_M, REDUCTION)
    assert np.isnan(fitness[1])
    assert unclaimed[1] == unclaimed[0] == fitness[0] > 0.3


def best_place(patches, about_m, size_m):
    """Where the fitness of each drone is highest: a grid of 9 x 9 x 9, three times finer each time."""
    unit = np.stack(np.meshgrid(*[np.arange(-4, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    best = np.array(about_m, float)
    for step_m in (0.01, 0.003, 0.001, 0.0003):
        places = best + step_m * unit
        fitness = np.nan_to_num(evaluate(drone_fitness, RIG, patches, places, size_m, REDUCTION))
        best = places[fitness.argmax(axis=0), np.arange(len(best))]
    return best


def test_a_neighbour_beside_moves_the_place_less():
    """Drones of 0.4 m, 0.45 m apart, in eight directions: how far the place moves for the neighbour's silhouette."""
    pulls_m = []
    for angle in np.arange(8) * np.pi / 4:
        pair = TRUTH_M[0] + 0.45 * np.array([[0, 0, 0], [np.cos(angle), np.sin(angle), 0.2]])
        both, one = drawn(*pair, size_m=SMALL_M), drawn(pair[0], size_m=SMALL_M[:1])
        alone, without, with_claims = (
            best_place(cut_in_room(images, pair, claiming=claiming), pair, SMALL_M)[0]
            for images, claiming in ((one, False), (both, False), (both, True))
        )
        # A silhouette's pixel is 3 cm: by itself, a drone's place is good to a fraction of it. Measured 5 mm.
        assert np.linalg.norm(alone - pair[0]) < 0.01
        pulls_m.append([np.linalg.norm(place - alone) for place in (without, with_claims)])
    without_m, with_claims_m = np.transpose(pulls_m)
    # Measured: mean 22 mm without claims and 13 mm with them, at most 31 and 22 mm. What a neighbour claims of a
    # drone's own outline is missing there, so that some of the pull remains.
    assert with_claims_m.mean() < 0.75 * without_m.mean()
    assert with_claims_m.max() < 0.026


# Gradients.


def test_gradients_are_those_of_finite_differences():
    """On windows that neighbours claim of, of several levels; in float64."""
    pair = np.array([[0.3, -0.2, 1.3], [0.65, -0.05, 1.4]])
    images = drawn(*pair, size_m=SMALL_M)
    patches = cut_in_room(images, pair, claiming=True, reach_m=0.65)
    assert set(levels(patches, REDUCTION).ravel()) >= {0, 1}
    assert patches.clear.min() < 0.9
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        windows = jax.tree.map(jnp.asarray, patches)
        view = Scene(extents(RIG.cameras, SMALL_M), windows, ScoreSettings(reduction=REDUCTION))

        @jax.jit
        def total(position_m):
            return drone_fitness(view, position_m).sum()

        position_m = pair + 0.013
        gradient = np.asarray(jax.jit(jax.grad(total))(position_m))
        # Smooth but for kinks at pixels' borders, which a micrometre does not meet here; its square is 1e-12, and
        # rounding costs 1e-16 / 1e-6.
        steps = 1e-6 * np.eye(6).reshape(6, 2, 3)
        expected = [(total(position_m + s) - total(position_m - s)) / 2e-6 for s in steps]
    np.testing.assert_allclose(gradient.ravel(), expected, atol=1e-6)
    assert np.abs(gradient).min() > 1e-3


def test_gradients_are_finite_everywhere():
    """Also beyond the windows, at a camera, behind one, and where a neighbour has claimed all."""
    expected_m = np.stack([TRUTH_M[0], TRUTH_M[0]])
    images = drawn(TRUTH_M[0], size_m=SMALL_M[:1])
    patches = cut_in_room(images, expected_m, claiming=[True, False])
    at_cameras = RIG.cameras.centre_world[:4].reshape(2, 2, 3)
    far = expected_m + 3 * np.random.default_rng(0).standard_normal((5, 2, 3))
    places = np.concatenate([expected_m[None], expected_m[None] + 0.03, at_cameras, 1.5 * at_cameras, far])

    def gradient(view, position_m):
        return jax.vmap(jax.grad(lambda where: jnp.nansum(drone_fitness(view, where))))(position_m)

    found = evaluate(gradient, RIG, patches, places, SMALL_M, REDUCTION)
    assert np.isfinite(found).all()
    assert np.abs(found[1, 0]).max() > 0
