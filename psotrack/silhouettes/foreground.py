"""Foreground of one camera that stands still: MOG2, learned before it is used.

Method: Zivkovic, "Improved adaptive Gaussian mixture model for background subtraction", ICPR 2004; Zivkovic
and van der Heijden, "Efficient adaptive density estimation per image pixel", 2006; OpenCV's implementation.
A first pass over frames from the whole video learns the background, each frame with equal weight, so the
foreground of the second pass is usable from frame 0: a drone that stands anywhere for less than half of the
video leaves no ghost.

Nothing here shifts the mask: images are reduced by whole factors, by area; speckle is dropped blob by blob.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Literal, get_args

import cv2
import msgspec
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import SettingsError, check_positive

#: What becomes of MOG2's shadow label: full foreground, background, or foreground of less weight.
Shadows = Literal["keep", "drop", "weight"]

#: A value that MOG2 writes for shadow; foreground is 255.
_SHADOW = 127

#: Background is what a pixel shows for more than half of the time: not all that it shows often (MOG2's 0.9).
_BACKGROUND_RATIO = 0.5

#: Of one channel or of three.
_Image = UInt8[np.ndarray, "..."]


class ForegroundSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How foreground is told from background.

    Attributes:
        working_reduction: MOG2 works on the image reduced by this whole factor, by area; 1 is the full image.
        num_learning_frames: at most so many frames, spread over the video, teach the background.
        learning_rate: of the second pass, per frame in [0, 1]; 0 keeps the learned background.
        var_threshold: squared Mahalanobis distance from the background beyond which a pixel is foreground.
        shadows: what becomes of MOG2's shadow label.
        shadow_weight: in [0, 1], of a shadow pixel, for `shadows="weight"`.
        min_blob_px: 8-connected blobs of fewer pixels of the full image are dropped.

    Raises:
        SettingsError: a value makes no sense.
    """

    working_reduction: int = 2
    num_learning_frames: int = 50
    learning_rate: float = 0.0
    var_threshold: float = 8.0
    shadows: Shadows = "keep"
    shadow_weight: float = 0.5
    min_blob_px: int = 64

    def __post_init__(self) -> None:
        for name in ("working_reduction", "num_learning_frames"):
            check_whole(name, getattr(self, name), lowest=1)
        check_whole("min_blob_px", self.min_blob_px, lowest=0)
        for name in ("learning_rate", "shadow_weight"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(name, expected="a number from 0 to 1", found=f"{getattr(self, name):g}")
        check_positive("var_threshold", self.var_threshold)
        if self.shadows not in get_args(Shadows):
            raise SettingsError(
                "shadows", expected=f"one of {', '.join(get_args(Shadows))}", found=f"{self.shadows}"
            )


def check_whole(name: str, value: object, *, lowest: int) -> None:
    """Raise `SettingsError` unless `value` is a whole number of at least `lowest`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < lowest:
        raise SettingsError(name, expected=f"a whole number of at least {lowest}", found=f"{value}")


def learning_step(num_frames: int, settings: ForegroundSettings) -> int:
    """Every so many frames of a video of `num_frames`, the background is learned from one."""
    return math.ceil(num_frames / settings.num_learning_frames)


def foreground(
    learning: Iterable[UInt8[np.ndarray, "height width 3"]],
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    settings: ForegroundSettings,
) -> Iterator[UInt8[np.ndarray, "working_height working_width"]]:
    """The foreground of `frames`, one image for each, against the background of `learning`.

    Args:
        learning: BGR frames, at least one, from the whole video: what most of them show is the background.
        frames: BGR frames in order.
        settings: how foreground is told from background.

    Yields:
        0 is background, 255 foreground, between them weighted shadow. Pixel (i, j) covers the pixels
        [r * i, r * i + r) x [r * j, r * j + r) of the frame, where r is `working_reduction`.
    """
    model = learn(learning, settings)
    for frame in frames:
        yield classify(model, frame, settings)


def learn(
    frames: Iterable[UInt8[np.ndarray, "height width 3"]], settings: ForegroundSettings
) -> cv2.BackgroundSubtractorMOG2:
    """The background of some frames, each of which counts the same, in whichever order."""
    model = cv2.createBackgroundSubtractorMOG2(
        history=settings.num_learning_frames, varThreshold=settings.var_threshold, detectShadows=True
    )
    model.setBackgroundRatio(_BACKGROUND_RATIO)
    for index, frame in enumerate(frames):
        # A rate of 1/n is the mean of n frames; MOG2's own schedule would favour the last ones.
        model.apply(_working(frame, settings), learningRate=1 / (index + 1))
    return model


def classify(
    model: cv2.BackgroundSubtractorMOG2,
    frame: UInt8[np.ndarray, "height width 3"],
    settings: ForegroundSettings,
) -> UInt8[np.ndarray, "working_height working_width"]:
    """The foreground of one frame, as `foreground` yields it; updates `model` at `learning_rate`."""
    mask = model.apply(_working(frame, settings), learningRate=settings.learning_rate)
    return without_speckle(
        cv2.LUT(mask, _levels(settings)), math.ceil(settings.min_blob_px / settings.working_reduction**2)
    )


def without_speckle(
    mask: UInt8[np.ndarray, "height width"], min_blob_px: int
) -> UInt8[np.ndarray, "height width"]:
    """`mask` without its 8-connected blobs of fewer than `min_blob_px` pixels; others stay as they are."""
    points = cv2.findNonZero(mask)
    if min_blob_px <= 1 or points is None:
        return mask
    # Areas are counted over foreground alone, which is a third of the time of OpenCV's own statistics.
    count, labels = cv2.connectedComponents(mask, connectivity=8)
    x, y = points.reshape(-1, 2).T
    labels_of_points = labels[y, x]
    speckle = np.bincount(labels_of_points, minlength=count) < min_blob_px
    cleaned = mask.copy()
    cleaned[y, x] *= ~speckle[labels_of_points]
    return cleaned


def coverage(
    mask: UInt8[np.ndarray, "height width"], reduction: int
) -> UInt8[np.ndarray, "reduced_height reduced_width"]:
    """The mean of every `reduction` x `reduction` pixels, rounded.

    Cell (i, j) covers the pixels [r * i, r * i + r) x [r * j, r * j + r). Where the size is no multiple of r,
    the last row and column reach over the border, where all is background.
    """
    if reduction == 1:
        return mask
    padded = _padded(mask, reduction, cv2.BORDER_CONSTANT)
    return _reduced(padded, reduction)


def _working(frame: UInt8[np.ndarray, "height width 3"], settings: ForegroundSettings) -> _Image:
    """The image that MOG2 sees; a last row or column that reaches over the border repeats what is there."""
    if settings.working_reduction == 1:
        return frame
    return _reduced(
        _padded(frame, settings.working_reduction, cv2.BORDER_REPLICATE), settings.working_reduction
    )


def _padded(image: _Image, factor: int, border: int) -> _Image:
    height, width = image.shape[:2]
    below, right = -height % factor, -width % factor
    if not (below or right):
        return image
    return cv2.copyMakeBorder(image, 0, below, 0, right, border, value=(0, 0, 0))


def _reduced(image: _Image, factor: int) -> _Image:
    height, width = image.shape[:2]
    return cv2.resize(image, (width // factor, height // factor), interpolation=cv2.INTER_AREA)


def _levels(settings: ForegroundSettings) -> UInt8[np.ndarray, "1 levels"]:
    """The value of each of MOG2's labels: a table for `cv2.LUT`."""
    weight = {"keep": 1.0, "drop": 0.0, "weight": settings.shadow_weight}[settings.shadows]
    levels = np.zeros((1, 256), np.uint8)
    levels[0, _SHADOW], levels[0, 255] = round(255 * weight), 255
    return levels
