"""Windows cut from the silhouettes, compared with NumPy sums over whole images and masks of ellipses; moments in them.

In tests by hand, cameras are so far away that metres are pixels.
"""

import jax
import numpy as np
import pytest
from helpers import draw_coverage, far_camera, float32, make_unnamed_rig, posed, ring_rig, simple_lens
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

from psotrack.geometry import make_extents, project_boxes
from psotrack.tracking.swarm.fitness import camera_scores, drone_fitness, filled_share
from psotrack.tracking.swarm.moments import HALF_PER_STD, measure
from psotrack.tracking.swarm.occlusion import CORE_SCALE, OCCLUDER_SCALE
from psotrack.tracking.swarm.patches import NUM_LEVELS, SIDE, ExpectedDrones, cut

#: In the middle; beside it; over the upper left and lower right borders in most cameras; outside all images.
PLACES_M = np.array([[0.01, 0, 0.02], [0.53, 0, 0.21], [-1.213, 0, 0.83], [1.24, 0, -0.87], [40.0, 0, 3.0]])
SIZES_M = np.array([[1.0, 1.0, 0.5]]).repeat(5, axis=0)


def levels(patches, reduction=1):
    return np.log2(patches.pixel_px / reduction).astype(int)


# Windows without occlusion.


@pytest.mark.parametrize("reduction", [1, 4])
def test_windows_are_means_of_the_whole_image(reduction):
    """Every pixel of every window is the rounded mean of the silhouette over the pixel's area."""
    patches = cut_at(far_rig(reduction), NOISE, PLACES_M, SIZES_M, occluding=None, reduction=reduction)
    level = levels(patches, reduction)
    np.testing.assert_array_equal(level, np.broadcast_to([0, 1, 2, 3], (5, 4)))
    np.testing.assert_array_equal(patches.clear, 1)
    for side_px, cells in zip(patches.size_wh_px, SHAPE[::-1], strict=True):
        np.testing.assert_array_equal(side_px, np.full(4, cells * reduction))
    filled_up = 0
    for (drone, camera), window in enumerate_windows(pixels(patches)):
        cell = 2 ** level[drone, camera]
        column = patches.x_px[drone, camera] / reduction
        row = patches.y_px[drone, camera] / reduction
        # Edges of windows are whole pixels, on the grid of their level.
        assert column % cell == 0
        assert row % cell == 0
        expected = means_over_cells(NOISE[camera], int(row), int(column), cell)
        whole = np.isfinite(expected)
        np.testing.assert_array_equal(window[whole], expected[whole])
        filled_up += whole.any() and not whole.all()
    assert filled_up > 5


def means_over_cells(image, row, column, cell):
    """(SIDE, SIDE), rounded means over a window's pixels; NaN where a pixel reaches out of the image."""
    height, width = image.shape
    wide = np.full((height + 8 * SIDE, width + 8 * SIDE), np.nan)
    wide[:height, :width] = image
    part = wide[row : row + SIDE * cell, column : column + SIDE * cell]
    means = part.reshape(SIDE, cell, SIDE, cell).mean(axis=(1, 3))
    return np.floor(means + 0.5)


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


def scores_at(images, expected_m, position_m):
    """Scores and weights at positions, and which of the windows about expected positions are of the finest level."""
    patches = cut_at(RIG, images, expected_m, SIZE_M, reach_m=REACH_M, occluding=None, reduction=REDUCTION)
    scores, weights = evaluate(camera_scores, RIG, patches, position_m, SIZE_M)
    return scores, weights, levels(patches, REDUCTION) == 0


@pytest.mark.parametrize("expected_m", [TRUTH_M, CORNERS_M], ids=["in the room", "in its corners"])
def test_scores_agree_with_those_from_whole_images(expected_m):
    """Within reach of the expected position, a window of the finest level contains all pixels that the score reads."""
    offset = np.random.default_rng(1).standard_normal((50, 2, 3))
    position_m = expected_m + REACH_M * offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    scores, weights, fine = scores_at(ODD, expected_m, position_m)
    arrays = float32((RIG.cameras, position_m, SIZE_M))
    whole = evaluate_whole(camera_scores, REDUCTION, ODD, *arrays)
    whole_scores, whole_weights = map(np.asarray, whole)
    assert (whole_scores[:, fine] > 0.1).any(axis=0).sum() >= 3
    # Edges of boxes are good to 1e-5 px, and boxes are at least 20 px wide.
    np.testing.assert_allclose(scores[:, fine], whole_scores[:, fine], atol=1e-5)
    np.testing.assert_array_equal(weights, whole_weights)


