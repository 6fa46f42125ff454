"""Blobs of one silhouette."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from psotrack.foreground.silhouettes import border_cells, find_blobs


def test_blobs_by_hand():
    """Cells of 4 x 4 px: the middle of a box of cells, with pixel centres at whole numbers."""
    image = np.zeros((20, 30), np.uint8)
    image[4:8, 10:16] = 255
    image[12:16, 27:30] = 255
    image[15, 3] = 255  # a single cell is noise
    image[0:3, 0:9] = 20  # hardly covered
    blobs = find_blobs(image, 4)
    assert blobs.centre_px.tolist() == [[51.5, 23.5], [113.5, 55.5]]
    assert blobs.size_px.tolist() == [[24, 16], [12, 16]]
    assert blobs.whole.tolist() == [True, False]
    # The same image in an array that a larger image of another camera needs.
    filled_up = np.pad(image, ((0, 10), (0, 10)))
    assert find_blobs(filled_up, 4).whole.tolist() == [True, True]
    border = border_cells(np.array([118.0, 80.0]), 4)
    assert find_blobs(filled_up, 4, border).whole.tolist() == [True, False]


def test_two_cells_are_a_blob():
    image = np.zeros((12, 12), np.uint8)
    image[8, 7:9] = 255
    assert find_blobs(image, 4).size_px.tolist() == [[8, 4]]


def test_all_blobs_of_a_silhouette_count_from_large_to_small():
    """An image has 70 blobs of increasing width. Regression: only the 50 largest counted, without a word."""
    image = np.zeros((70 * 5 + 4, 90), np.uint8)
    for row in range(70):
        image[5 * row + 4 : 5 * row + 6, 4 : 6 + row] = 255
    assert (find_blobs(image, 3).size_px[:, 0] / 3).tolist() == list(range(71, 1, -1))


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_blobs_do_not_depend_on_the_pixels_per_cell(seed, times):
    """Regression: the smallest area was in image pixels, so fine silhouettes had no small blobs."""
    rng = np.random.default_rng(seed)
    image = 255 * (rng.random((20, 30)) < 0.1).astype(np.uint8)
    one, other = find_blobs(image, 1), find_blobs(image, times)
    assert (times * one.size_px == other.size_px).all()
    assert (times * (one.centre_px + 0.5) == other.centre_px + 0.5).all()
