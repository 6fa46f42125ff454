"""Box sums: compared with NumPy slices for whole boxes, and with area weights in float64 for fractional boxes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psotrack.foreground.silhouettes import LOW_BITS, box_sum, pack, packed_box_sums, summed_area_table

table_of = jax.jit(summed_area_table)
sum_of = jax.jit(box_sum)


def random_images(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def area_weighted_sum(image, x0, y0, x1, y1):
    """Sum over all pixels of the pixel's share in the box times its value, in float64."""
    shares = []
    for low, high, count in ((y0, y1, image.shape[0]), (x0, x1, image.shape[1])):
        pixel = np.arange(count)
        shares.append(np.clip(np.minimum(high, pixel + 1) - np.maximum(low, pixel), 0, 1))
    return shares[0] @ image.astype(np.float64) @ shares[1]


def box_sums(images, camera, boxes):
    """`box_sum` of (sets, boxes, 4) boxes: fractional ones, or int32 ones with whole edges."""
    edges = (jnp.asarray(boxes[..., i], None if boxes.dtype == np.int32 else jnp.float32) for i in range(4))
    return np.asarray(sum_of(table_of(images), jnp.asarray(camera, jnp.int32), *edges))


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_whole_boxes_are_slice_sums(dtype):
    """All boxes with whole edges in a 5 x 7 image are exact, for several cameras at once."""
    images = random_images((2, 5, 7))
    edges = [
        (x0, y0, x1, y1) for x0 in range(8) for x1 in range(x0, 8) for y0 in range(6) for y1 in range(y0, 6)
    ]
    boxes = np.array(edges)[:, None, :].repeat(2, axis=1)
    expected = [[images[c, y0:y1, x0:x1].sum(dtype=int) for c in range(2)] for x0, y0, x1, y1 in edges]
    np.testing.assert_array_equal(box_sums(images, np.arange(2), boxes.astype(dtype)), expected)
    # Edges beyond the image, and in the wrong order.
    beyond = np.array([[[-3, -2, 9, 8]] * 2, [[4, 3, 2, 1]] * 2], dtype)
    whole_and_none = [images.sum(axis=(1, 2), dtype=int), [0, 0]]
    np.testing.assert_array_equal(box_sums(images, np.arange(2), beyond), whole_and_none)


box_edges = st.tuples(*[st.floats(-5, 25, width=32)] * 4)


@given(st.lists(box_edges, min_size=6, max_size=6), st.integers(0, 2**16))
def test_fractional_boxes_are_area_weighted_sums(edges, seed):
    """Boxes of any kind, also empty, in the wrong order or outside, in three cameras and two sets."""
    images = random_images((3, 13, 17), seed)
    boxes = np.array(edges, np.float32).reshape(2, 3, 4)
    actual = box_sums(images, np.arange(3), boxes)
    for i, c in np.ndindex(2, 3):
        expected = area_weighted_sum(images[c], *boxes[i, c].astype(np.float64))
        # An edge's fraction is exact in float32 to 1e-6 of a pixel at 25; it weighs a line of at most 17 x 255.
        assert actual[i, c] == pytest.approx(expected, abs=0.05, rel=1e-6)


def test_exact_where_sums_exceed_float32():
    """The sum of a 1080p image is 5e8, beyond float32's 2^24, which must not affect a small box at the image's end."""
    images = np.full((1, 1080, 1920), 255, np.uint8)
    boxes = np.array([[[1917, 1078, 1920, 1080]], [[1900.5, 1070.25, 1903.0, 1071.0]]])
    assert box_sums(images, np.zeros(1), boxes).ravel().tolist() == [3 * 2 * 255, 2.5 * 0.75 * 255]


# Two images in one table.


@jax.jit
def packed_sums(low, high, *edges):
    table = summed_area_table(pack(low, high))
    return packed_box_sums(table, jnp.zeros(edges[0].shape[1], jnp.int32), *edges)


def test_packed_sums_are_those_of_either_image_to_the_last_bit():
    rng = np.random.default_rng(7)
    low, high = rng.integers(0, 256, (1, 64, 64), np.int32), rng.integers(0, 2, (1, 64, 64)) > 0
    boxes = rng.uniform(-5, 69, (1, 40, 4)).astype(np.float32)
    for part, image in zip(packed_sums(low, high, *np.moveaxis(boxes, -1, 0)), (low, high), strict=True):
        expected = [area_weighted_sum(image[0], *box) for box in boxes[0]]
        # Sums of up to 64 pixels of 255, weighted in float32: 16320 * 6e-8, a few times over.
        np.testing.assert_allclose(part[0], expected, atol=1e-2)
    # The largest sums: 64 x 64 pixels of 255 take 20 bits, and 4095 pixels of the other image the rest.
    low, high = np.full((1, 64, 64), 255, np.int32), np.ones((1, 64, 64), bool)
    high[0, 5, 9] = False
    whole = np.tile(np.float32([0, 0, 64, 64]), (1, 40, 1))
    assert 2**LOW_BITS > 64 * 64 * 255
    largest = packed_sums(low, high, *np.moveaxis(whole, -1, 0))
    assert [int(part[0, 0]) for part in largest] == [64 * 64 * 255, 64 * 64 - 1]


def test_gradient_of_packed_sums_is_that_of_either_image():
    low, high = random_images((1, 13, 17)), random_images((1, 13, 17))[:, ::-1] > 127
    edges = jnp.asarray([2.3, 3.6, 9.4, 11.2], jnp.float32)

    def packed_product(edges):
        return jnp.prod(jnp.stack(packed_sums(low, high, *edges.reshape(4, 1, 1))))

    def separate_product(edges):
        tables = [summed_area_table(image) for image in (low, high.astype(np.uint8))]
        sums = [box_sum(table, jnp.zeros(1, jnp.int32), *edges.reshape(4, 1, 1)).sum() for table in tables]
        return jnp.prod(jnp.stack(sums))

    found, expected = (jax.jit(jax.grad(of))(edges) for of in (packed_product, separate_product))
    # The same float32 arithmetic, but the compiler may fuse it differently.
    np.testing.assert_allclose(found, expected, rtol=1e-4)
