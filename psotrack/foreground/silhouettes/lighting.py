"""Light that changes: the gain of each part of a frame against the background, and the frame with that gain removed.

Exposure, daylight and lamps multiply the grey levels of many neighbouring pixels by nearly the same factor; an object
replaces the grey levels of a few pixels. So the gain of a part of the image is the median ratio of its pixels, and a
median that few pixels could decide is replaced by that of the whole image.

A large change of the whole image is judged and removed first (`compare`). A frame shows the scene if enough is left of
the background's contrast: in a frame that is too dark, saturated or uniform, or shows something else, nothing is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Real, UInt8

#: Parts along the longer side of the image. A part must be larger than a drone, so that its median shows the light.
_PARTS = 10
#: Pixels of a part along each side that are compared.
_SAMPLES = 6
#: Larger changes of the logarithm are no light: a dark object before a bright wall, or the reverse.
_LARGEST_LOG_GAIN = 0.7
#: A larger change of the whole image's logarithm is removed first: half of what one of its pixels may change.
_LARGE_CHANGE = _LARGEST_LOG_GAIN / 2
#: Noise of a good camera, grey levels.
_NOISE = 2.0
#: Darker frames say nothing: brought to the background's light, steps of a grey level make more errors than the noise.
#: Whole numbers of a step q have errors of q / sqrt(12) (standard deviation).
_LEAST_GAIN = 1 / (math.sqrt(12) * _NOISE)
#: Smallest difference that tells an object, four times the noise: of darker pixels no object can be told.
LEAST_DIFFERENCE = 4 * _NOISE
#: From this level on a pixel is saturated; codecs change 255 by one.
_SATURATED = 254.0
#: A frame shows the scene if this share of the background's contrast is left, and of its pixels not saturated.
_LEAST_CONTRAST = 0.5
#: Number of frames, 1 s of most videos, after which a large change is a new background.
_LASTING_FRAMES = 25
#: Without the darkest and the brightest tenth, the pixels of an image that shows nothing have the same level, which
#: codecs change by one. An object before a plain sky covers less than a quarter.
_TENTH, _FLAT, _QUARTER = 0.1, 1.0, 0.25
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
        parts: number of parts along y and x.
        chosen: (rows, columns), the pixels that are compared, as many in each part: indices into the flat image.
        log_level: (rows, columns), logarithm of the background's grey levels there, mean of the channels.
        level: (rows, columns), the grey levels themselves, mean of the channels.
        is_flat: whether the background shows nothing.
    """

    background: UInt8[np.ndarray, "height width 3"]
    parts: tuple[int, int]
    chosen: Int[np.ndarray, "rows columns"]
    log_level: Float[np.ndarray, "rows columns"]
    level: Float[np.ndarray, "rows columns"]
    is_flat: bool


class Comparison(NamedTuple):
    """How a frame compares with a background.

    Attributes:
        log_gain: logarithm of the whole image's gain, 0 where the change is small; infinite where the frame does not
            show the background's scene.
        lasting_frames: number of such frames after which the frame is a better background: none where the background
            is uniform or far darker, infinite where the frame is.
    """

    log_gain: float
    lasting_frames: float = math.inf


def light_of(background: Real[np.ndarray, "height width 3"]) -> Light:
    """The light of a background, grey levels: (height, width, 3)."""
    parts, chosen = _places(*background.shape[:2])
    levels = background.reshape(-1, 3).take(chosen, axis=0).astype(np.float32)
    log_level, level = _mean(np.log(levels + _DARK)), _mean(levels)
    whole_levels = np.asarray(cv2.convertScaleAbs(background))
    return Light(whole_levels, parts, chosen, log_level, level, _is_flat(level))


def compare(image: UInt8[np.ndarray, "height width 3"], light: Light) -> Comparison:
    """Compare a frame with a background, at the pixels that `light` names."""
    return _compare(_levels_at(image, light.chosen), light.level, light.is_flat)


def show_one_scene(
    images: Sequence[UInt8[np.ndarray, "height width 3"]], weights: Sequence[float]
) -> Bool[np.ndarray, "images"]:
    """Which images of one camera show what most of them show, in nearly the same light; all, where none does.

    Args:
        images: images of one size.
        weights: how much each image counts.
    """
    _, chosen = _places(*images[0].shape[:2])
    levels = np.array([_levels_at(image, chosen) for image in images])
    shown = np.array([not _is_flat(level) for level in levels])
    shown |= not shown.any()
    most = _weighted_median(levels[shown], np.asarray(weights)[shown])
    shown &= [_compare(level, most, _is_flat(most)).log_gain == 0 for level in levels]
    return np.asarray(shown | (not shown.any()))


def _compare(
    level: Float[np.ndarray, "rows columns"], background: Float[np.ndarray, "rows columns"], was_flat: bool
) -> Comparison:
    # A pixel that is saturated only now says nothing.
    says = (level < _SATURATED) | (background >= _SATURATED)
    if np.count_nonzero(says) < _LEAST_CONTRAST * says.size:
        return Comparison(math.inf)
    shown, known = level[says], background[says]
    bright = np.maximum(shown, known) >= LEAST_DIFFERENCE
    if np.count_nonzero(bright) < _LEAST_SHARE * bright.size:  # dark: the light cannot be told
        return Comparison(0.0)
    change = math.log(np.median((shown[bright] + _DARK) / (known[bright] + _DARK)))
    gain = 1.0
    if abs(change) > _LARGE_CHANGE:
        lit = known > 0
        # The line through the origin with the least sum of absolute differences: dark pixels count little.
        gain = float(_weighted_median(shown[lit] / known[lit], known[lit])) if lit.any() else math.inf
        if gain < _LEAST_GAIN:
            return Comparison(math.inf)
    if gain > 1 / _LEAST_GAIN or (was_flat and _has_parts(level)):
        return Comparison(math.inf, math.inf if _is_flat(level) else 0)
    if not was_flat and not _has_contrast(shown / gain, known):
        return Comparison(math.inf, math.inf if _is_flat(level) else _LASTING_FRAMES)
    return Comparison(math.log(gain), _LASTING_FRAMES)


