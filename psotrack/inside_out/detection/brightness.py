"""Images in which markers are searched: smaller ones, and ones in which every place has the same brightness."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

#: Number of tiles along the image's longer side, and side, in tiles, of the square in which the brightest tile is the
#: white of a place. The square is wider than neighbouring black cells of a marker that fills half of the image;
#: otherwise such cells would count as white.
_TILES, _WHITE_SQUARE = 240, 31
#: Smallest grey level of white: darker surroundings show only noise.
_LEAST_WHITE = 16
#: Grey level of white in the image of equal brightness; levels above it are for pixels brighter than their white.
_WHITE = 200
#: Grey levels of the searched image, half way between grey and light: blur in light hides black cells, blur in grey
#: levels hides white cells.
_HALF_LINEAR = np.round(255 * (np.arange(256) / 255) ** 1.5).astype(np.uint8)


def shrink(gray: UInt8[np.ndarray, "height width"], times: float) -> UInt8[np.ndarray, "rows columns"]:
    """The image made smaller by a factor along each side; as it is by a factor of 1 or less."""
    if times <= 1:
        return gray
    size_wh = (max(round(gray.shape[1] / times), 1), max(round(gray.shape[0] / times), 1))
    return np.asarray(cv2.resize(gray, size_wh, interpolation=cv2.INTER_AREA), np.uint8)


def equalise_brightness(gray: UInt8[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """The image divided by the white of each place: the brightest tile around the place."""
    # Without smoothing, noise makes specks, which take time and hide markers.
    smooth = np.asarray(cv2.GaussianBlur(gray, (3, 3), 0))
    tile = max(1, round(max(gray.shape) / _TILES))
    around = (_WHITE_SQUARE, _WHITE_SQUARE)
    white = cv2.blur(cv2.dilate(smooth[::tile, ::tile], np.ones(around, np.uint8)), around)
    white = cv2.resize(np.maximum(white, _LEAST_WHITE), gray.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.LUT(cv2.divide(smooth, white, scale=_WHITE), _HALF_LINEAR), np.uint8)
