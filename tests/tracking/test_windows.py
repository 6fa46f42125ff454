"""Windows cut from the silhouettes, compared with NumPy sums over whole images and masks of ellipses; moments in them.

In tests by hand, cameras are so far away that metres are pixels.
"""

import jax
import numpy as np
import pytest
from helpers import draw_coverage, far_camera, float32, make_unnamed_rig, ring_rig
from hypothesis import example, given
from hypothesis import strategies as st
from windows import (
    NOISE,
    PIXELS_PER_M,
    RING,
    SHAPE,
    cut_at,
    enumerate_windows,
    evaluate,
    evaluate_whole,
    far_rig,
    middle_px,
    occluded_pixels,
    pixels,
    pyramid_of,
)

from psotrack.geometry import look_at, make_camera, make_extents, make_rig, project_boxes
from psotrack.tracking.swarm.fitness import camera_scores, drone_fitness, filled_share
from psotrack.tracking.swarm.moments import HALF_PER_STD, measure
from psotrack.tracking.swarm.occlusion import CORE_SCALE, NUM_NEIGHBOURS, OCCLUDER_SCALE
from psotrack.tracking.swarm.patches import NUM_LEVELS, SIDE, ExpectedDrones, cut

#: In the middle; beside it; over the upper left and lower right borders in most cameras; outside all images.
PLACES_M = np.array([[0.01, 0, 0.02], [0.53, 0, 0.21], [-1.213, 0, 0.83], [1.24, 0, -0.87], [40.0, 0, 3.0]])
SIZES_M = np.array([[1.0, 1.0, 0.5]]).repeat(5, axis=0)


def levels(patches, reduction=1):
    return np.log2(patches.pixel_px / reduction).astype(int)


# Windows without occlusion.


