"""Light that changes: the gain of each part of a frame against the background, and the frame with that gain removed.

Exposure, daylight and lamps multiply the grey levels of many neighbouring pixels by nearly the same factor; an object
replaces the grey levels of a few pixels. So the gain of a part of the image is the median ratio of its pixels, and a
median that few pixels could decide is replaced by that of the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

#: Parts along the longer side of the image. A part must be larger than a drone, so that its median shows the light.
_PARTS = 10
#: Pixels of a part along each side that are compared.
_SAMPLES = 6
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
#: Where the gains of all parts differ less from the gain of the whole image, the whole image has one gain: the median
#: of a part's few pixels is not more certain than that.
_EVEN = 0.01
#: Logarithm of each grey level.
_LOG_LEVELS = np.log(np.arange(256, dtype=np.float32) + _DARK)


@dataclass(frozen=True)
class Light:
    """The light of a background, with which frames are compared.

    Attributes:
        background: (height, width, 3), the background, grey levels.
        rows, columns: rows and columns of the pixels that are compared, the same number in each part.
        parts: number of parts along y and x.
        log_level: (rows, columns), logarithm of the background's grey levels there, mean of the channels.
    """

    background: UInt8[np.ndarray, "height width 3"]
    rows: Int[np.ndarray, "rows"]
    columns: Int[np.ndarray, "columns"]
    parts: tuple[int, int]
    log_level: Float[np.ndarray, "rows columns"]


def light_of(background: Float[np.ndarray, "height width 3"]) -> Light:
    """The light of a background, grey levels: (height, width, 3)."""
    height, width = background.shape[:2]
    parts = _parts(height, max(height, width)), _parts(width, max(height, width))
    rows, columns = _spread(height, parts[0]), _spread(width, parts[1])
    log_level = np.log(background[np.ix_(rows, columns)].astype(np.float32) + _DARK).mean(axis=-1)
    return Light(np.asarray(cv2.convertScaleAbs(background)), rows, columns, parts, log_level)


def remove_light(
    image: UInt8[np.ndarray, "height width 3"],
    light: Light,
    foreground: UInt8[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width 3"]:
    """The image in the light of the background.

    Args:
        image: (height, width, 3), frame, grey levels.
        light: the light of the background.
        foreground: (height, width), above 0 where the frame before showed foreground; these pixels do not count.
    """
    log_gain, everywhere = _log_gains(image, light, foreground)
    if np.abs(log_gain - everywhere).max() < _EVEN:
        if abs(everywhere) < _NO_CHANGE:
            return image
        return np.asarray(cv2.convertScaleAbs(image, alpha=float(np.exp(-everywhere))))
    least, most = cv2.erode(log_gain, _AROUND), cv2.dilate(log_gain, _AROUND)
    if (most - least).max() < _EDGE_OF_LIGHT:
        return _multiplied(image, log_gain)
    # The light of a lamp may end anywhere between two parts, and each pixel is on one side or the other.
    brightest, darkest = _multiplied(image, least), _multiplied(image, most)
    return np.clip(light.background, darkest, brightest)


def _multiplied(
    image: UInt8[np.ndarray, "height width 3"], log_gain: Float[np.ndarray, "rows columns"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The image without the gain of each part; gains between the middles of the parts are interpolated."""
    height, width = image.shape[:2]
    factor = cv2.resize(np.exp(-log_gain), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(image, cv2.merge([factor, factor, factor]), dtype=cv2.CV_8U))


def _log_gains(
    image: UInt8[np.ndarray, "height width 3"],
    light: Light,
    foreground: UInt8[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "rows columns"], float]:
    """Logarithms of the gain of each part of the image, and of the whole image."""
    rows, columns = light.parts
    chosen = np.ix_(light.rows, light.columns)
    of_channels = _LOG_LEVELS[image[chosen]]
    # A sum of three arrays takes a fraction of the time of a mean along a short axis.
    log_ratio = (of_channels[..., 0] + of_channels[..., 1] + of_channels[..., 2]) / 3 - light.log_level
    log_ratio[(foreground[chosen] > 0) | (np.abs(log_ratio) > _LARGEST_LOG_GAIN)] = np.nan
    known = log_ratio[np.isfinite(log_ratio)]
    everywhere = float(np.median(known)) if known.size else 0.0
    parts = log_ratio.reshape(rows, -1, columns, log_ratio.shape[1] // columns).swapaxes(1, 2)
    values = np.ma.masked_invalid(parts.reshape(rows, columns, -1))
    enough = values.count(axis=-1) >= max(1, _LEAST_SHARE * values.shape[-1])
    medians = np.ma.median(values, axis=-1).filled(everywhere)
    log_gain = np.where(enough, medians, everywhere).astype(np.float32)
    # One part alone is more often an object than a lamp.
    return np.asarray(cv2.medianBlur(log_gain, 3)) if min(log_gain.shape) >= 3 else log_gain, everywhere


def _parts(side: int, longest: int) -> int:
    return max(1, min(side, round(_PARTS * side / longest)))


def _spread(side: int, parts: int) -> Int[np.ndarray, "samples"]:
    """Pixels along a side, spread evenly, the same number in each part."""
    samples = parts * _SAMPLES
    return ((np.arange(samples) + 0.5) * side / samples).astype(int)