def test_a_small_image_ends_at_its_own_border():
    """In an array that larger images of other cameras need, a drone beyond a small image's border is not in view."""
    alone, alone_weights, _ = scores_at(ODD, CORNERS_M, CORNERS_M)
    larger = np.pad(ODD, ((0, 0), (0, 30), (0, 40)))
    scores, weights, _ = scores_at(larger, CORNERS_M, CORNERS_M)
    # Some boxes extend over the image border, and some cameras do not see the drones.
    assert ((weights > 0) & (weights < 1)).any()
    assert (weights == 0).any()
    np.testing.assert_array_equal(weights, alone_weights)
    np.testing.assert_allclose(scores[weights > 0], alone[weights > 0], atol=1e-5)


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
    level = levels(patches, REDUCTION).item()
    pixel_px = patches.pixel_px.item()
    # Tangents to a ball from outside. If the ball moves by its radius, its image moves by at most half its width.
    half_px = focal_px * radius_m / np.sqrt(distance_m**2 - radius_m**2)
    needed_px = (RING + reach_m / radius_m) * half_px
    # What a window is sure to contain on every side, wherever its middle is in the pixel.
    around_px = (SIDE / 2 - 1) * pixel_px
    slack = 1e-4 * needed_px  # float32
    assert 0 <= level < NUM_LEVELS
    if level < NUM_LEVELS - 1 or needed_px < around_px - slack:
        first_px = np.array([patches.x_px.item(), patches.y_px.item()])
        last_px = first_px + SIDE * pixel_px
        assert (first_px <= np.maximum(middle_px - needed_px, 0) + slack).all()
        assert (last_px >= np.minimum(middle_px + needed_px, (640, 480)) - slack).all()
    # A window of half the pixel size would not contain the ring and search for every position within a pixel.
    assert level == 0 or needed_px >= around_px / 2 - slack


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
        half_a_pixel = patches.pixel_px[drone, camera] / 2
        covered = np.zeros((SIDE, SIDE), bool)
        for other in np.flatnonzero(occluding):
            if other != drone:
                covered |= ellipse2(drone, camera, patches, CLOSE_M[other], OCCLUDER_SCALE, half_a_pixel) < 1
        core = ellipse2(drone, camera, patches, CLOSE_M[drone], CORE_SCALE) < 1
        occluded = covered & ~core
        shown = free[drone, camera]
        np.testing.assert_array_equal(window, np.where(occluded, 0, shown))
        np.testing.assert_array_equal(found[drone, camera], occluded & (shown >= 128))
        own = ellipse2(drone, camera, patches, CLOSE_M[drone], 1.0) < 1
        border = np.ones_like(own)
        border[1:-1, 1:-1] = False
        if (own & border).any() or not own.any():
            continue  # The image, and the window with it, ends in the drone.
        # The share comes from 128 points of the ellipse, and here from at least 157 pixels: measured 0.015, limit 0.03.
        clear = 1 - (own & covered).sum() / own.sum()
        assert patches.clear[drone, camera] == pytest.approx(clear, abs=0.03)
        kept_in_core += (covered & core).any()
        left_out += found[drone, camera].any()
    assert left_out >= 4
    assert kept_in_core >= 2
    # A single drone is not occluded.
    one = cut_at(far_rig(1), NOISE, CLOSE_M[:1], size_m[:1])
    alone = cut_at(far_rig(1), NOISE, CLOSE_M[:1], size_m[:1], occluding=None)
    np.testing.assert_array_equal(one.tables, alone.tables)
    np.testing.assert_array_equal(one.clear, 1)


