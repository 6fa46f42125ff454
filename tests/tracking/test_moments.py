"""What one frame shows of a drone: middles and sizes, against moments in float64; and how sizes are learned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import draw_coverage, float32, ring_rig

from psotrack.geometry import look_at, make_camera, make_extents, make_rig, project_boxes
from psotrack.tracking.swarm.moments import HALF_PER_STD, measure
from psotrack.tracking.swarm.patches import ExpectedDrones, cut, make_pyramid

REDUCTION, RING = 2, 1.5
#: Measured length of a filled ellipsoid divided by its true length.
LENGTH_RATIO = HALF_PER_STD / 2
RIG = ring_rig(5, image_size_wh=(640, 480))
SIZE_M = np.array([0.5, 0.5, 0.2])
PLACES_M = np.array([[0.0, 0.0, 1.2], [0.7, -0.5, 0.9], [-0.6, 0.4, 1.5], [0.3, 0.8, 1.1], [-0.9, -0.7, 1.0]])
#: Relative error of drawn sizes: edges are good to a quarter of a pixel, and drones are at least 25 pixels high.
DRAWING_ERROR = 0.01


def seen_in(coverage, position_m, believed_m, *, known=None, rig=RIG):
    """What a frame (cameras, height, width) shows of drones at positions, with `believed_m` as their sizes."""
    position_m = np.atleast_2d(position_m)
    known = np.ones(len(position_m), bool) if known is None else np.array(known)
    arrays = float32((rig.cameras, position_m, np.broadcast_to(believed_m, position_m.shape)))
    pyramid = jax.tree.map(lambda level: level[0], make_pyramid(coverage[None]))
    return jax.tree.map(np.asarray, _seen(pyramid, *arrays, known))


@jax.jit
def _seen(pyramid, cameras, position_m, size_m, known):
    extents = make_extents(cameras, size_m)
    expected = ExpectedDrones(position_m, jnp.full(len(position_m), 0.1, jnp.float32))
    _, windows = cut(pyramid, extents, expected, reduction=REDUCTION, ring=RING)
    boxes = project_boxes(extents, position_m)
    return measure(windows, boxes, extents, ring=RING, least_filled=0.1, known=known)


def draw(position_m, size_m=SIZE_M, rig=RIG):
    return draw_coverage(rig, position_m, size_m, REDUCTION)


@pytest.mark.parametrize(
    ("size_m", "coefficients"), [((0.5, 0.5, 0.2), 0), ((0.35, 0.35, 0.3), 5), ((0.6, 0.6, 0.4), 5)]
)
def test_an_ellipsoid_has_the_same_measured_size_everywhere(size_m, coefficients):
    rig = ring_rig(5, image_size_wh=(640, 480), coefficients=coefficients)
    shown = np.array(
        [seen_in(draw(at, np.array(size_m), rig), at, size_m, rig=rig).size_ratio[0] for at in PLACES_M]
    )
    # The lens bends outlines: moments are of the bent outline, boxes of the bent middles of the sides.
    np.testing.assert_allclose(shown, LENGTH_RATIO, rtol=2 * DRAWING_ERROR)


@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_wrong_sizes_and_positions_hardly_change_the_measured_size(wrong):
    for at in PLACES_M:
        coverage = draw(at)
        there = seen_in(coverage, at, SIZE_M)
        ratio = seen_in(coverage, at + np.array([0.03, -0.03, 0.03]), wrong * SIZE_M).size_ratio[0]
        # An error of 5 cm at 3 m or more changes distances by up to 1.5 % and elevations by a degree.
        np.testing.assert_allclose(wrong * ratio, there.size_ratio[0], rtol=0.04)


def test_middles_agree_with_moments_in_float64():
    """An outline that is no ellipse: two crossed beams, off the middle of the box."""
    at, beams = PLACES_M[1], np.array([[0.6, 0.12, 0.1], [0.12, 0.3, 0.2]])
    coverage = draw(at + np.array([[0, 0, 0], [0.03, 0.0, 0.02]]), beams)
    seen = seen_in(coverage, at, SIZE_M)
    for camera, image in enumerate(coverage):
        # All foreground is within the ring: plain sums over the image, in pixels; pixel centres are at whole numbers.
        y, x = np.indices(image.shape)
        weight = image / image.sum()
        middle = [(REDUCTION * ((at_px + 0.5) * weight).sum()) - 0.5 for at_px in (x, y)]
        np.testing.assert_allclose(seen.middle_px[0, camera], middle, atol=0.01)
    boxes = jax.jit(project_boxes)(make_extents(*float32((RIG.cameras, SIZE_M[None]))), float32(at[None]))
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
    seen = seen_in(coverage, at, SIZE_M, known=known)
    assert np.isfinite(seen.size_ratio).all(axis=-1).tolist() == [False, False, False, False, True]
    assert np.isfinite(seen.middle_px[4]).all()
    assert np.isnan(seen.box_px[3]).all()
    # Beside each other the drones hide each other's outlines in all cameras but those that look between them.
    assert np.isfinite(seen.middle_px).all(axis=-1).sum(axis=1)[:4].max() <= 1
    empty = seen_in(np.zeros_like(coverage), at, SIZE_M)
    assert np.isnan(empty.size_ratio).all()
    assert np.isnan(empty.middle_px).all()