@pytest.mark.parametrize("reduction", [1, 4])
def test_windows_are_means_of_the_whole_image(reduction):
    """Every pixel of every window is the rounded mean of the silhouette over the pixel's area.

    Windows stay within the image, which is padded by up to seven pixels. An image that is smaller than a window is
    filled up with 0.
    """
    rig = far_rig(reduction)
    patches = cut_at(rig, NOISE, PLACES_M, SIZES_M, occluding=None, reduction=reduction)
    level = levels(patches, reduction)
    np.testing.assert_array_equal(level, np.broadcast_to([0, 1, 2, 3], (5, 4)))
    np.testing.assert_array_equal(patches.clear, 1)
    for side_px, cells in zip(patches.size_wh_px, SHAPE[::-1], strict=True):
        np.testing.assert_array_equal(side_px, np.full(4, cells * reduction))
    moved = filled_up = 0
    for (drone, camera), window in enumerate_windows(pixels(patches)):
        cell = 2 ** level[drone, camera]
        column, row = (edge[drone, camera] / reduction for edge in (patches.x_px, patches.y_px))
        # Edges of windows are whole pixels, on the grid of their level.
        assert column % cell == 0
        assert row % cell == 0
        expected, whole, outside = _means(NOISE[camera], int(row), int(column), cell)
        np.testing.assert_array_equal(window[whole], expected[whole])
        assert not window[outside].any()
        filled_up += whole.any() and outside.any()
        # The drone's middle is in the pixel to the right of and below the window's middle, where there is image.
        for middle, first, length in zip(
            middle_px(PLACES_M[drone], PIXELS_PER_M[camera]), (column, row), SHAPE[::-1], strict=True
        ):
            padding = -length % 8 if cell > 1 else 0
            last = max((length + padding) / cell - SIDE, 0)
            assert first / cell == np.clip(np.floor(middle / cell) - SIDE // 2, 0, last)
            moved += first in (0, last * cell)
    assert moved > 5
    assert filled_up > 5


def _means(image, row, column, cell):
    """Means over the window's pixels; masks of pixels wholly inside the image, and of pixels beyond its padding."""
    y, x = row + np.arange(SIDE * cell), column + np.arange(SIDE * cell)

    def within(height, width):
        return ((y >= 0) & (y < height))[:, None] & ((x >= 0) & (x < width))

    def cells(fine):
        return fine.reshape(SIDE, cell, SIDE, cell).sum(axis=(1, 3))

    height, width = image.shape
    values = image[np.clip(y, 0, height - 1)[:, None], np.clip(x, 0, width - 1)].astype(int)
    inside, padded = within(height, width), within(height + -height % 8, width + -width % 8)
    rounded = (2 * cells(values * inside) + cell**2) // (2 * cell**2)
    return rounded, cells(inside) == cell**2, cells(padded) == 0


def test_at_the_image_border_a_divided_pixel_counts_in_full():
    """In images that are all foreground, every box is full at every level, up to the border of an odd image."""
    white = np.full_like(NOISE, 255)
    patches = cut_at(far_rig(1), white, PLACES_M, SIZES_M, occluding=None)
    share = evaluate(filled_share, far_rig(1), patches, PLACES_M, SIZES_M)
    _, weight = evaluate(camera_scores, far_rig(1), patches, PLACES_M, SIZES_M)
    hanging = (weight > 0.5) & (weight < 0.99)
    assert hanging[:, 1:].any()
    # With a focal length of 1e6 px, edges are good to 1e-4 px in float32; boxes are at least 10 px wide.
    np.testing.assert_allclose(share, weight > 0.5, atol=1e-4)


# Scores in a room.

REDUCTION = 2
RIG = ring_rig(5, image_size_wh=(324, 244))
TRUTH_M = np.array([[0.3, -0.2, 1.3], [-0.6, 0.5, 0.9]])
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
REACH_M = 0.15
#: The silhouettes are noise of odd sides.
ODD = NOISE[:1, :122, :162].repeat(5, axis=0)
#: In the corners of the room, where some cameras see a part of a drone, and some none.
CORNERS_M = np.array([[2.6, -2.1, 0.1], [0.3, 2.9, 2.9]])


@pytest.mark.parametrize("where", ["in the room", "all about"])
def test_scores_agree_with_those_from_whole_images(where):
    """Within reach of the expected position, a window of the finest level contains all pixels that the score reads."""
    expected_m = TRUTH_M if where == "in the room" else CORNERS_M
    patches = cut_at(RIG, ODD, expected_m, SIZE_M, reach_m=REACH_M, occluding=None, reduction=REDUCTION)
    fine = levels(patches, REDUCTION) == 0
    offset = np.random.default_rng(1).standard_normal((50, 2, 3))
    position_m = expected_m + REACH_M * offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    score, weight = evaluate(camera_scores, RIG, patches, position_m, SIZE_M)
    arrays = float32((RIG.cameras, position_m, SIZE_M))
    whole = evaluate_whole(camera_scores, REDUCTION, ODD, *arrays)
    assert (np.asarray(whole[0])[:, fine] > 0.1).any(axis=0).sum() >= 3
    # Edges of boxes are good to 1e-5 px, and boxes are at least 20 px wide.
    np.testing.assert_allclose(score[:, fine], np.asarray(whole[0])[:, fine], atol=1e-5)
    np.testing.assert_array_equal(weight, whole[1])
    # Outside the room, some boxes extend over the image border, and some cameras do not see the drones.
    assert (
        fine.all() if where == "in the room" else ((weight > 0) & (weight < 1)).any() and (weight == 0).any()
    )


def test_a_small_image_ends_at_its_own_border():
    """In an array that larger images of other cameras need, a drone beyond a small image's border is not in view."""
    (alone, alone_weight), (score, weight) = (
        scores_at(images, CORNERS_M, CORNERS_M) for images in (ODD, np.pad(ODD, ((0, 0), (0, 30), (0, 40))))
    )
    assert ((alone_weight > 0) & (alone_weight < 1)).any()
    np.testing.assert_array_equal(weight, alone_weight)
    np.testing.assert_allclose(score[alone_weight > 0], alone[alone_weight > 0], atol=1e-5)


def scores_at(images, expected_m, position_m):
    how = {"reach_m": REACH_M, "occluding": None, "reduction": REDUCTION}
    return evaluate(camera_scores, RIG, cut_at(RIG, images, expected_m, SIZE_M, **how), position_m, SIZE_M)


@given(
    st.lists(st.floats(-20, 20, width=32), min_size=6, max_size=6),
    st.floats(0, 5, width=32),
    st.integers(0, 4),
)
def test_scores_are_finite_for_any_expected_position(expected_m, reach_m, camera):
    """Expected positions inside and outside the room, behind cameras, and at a camera's centre."""
    somewhere = np.array(expected_m).reshape(2, 3)
    at_camera = np.stack([RIG.cameras.centre_world[camera], somewhere[1]])
    for expected in (somewhere, at_camera):
        patches = cut_at(RIG, ODD, expected, SIZE_M, reach_m=reach_m, reduction=REDUCTION)
        for leaf in jax.tree.leaves(patches):
            assert np.isfinite(leaf).all()
        assert ((patches.clear >= 0) & (patches.clear <= 1)).all()
        assert (patches.tables >= 0).all()
        score, weight = evaluate(camera_scores, RIG, patches, expected, SIZE_M)
        # Sums are exact to 1e-6 of a box's area.
        assert ((score >= 0) & (score <= 1 + 1e-5)).all()
        assert ((weight >= 0) & (weight <= 1 + 1e-5)).all()
        T_cam_world = RIG.cameras.T_cam_world
        depth = expected @ T_cam_world[:, 2, :3].T + T_cam_world[:, 2, 3]
        assert not weight[depth < 0].any()


@given(
    st.floats(1, 60),
    st.floats(0, 2, width=32),
    st.tuples(st.floats(0, 2), st.floats(0, 2)),
    st.sampled_from([0.2, 0.5, 1.0]),
)
# 31.7 pixels are needed on every side, and the middle is far to the right in its pixel.
@example(11.04, 0.5, (1.9, 0.3), 0.5)
def test_the_level_is_the_finest_that_contains_ring_and_search(distance_m, reach_m, shift_px, size):
    """A ball on the optical axis, for any position of the axis within a pixel."""
    focal_px, radius_m = 800.0, size / 2
    camera = far_camera(image_size_wh=(640, 480), pixels_per_m=focal_px / distance_m, distance_m=distance_m)
    middle_px = camera.K[:2, 2] + shift_px + 0.5
    camera.K[:2, 2] += shift_px
    image = np.zeros((1, 240, 320), np.uint8)
    patches = cut_at(
        make_unnamed_rig(camera),
        image,
        np.zeros((1, 3)),
        np.full((1, 3), size),
        reach_m=reach_m,
        reduction=REDUCTION,
    )
    level, pixel_px = levels(patches, REDUCTION).item(), patches.pixel_px.item()
    # Tangents to a ball from outside. If the ball moves by its radius, its image moves by at most half its width.
    half_px = focal_px * radius_m / np.sqrt(distance_m**2 - radius_m**2)
    needed_px = (RING + reach_m / radius_m) * half_px
    sides_px = (640, 480)
    assert 0 <= level < NUM_LEVELS
    slack = 1e-4 * needed_px  # float32
    if needed_px < (SIDE / 2 - 1) * REDUCTION * 2 ** (NUM_LEVELS - 1) - slack:
        for first, middle, side_px in zip((patches.x_px, patches.y_px), middle_px, sides_px, strict=True):
            assert first.item() <= max(middle - needed_px, 0) + slack
            assert first.item() + SIDE * pixel_px >= min(middle + needed_px, side_px) - slack
    else:
        assert level == NUM_LEVELS - 1
    # A window of half the pixel size would not contain the ring and search for every position within a pixel.
    assert level == 0 or needed_px >= (SIDE / 2 - 1) * pixel_px / 2 - slack


# --- occlusion between drones: the windows against masks of ellipses in NumPy, and the effect on the score's maximum

#: (cameras, 2), half lengths of the ellipse of a drone of 1 m x 0.5 m, silhouette pixels.
HALVES_PX = np.stack([PIXELS_PER_M / 2, PIXELS_PER_M / 4], axis=-1)
#: Two drones that overlap in every camera, and a third drone that touches only the occluding ellipse of the second. No
#: pixel's centre lies on the border of an ellipse.
CLOSE_M = np.array([[0.013, 0, 0.021], [0.613, 0, 0.171], [1.413, 0, -0.133]])


def ellipse2(drone, camera, patches, middle_m, scale, wider_px=0.0):
    """(rows, columns), squared distance of a window's pixels from a drone's middle; 1 is on its scaled ellipse."""
    cell = patches.pixel_px[drone, camera]
    centres = (np.arange(SIDE) + 0.5) * cell
    x, y = middle_px(middle_m, PIXELS_PER_M[camera])
    half_x, half_y = scale * HALVES_PX[camera] + wider_px
    across = (patches.x_px[drone, camera] + centres - x) / half_x
    down = (patches.y_px[drone, camera] + centres - y) / half_y
    return across**2 + down[:, None] ** 2


@pytest.mark.parametrize("occluding", [(True, True, True), (True, False, True), (False, True, False)])
def test_foreground_that_neighbours_cover_is_occluded_except_in_the_core(occluding):
    size_m = SIZES_M[:3]
    patches = cut_at(far_rig(1), NOISE, CLOSE_M, size_m, occluding=np.array(occluding))
    free = pixels(cut_at(far_rig(1), NOISE, CLOSE_M, size_m, occluding=None))
    found = occluded_pixels(patches)
    kept_in_core = left_out = 0
    for (drone, camera), window in enumerate_windows(pixels(patches)):
        covered = np.zeros((SIDE, SIDE), bool)
        for other in range(3):
            if other != drone and occluding[other]:
                half_a_pixel = patches.pixel_px[drone, camera] / 2
                covered |= ellipse2(drone, camera, patches, CLOSE_M[other], OCCLUDER_SCALE, half_a_pixel) < 1
        core = ellipse2(drone, camera, patches, CLOSE_M[drone], CORE_SCALE) < 1
        occluded = covered & ~core
        np.testing.assert_array_equal(window, np.where(occluded, 0, free[drone, camera]))
        np.testing.assert_array_equal(found[drone, camera], occluded & (free[drone, camera] >= 128))
        own = ellipse2(drone, camera, patches, CLOSE_M[drone], 1.0) < 1
        if own[[0, -1]].any() or own[:, [0, -1]].any() or not own.any():
            continue  # The image, and the window with it, ends in the drone.
        # The share comes from 128 points of the ellipse, and here from at least 157 pixels: measured 0.015, limit 0.03.
        assert patches.clear[drone, camera] == pytest.approx(1 - (own & covered).sum() / own.sum(), abs=0.03)
        kept_in_core += (covered & core).any()
        left_out += found[drone, camera].any()
    assert left_out >= 4
    assert kept_in_core >= 2
    # A single drone is not occluded.
    one, alone = (cut_at(far_rig(1), NOISE, CLOSE_M[:1], size_m[:1], occluding=each) for each in (True, None))
    np.testing.assert_array_equal(one.tables, alone.tables)
    np.testing.assert_array_equal(one.clear, 1)
    assert one.packed is alone.packed is False


def test_only_the_nearest_neighbours_occlude():
    """Four drones are close enough to occlude the first; the farthest of the four is ignored, to limit the work."""
    angle = np.array([0.2, 1.9, 3.4, 5.0])
    away_m = np.array([0.50, 0.55, 0.60, 0.65])
    # Drones are half as high as wide, so a distance above counts twice as much as a distance to the side.
    others = np.stack([away_m * np.cos(angle), 0 * angle, away_m * np.sin(angle) / 2], axis=-1)
    expected_m = np.concatenate([np.zeros((1, 3)), others]) + 0.013
    all_occluding = cut_at(far_rig(1), NOISE, expected_m, SIZES_M)
    assert NUM_NEIGHBOURS == 3
    for excluded in range(1, 5):
        occluding = np.arange(5) != excluded
        patches = cut_at(far_rig(1), NOISE, expected_m, SIZES_M, occluding=occluding)
        same = [
            np.array_equal(*pair) for pair in zip(pixels(patches)[0], pixels(all_occluding)[0], strict=True)
        ]
        # If one of the three nearer drones does not occlude, the fourth occludes instead, which changes the window.
        assert same == [excluded == 4] * 4
    # Without the nearer drones, the fourth occludes: it is close enough.
    alone = cut_at(far_rig(1), NOISE, expected_m, SIZES_M, occluding=np.arange(5) == 4)
    assert (alone.clear[0] < 1).all()


def test_a_drone_has_no_score_on_another_drones_silhouette():
    """Two drones are expected at one silhouette: the occluding one keeps its score, the other has no score."""
    rig = ring_rig(8, image_size_wh=(480, 270), radius_m=4.5)
    size_m, expected_m = np.array([[0.4, 0.4, 0.24]] * 2), np.array([[0.3, -0.2, 1.3]] * 2)
    images = draw_coverage(rig, expected_m[0], size_m[0], REDUCTION)
    occluded, free = (
        cut_at(rig, images, expected_m, size_m, reach_m=REACH_M, reduction=REDUCTION, occluding=occluding)
        for occluding in ([True, False], False)
    )
    _, weight = evaluate(camera_scores, rig, occluded, expected_m, size_m)
    np.testing.assert_allclose(weight[1], 0, atol=1e-6)
    fitness = evaluate(drone_fitness, rig, occluded, expected_m, size_m)
    unoccluded = evaluate(drone_fitness, rig, free, expected_m, size_m)
    assert np.isnan(fitness[1])
    np.testing.assert_allclose([fitness[0], *unoccluded], fitness[0], atol=1e-6)
    assert fitness[0] > 0.3


# --- what one frame shows of a drone: middles and sizes, against moments in float64

#: Measured length of a filled ellipsoid divided by its true length.
LENGTH_RATIO = HALF_PER_STD / 2
LARGE_RIG = ring_rig(5, image_size_wh=(640, 480))
FLAT_M = np.array([0.5, 0.5, 0.2])
ABOUT_M = np.array([[0.0, 0.0, 1.2], [0.7, -0.5, 0.9], [-0.6, 0.4, 1.5], [0.3, 0.8, 1.1], [-0.9, -0.7, 1.0]])
#: Relative error of drawn sizes: edges are good to a quarter of a pixel, and drones are at least 25 pixels high.
DRAWING_ERROR = 0.01


def seen_in(coverage, position_m, believed_m, *, known=None, rig=LARGE_RIG):
    """What a frame (cameras, height, width) shows of drones at positions, with `believed_m` as their sizes."""
    position_m = np.atleast_2d(position_m)
    known = np.ones(len(position_m), bool) if known is None else np.array(known)
    size_m = np.broadcast_to(believed_m, position_m.shape)
    return jax.tree.map(np.asarray, _seen(coverage, *float32((rig.cameras, position_m, size_m)), known))


@jax.jit
def _seen(coverage, cameras, position_m, size_m, known):
    extents = make_extents(cameras, size_m)
    expected = ExpectedDrones(position_m, np.full(len(position_m), 0.1, np.float32))
    _, windows = cut(pyramid_of(coverage), extents, expected, reduction=REDUCTION, ring=RING)
    boxes = project_boxes(extents, position_m)
    return measure(windows, boxes, extents, ring=RING, least_filled=0.1, known=known)


def draw(position_m, size_m=FLAT_M, rig=LARGE_RIG):
    return draw_coverage(rig, position_m, size_m, REDUCTION)


@pytest.mark.parametrize(
    ("size_m", "coefficients"), [((0.5, 0.5, 0.2), 0), ((0.35, 0.35, 0.3), 5), ((0.6, 0.6, 0.4), 5)]
)
def test_an_ellipsoid_has_the_same_measured_size_everywhere(size_m, coefficients):
    rig = ring_rig(5, image_size_wh=(640, 480), coefficients=coefficients)
    shown = np.array(
        [seen_in(draw(at, np.array(size_m), rig), at, size_m, rig=rig).size_ratio[0] for at in ABOUT_M]
    )
    # The lens bends outlines: moments are of the bent outline, boxes of the bent middles of the sides.
    np.testing.assert_allclose(shown, LENGTH_RATIO, rtol=2 * DRAWING_ERROR)


@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_wrong_sizes_and_positions_hardly_change_the_measured_size(wrong):
    for at in ABOUT_M:
        coverage = draw(at)
        there = seen_in(coverage, at, FLAT_M)
        ratio = seen_in(coverage, at + np.array([0.03, -0.03, 0.03]), wrong * FLAT_M).size_ratio[0]
        # An error of 5 cm at 3 m or more changes distances by up to 1.5 % and elevations by a degree.
        np.testing.assert_allclose(wrong * ratio, there.size_ratio[0], rtol=0.04)


def test_middles_agree_with_moments_in_float64():
    """An outline that is no ellipse: two crossed beams, off the middle of the box."""
    at, beams = ABOUT_M[1], np.array([[0.6, 0.12, 0.1], [0.12, 0.3, 0.2]])
    coverage = draw(at + np.array([[0, 0, 0], [0.03, 0.0, 0.02]]), beams)
    seen = seen_in(coverage, at, FLAT_M)
    for camera, image in enumerate(coverage):
        # All foreground is within the ring: plain sums over the image, in pixels; pixel centres are at whole numbers.
        y, x = np.indices(image.shape)
        weight = image / image.sum()
        middle = [(REDUCTION * ((at_px + 0.5) * weight).sum()) - 0.5 for at_px in (x, y)]
        np.testing.assert_allclose(seen.middle_px[0, camera], middle, atol=0.01)
    boxes = jax.jit(project_boxes)(
        make_extents(*float32((LARGE_RIG.cameras, FLAT_M[None]))), float32(at[None])
    )
    expected = [boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half]
    np.testing.assert_allclose(seen.box_px, np.stack(expected, axis=-1), atol=1e-3)


def test_the_height_of_a_flat_drone_seen_from_above_is_not_measured():
    """Cameras on the ceiling look straight down, so the height has almost no effect on their views."""
    overhead = {}
    for i in range(3):
        R, t_m = look_at((0.3 * i, -0.2 * i, 5.0), (0.3 * i, -0.2 * i + 0.01, 0.0), up=(0.0, 1.0, 0.0))
        K = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
        overhead[f"c{i}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(640, 480))
    rig, at, flat = make_rig(overhead), np.array([0.3, -0.2, 1.0]), np.array([0.5, 0.5, 0.08])
    shown = seen_in(draw(at, flat, rig), at, flat, rig=rig).size_ratio[0]
    np.testing.assert_allclose(shown[:2], LENGTH_RATIO, rtol=2 * DRAWING_ERROR)
    assert np.isnan(shown[2])


def test_only_drones_that_are_shown_alone_and_whole_are_measured():
    """Two drones side by side; one that all images cut off; one that is not there; one alone; and empty images."""
    at = np.array([[0.9, 0.0, 1.2], [0.9, 0.12, 1.2], [0.1, -0.1, 3.3], [0.2, 0.9, 1.2], [-0.9, -0.7, 1.0]])
    known = [True, True, True, False, True]
    coverage = draw(at[known])
    seen = seen_in(coverage, at, FLAT_M, known=known)
    assert np.isfinite(seen.size_ratio).all(axis=-1).tolist() == [False, False, False, False, True]
    assert np.isfinite(seen.middle_px[4]).all()
    assert np.isnan(seen.box_px[3]).all()
    # Beside each other the drones hide each other's outlines in all cameras but those that look between them.
    assert np.isfinite(seen.middle_px).all(axis=-1).sum(axis=1)[:4].max() <= 1
    empty = seen_in(np.zeros_like(coverage), at, FLAT_M)
    assert np.isnan(empty.size_ratio).all()
    assert np.isnan(empty.middle_px).all()
