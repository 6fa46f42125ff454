"""Light that changes: the gain of each part of a frame against the background, and the frame with that gain removed.

Exposure, daylight and lamps multiply the grey levels of many neighbouring pixels by nearly the same factor; an object
replaces the grey levels of a few pixels. So the gain of a part of the image is the median ratio of its pixels, and a
median that few pixels could decide is replaced by that of the whole image.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

#: Parts along the longer side of the image. A part must be larger than a drone, so that its median shows the light.
_PARTS = 10
#: Pixels of a part along each side that are compared.
_SAMPLES = 8
#: Larger changes of the logarithm are no light: a dark object before a bright wall, or the reverse.
_LARGEST_LOG_GAIN = 0.7
#: Share of a part's pixels that must show background for the part to have a gain of its own.
_LEAST_SHARE = 0.3
#: Grey levels added to both images, so that noise in the dark does not look like a change of the light.
_DARK = 4.0
#: Neighbouring parts whose logarithms of the gain differ by more are on two sides of the edge of a light.
_EDGE_OF_LIGHT = 0.02
_AROUND = np.ones((3, 3), np.uint8)
#: Smaller changes of the light are within the noise of a pixel, and the frame is used as it is.
_NO_CHANGE = 0.002


def remove_light(
    image: UInt8[np.ndarray, "height width 3"],
    background: Float[np.ndarray, "height width 3"],
    foreground: UInt8[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width 3"]:
    """The image in the light of the background.

    Args:
        image: (height, width, 3), frame, grey levels.
        background: (height, width, 3), the background as it was learned, grey levels.
        foreground: (height, width), above 0 where the frame before showed foreground; these pixels do not count.
    """
    log_gain = _log_gains(image, background, foreground)
    if np.abs(log_gain).max() < _NO_CHANGE:
        return image
    least, most = cv2.erode(log_gain, _AROUND), cv2.dilate(log_gain, _AROUND)
    if (most - least).max() < _EDGE_OF_LIGHT:
        return _multiplied(image, log_gain)
    # The light of a lamp may end anywhere between two parts, and each pixel is on one side or the other.
    brightest, darkest = _multiplied(image, least), _multiplied(image, most)
    return np.clip(cv2.convertScaleAbs(background), darkest, brightest)


def _multiplied(
    image: UInt8[np.ndarray, "height width 3"], log_gain: Float[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The image without the gain of each part; gains between the middles of the parts are interpolated."""
    height, width = image.shape[:2]
    factor = cv2.resize(np.exp(-log_gain), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(image, cv2.merge([factor, factor, factor]), dtype=cv2.CV_8U))


def _log_gains(
    image: UInt8[np.ndarray, "height width 3"],
    background: Float[np.ndarray, "height width 3"],
    foreground: UInt8[np.ndarray, "height width"],
) -> Float[np.ndarray, "rows columns"]:
    """Logarithm of the gain of each part of the image."""
    height, width = image.shape[:2]
    rows, columns = (_parts(side, max(height, width)) for side in (height, width))
    chosen = np.ix_(_spread(height, rows), _spread(width, columns))
    ratio = (image[chosen].astype(np.float32) + _DARK) / (background[chosen] + _DARK)
    log_ratio = np.log(ratio).mean(axis=-1)
    log_ratio[(foreground[chosen] > 0) | (np.abs(log_ratio) > _LARGEST_LOG_GAIN)] = np.nan
    known = log_ratio[np.isfinite(log_ratio)]
    everywhere = float(np.median(known)) if known.size else 0.0
    parts = log_ratio.reshape(rows, -1, columns, log_ratio.shape[1] // columns).swapaxes(1, 2)
    values = np.sort(parts.reshape(rows, columns, -1), axis=-1)  # NaN come last
    count = np.isfinite(values).sum(axis=-1)
    lower, upper = (
        np.take_along_axis(values, np.maximum(index, 0)[..., None], axis=-1)[..., 0]
        for index in ((count - 1) // 2, count // 2)
    )
    # Where nothing is known, the index count // 2 is 0 as well.
    log_gain = np.where(
        count >= max(1, _LEAST_SHARE * values.shape[-1]), (lower + upper) / 2, everywhere
    ).astype(np.float32)
    # One part alone is more often an object than a lamp.
    return cv2.medianBlur(log_gain, 3) if min(log_gain.shape) >= 3 else log_gain


def _parts(side: int, longest: int) -> int:
    return max(1, min(side, round(_PARTS * side / longest)))


def _spread(side: int, parts: int) -> Int[np.ndarray, "samples"]:
    """Pixels along a side, spread evenly, the same number in each part."""
    samples = parts * _SAMPLES
    return ((np.arange(samples) + 0.5) * side / samples).astype(int)