def test_a_drone_has_no_score_on_another_drones_silhouette():
    """Two drones are expected at one silhouette: the occluding one keeps its score, the other has no score."""
    rig = ring_rig(8, image_size_wh=(480, 270), radius_m=4.5)
    size_m = np.array([[0.4, 0.4, 0.24]] * 2)
    expected_m = np.array([[0.3, -0.2, 1.3]] * 2)
    images = draw_coverage(rig, expected_m[0], size_m[0], REDUCTION)
    how = {"reach_m": REACH_M, "reduction": REDUCTION}
    occluded = cut_at(rig, images, expected_m, size_m, occluding=[True, False], **how)
    free = cut_at(rig, images, expected_m, size_m, occluding=False, **how)
    _, weight = evaluate(camera_scores, rig, occluded, expected_m, size_m)
    np.testing.assert_allclose(weight[1], 0, atol=1e-6)
    first, second = evaluate(drone_fitness, rig, occluded, expected_m, size_m)
    unoccluded = evaluate(drone_fitness, rig, free, expected_m, size_m)
    assert first > 0.3
    assert np.isnan(second)
    np.testing.assert_allclose(unoccluded, first, atol=1e-6)


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
    for at in ABOUT_M:
        seen = seen_in(draw(at, np.array(size_m), rig), at, size_m, rig=rig)
        # The lens bends outlines: moments are of the bent outline, boxes of the bent middles of the sides.
        np.testing.assert_allclose(seen.size_ratio[0], LENGTH_RATIO, rtol=2 * DRAWING_ERROR)


def test_middles_agree_with_moments_in_float64():
    """An outline that is no ellipse: two crossed beams, off the middle of the box."""
    at = ABOUT_M[1]
    middles_m = at + np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.02]])
    coverage = draw(middles_m, np.array([[0.6, 0.12, 0.1], [0.12, 0.3, 0.2]]))
    seen = seen_in(coverage, at, FLAT_M)
    for camera, image in enumerate(coverage):
        # All foreground is within the ring: plain sums over the image, in pixels; pixel centres are at whole numbers.
        row, column = np.indices(image.shape)
        column, row = np.average(column, weights=image), np.average(row, weights=image)
        middle_px = REDUCTION * np.array([column + 0.5, row + 0.5]) - 0.5
        np.testing.assert_allclose(seen.middle_px[0, camera], middle_px, atol=0.01)


def test_the_height_of_a_flat_drone_seen_from_above_is_not_measured():
    """Cameras on the ceiling look straight down, so the height has almost no effect on their views."""
    cameras, lens = [], simple_lens(500.0, (640, 480))
    for i in range(3):
        place_m, floor_m = (0.3 * i, -0.2 * i, 5.0), (0.3 * i, -0.2 * i + 0.01, 0.0)
        cameras.append(posed(lens, place_m, floor_m, up=(0.0, 1.0, 0.0)))
    rig = make_unnamed_rig(*cameras)
    at, flat = np.array([0.3, -0.2, 1.0]), np.array([0.5, 0.5, 0.08])
    shown = seen_in(draw(at, flat, rig), at, flat, rig=rig).size_ratio[0]
    np.testing.assert_allclose(shown[:2], LENGTH_RATIO, rtol=2 * DRAWING_ERROR)
    assert np.isnan(shown[2])


def test_only_drones_that_are_shown_alone_and_whole_are_measured():
    """Two drones side by side; one that all images cut off; one that is not there; one alone; and empty images."""
    at = np.array([[0.9, 0.0, 1.2], [0.9, 0.12, 1.2], [0.1, -0.1, 3.3], [0.2, 0.9, 1.2], [-0.9, -0.7, 1.0]])
    known = [True, True, True, False, True]
    coverage = draw(at[known])
    seen = seen_in(coverage, at, FLAT_M, known=known)
    assert np.isfinite(seen.size_ratio[4]).all()
    assert np.isnan(seen.size_ratio[:4]).any(axis=-1).all()
    assert np.isfinite(seen.middle_px[4]).all()
    assert np.isnan(seen.box_px[3]).all()
    # Beside each other the drones hide each other's outlines in all cameras but those that look between them.
    num_cameras = np.isfinite(seen.middle_px[..., 0]).sum(axis=1)
    assert num_cameras[:4].max() <= 1
    empty = seen_in(np.zeros_like(coverage), at, FLAT_M)
    assert np.isnan(empty.size_ratio).all()
    assert np.isnan(empty.middle_px).all()
