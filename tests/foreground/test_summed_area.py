"""Box sums, compared with sums of area weights in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pixel_sums import area_weighted_sum

from psotrack.foreground.silhouettes import LOW_BITS, box_sum, pack, packed_box_sums, summed_area_table


@jax.jit
def box_sums(images, boxes):
    """`box_sum` of (sets, cameras, 4) boxes."""
    table = summed_area_table(images)
    x0, y0, x1, y1 = jnp.moveaxis(boxes, -1, 0)
    return box_sum(table, jnp.arange(len(images)), x0, y0, x1, y1)


@jax.jit
def packed_sums(low, high, boxes):
    """`packed_box_sums` of (boxes, 4) boxes in two images of one camera."""
    table = summed_area_table(pack(low, high)[None])
    x0, y0, x1, y1 = jnp.moveaxis(boxes, -1, 0)
    camera = jnp.zeros(len(boxes), jnp.int32)
    return packed_box_sums(table, camera, x0, y0, x1, y1)


box_edges = st.tuples(*[st.floats(-5, 25, width=32)] * 4)


@given(st.lists(box_edges, min_size=6, max_size=6), st.integers(0, 2**16))
def test_box_sums_are_area_weighted_sums(edges, seed):
    """Boxes of any kind, also empty, in the wrong order or outside, in three cameras and two sets."""
    images = np.random.default_rng(seed).integers(0, 256, (3, 13, 17), np.uint8)
    boxes = np.array(edges, np.float32).reshape(2, 3, 4)
    whole_boxes = boxes.astype(np.int32)
    sums = box_sums(images, boxes)
    whole_sums = box_sums(images, whole_boxes)
    for i, c in np.ndindex(2, 3):
        # An edge's fraction is exact in float32 to 1e-6 of a pixel at 25; it weighs a line of at most 17 x 255.
        expected = area_weighted_sum(images[c], boxes[i, c])
        assert sums[i, c] == pytest.approx(expected, abs=0.05, rel=1e-6)
        assert whole_sums[i, c] == area_weighted_sum(images[c], whole_boxes[i, c])


def test_exact_where_sums_exceed_float32():
    """The sum of a 1080p image is 5e8, beyond float32's 2^24, which must not affect a small box at the image's end."""
    images = np.full((1, 1080, 1920), 255, np.uint8)
    corner = [1917.0, 1078.0, 1920.0, 1080.0]
    fractional = [1900.5, 1070.25, 1903.0, 1071.0]
    boxes = np.array([[corner], [fractional]], np.float32)
    sums = box_sums(images, boxes)
    assert sums[0, 0] == 3 * 2 * 255
    assert sums[1, 0] == 2.5 * 0.75 * 255


def test_packed_sums_are_those_of_either_image_to_the_last_bit():
    rng = np.random.default_rng(7)
    low = rng.integers(0, 256, (64, 64), np.int32)
    high = rng.integers(0, 2, (64, 64)) > 0
    boxes = rng.uniform(-5, 69, (40, 4)).astype(np.float32)
    sums = packed_sums(low, high, boxes)
    for part, image in zip(sums, (low, high), strict=True):
        expected = [area_weighted_sum(image, box) for box in boxes]
        # Sums of up to 64 pixels of 255, weighted in float32: 16320 * 6e-8, a few times over.
        np.testing.assert_allclose(part, expected, atol=1e-2)
    # The largest sums: 64 x 64 pixels of 255 take 20 bits, and 4095 pixels of the other image the rest.
    assert 2**LOW_BITS > 64 * 64 * 255
    white = np.full((64, 64), 255, np.int32)
    all_but_one = np.ones((64, 64), bool)
    all_but_one[5, 9] = False
    whole = np.array([[0, 0, 64, 64]], np.float32)
    (low_sum,), (high_sum,) = packed_sums(white, all_but_one, whole)
    assert low_sum == 64 * 64 * 255
    assert high_sum == 64 * 64 - 1