def _weighted_median(
    values: Float[np.ndarray, "values *samples"], weights: Float[np.ndarray, "values"]
) -> Float[np.ndarray, "*samples"]:
    return np.asarray(np.quantile(values, 0.5, axis=0, weights=weights, method="inverted_cdf"))


def _is_flat(level: Float[np.ndarray, "rows columns"]) -> bool:
    """Whether an image shows nothing, not even noise."""
    return _range(level, _TENTH) <= _FLAT


def _has_parts(level: Float[np.ndarray, "rows columns"]) -> bool:
    """Whether some parts of an image are brighter than others."""
    return _range(cv2.blur(level, (_SAMPLES, _SAMPLES)), _QUARTER) >= LEAST_DIFFERENCE


def _range(level: Float[np.ndarray, "rows columns"], share: float) -> float:
    """Difference between the brightest and the darkest, without a share of both."""
    count = int(share * level.size)
    ordered = np.partition(level.ravel(), (count, level.size - 1 - count))
    return float(ordered[-1 - count] - ordered[count])


def _has_contrast(level: Float[np.ndarray, "samples"], background: Float[np.ndarray, "samples"]) -> bool:
    """Whether a frame's levels follow those of the background: the slope of one against the other, within its error."""
    along, level = background - background.mean(), level - level.mean()
    square = along @ along
    slope = along @ level / square
    rest = level - slope * along
    # Waves and objects change the pixels of a part together, so that each part counts as one pixel.
    error = math.sqrt(rest @ rest / square / (len(level) / _SAMPLES**2))
    return bool(slope + 2 * error > _LEAST_CONTRAST)


def _levels_at(
    image: UInt8[np.ndarray, "height width 3"], chosen: Int[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "rows columns"]:
    """Grey levels of some pixels, mean of the channels."""
    return _mean(image.reshape(-1, 3).take(chosen, axis=0).astype(np.float32))


def _mean(channels: Float[np.ndarray, "rows columns 3"]) -> Float[np.ndarray, "rows columns"]:
    """Mean of the channels: a sum of three arrays takes a fraction of the time of a mean along a short axis."""
    return (channels[..., 0] + channels[..., 1] + channels[..., 2]) / 3


def remove_light(
    image: UInt8[np.ndarray, "height width 3"],
    light: Light,
    foreground: UInt8[np.ndarray, "height width"],
    change: float = 0.0,
) -> UInt8[np.ndarray, "height width 3"]:
    """The image in the light of the background.

    Args:
        image: (height, width, 3), frame, grey levels.
        light: the light of the background.
        foreground: (height, width), above 0 where the frame before showed foreground; these pixels do not count.
        change: logarithm of a large gain of the whole image, from `compare`.
    """
    if change:
        in_light = cv2.convertScaleAbs(image, alpha=math.exp(-change))
        # A saturated pixel is as bright as the background, unless the background is darker.
        image = np.where(image == 255, cv2.max(in_light, light.background), in_light)
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
    return np.asarray(cv2.min(cv2.max(light.background, darkest), brightest))


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
    log_ratio = _mean(_LOG_LEVELS.take(image.reshape(-1, 3).take(light.chosen, axis=0))) - light.log_level
    log_ratio[(foreground.take(light.chosen) > 0) | (np.abs(log_ratio) > _LARGEST_LOG_GAIN)] = np.nan
    known = log_ratio[np.isfinite(log_ratio)]
    everywhere = float(np.median(known)) if known.size else 0.0
    values = log_ratio.reshape(light.parts[0], _SAMPLES, -1, _SAMPLES).swapaxes(1, 2).reshape(-1, _SAMPLES**2)
    # NaN come last in order, which is many times faster than `np.nanmedian`.
    ordered, count, part = np.sort(values, axis=-1), np.isfinite(values).sum(axis=-1), np.arange(len(values))
    medians = (ordered[part, np.maximum(count - 1, 0) // 2] + ordered[part, count // 2]) / 2
    log_gain = np.where(count >= _LEAST_SHARE * _SAMPLES**2, medians, everywhere).reshape(light.parts)
    # One part alone is more often an object than a lamp.
    return np.asarray(cv2.medianBlur(log_gain, 3)) if min(log_gain.shape) >= 3 else log_gain, everywhere


def _places(height: int, width: int) -> tuple[tuple[int, int], Int[np.ndarray, "rows columns"]]:
    """Number of parts along y and x, and the pixels that are compared: see `Light`."""
    down, right = (max(1, min(n, round(_PARTS * n / max(height, width)))) for n in (height, width))
    return (down, right), _spread(height, down)[:, None] * width + _spread(width, right)


def _spread(side: int, parts: int) -> Int[np.ndarray, "samples"]:
    """Pixels along a side, spread evenly, the same number in each part."""
    samples = parts * _SAMPLES
    return ((np.arange(samples) + 0.5) * side / samples).astype(int)
