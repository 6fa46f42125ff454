"""Sums over boxes of pixels by their definition, as an oracle."""

import numpy as np


def area_weighted_sum(image, box):
    """Sum over all pixels of the pixel's share in a box (x0, y0, x1, y1) times its value, in float64."""
    x0, y0, x1, y1 = np.asarray(box, np.float64)
    shares = []
    for low, high, count in ((y0, y1, image.shape[0]), (x0, x1, image.shape[1])):
        pixel = np.arange(count)
        shares.append(np.clip(np.minimum(high, pixel + 1) - np.maximum(low, pixel), 0, 1))
    rows, columns = shares
    return rows @ image.astype(np.float64) @ columns
