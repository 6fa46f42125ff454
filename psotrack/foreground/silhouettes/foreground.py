"""Foreground of a camera that does not move: MOG2 with a background that is learned in advance.

Method: Zivkovic, "Improved adaptive Gaussian mixture model for background subtraction", ICPR 2004; Zivkovic
and van der Heijden, "Efficient adaptive density estimation per image pixel", 2006; OpenCV's implementation.
The background is learned from some frames of the whole video, before the foreground of the first one is asked for. So
the foreground is usable from frame 0, and a drone that stands at one place for less than half of the video does not
become background.

No step shifts the mask: images are reduced by whole factors, by area, and speckle is removed blob by blob.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import cv2
import msgspec
import numpy as np
from jaxtyping import UInt8

from psotrack.foreground.silhouettes.lighting import compare, light_of, show_one_scene
from psotrack.foreground.silhouettes.settings import ForegroundSettings

#: MOG2's label of shadow pixels; foreground is 255.
_SHADOW = 127

#: MOG2's background ratio: background is what a pixel shows in more than half of the frames (MOG2's default is 0.9).
_BACKGROUND_RATIO = 0.5

#: An image with one or three channels.
_Image = UInt8[np.ndarray, "..."]
_Mask = UInt8[np.ndarray, "height width"]


def learning_step(num_frames: int, settings: ForegroundSettings) -> int:
    """Distance between two frames from which the background is learned, frames."""
    return math.ceil(num_frames / settings.num_learning_frames)


@runtime_checkable
class BackgroundModel(Protocol):
    """Separates foreground from background in the video of one camera.

    The model works on NumPy arrays, outside of any compiled function. Each camera's video is treated by itself, in
    several processes, so the object must be picklable, of a class that a module defines; with `jobs=1` everything runs
    in the calling process, where a class of a notebook works too.

    Attributes:
        key: everything on which the foreground depends, as plain data fit for JSON. Silhouettes are stored under the
            class's name and this key; with an equal key, stored silhouettes are used again.
    """

    @property
    def key(self) -> Mapping[str, Any]: ...  # noqa: D102

    def foreground(
        self,
        learning: Iterable[UInt8[np.ndarray, "height width 3"]],
        frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    ) -> Iterator[UInt8[np.ndarray, "working_height working_width"] | None]:
        """The foreground of each of `frames`, against the background of `learning`.

        Both iterables decode the video while they are read, each at most once; a list of all frames may not fit in
        memory.

        Args:
            learning: (height, width, 3) uint8 BGR frames, at most `silhouettes.num_learning_frames`, spread over the
                whole video.
            frames: (height, width, 3) uint8 BGR frames, all frames in their order.

        Yields:
            One uint8 mask per frame, or None for a frame that does not show the scene, which is left out as if the
            camera had no frame then. 0 is background, 255 foreground, values between them foreground of less weight. A
            mask has the height and width of the frame, divided by `silhouettes.working_reduction` and rounded up; pixel
            (i, j) covers the frame's pixels [r * i, r * i + r) x [r * j, r * j + r).
        """
        ...


@dataclass(frozen=True)
class OwnBackground(ABC):
    """A background model of the package, which sees reduced frames only.

    Attributes:
        settings: settings of the foreground.
    """

    settings: ForegroundSettings

    @abstractmethod
    def masks(
        self, learning: Iterable[tuple[float, _Image]], frames: Iterable[_Image]
    ) -> Iterator[_Mask | None]:
        """Yield the foreground of each of `frames`, as `foreground` does.

        Args:
            learning: weights and reduced frames from the whole video.
            frames: all frames in their order, reduced.
        """

    def foreground(
        self,
        learning: Iterable[UInt8[np.ndarray, "height width 3"]],
        frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    ) -> Iterator[UInt8[np.ndarray, "working_height working_width"] | None]:
        """See `BackgroundModel`."""
        settings = self.settings
        return self.masks(
            ((1.0, reduce_frame(frame, settings)) for frame in learning),
            (reduce_frame(frame, settings) for frame in frames),
        )


class Mog2(OwnBackground):
    """The background model "mog2" (see the module); values between 0 and 255 are weighted shadow."""

    @property
    def key(self) -> Mapping[str, Any]:
        """See `BackgroundModel`."""
        return {"version": 2, "mog2": msgspec.to_builtins(self.settings)}

    def masks(
        self, learning: Iterable[tuple[float, _Image]], frames: Iterable[_Image]
    ) -> Iterator[_Mask | None]:
        """See `OwnBackground`."""
        settings = self.settings
        model, levels = learned_mog2(learning, settings), _levels(settings)
        least_px = math.ceil(settings.min_blob_px / settings.working_reduction**2)
        light = light_of(model.getBackgroundImage())
        for image in frames:
            if math.isinf(compare(image, light).log_gain):
                yield None
                continue
            labels = model.apply(image, learningRate=settings.learning_rate)
            yield remove_speckle(cv2.LUT(labels, levels), least_px)


def learned_mog2(
    images: Iterable[tuple[float, _Image]], settings: ForegroundSettings
) -> cv2.BackgroundSubtractorMOG2:
    """OpenCV's MOG2 after it learned the background from weights and reduced images; their order does not matter.

    It learns from the images that show the scene of most of them, in nearly the same light.
    """
    model = cv2.createBackgroundSubtractorMOG2(
        history=settings.num_learning_frames, varThreshold=settings.var_threshold, detectShadows=True
    )
    model.setBackgroundRatio(_BACKGROUND_RATIO)
    total, learning = 0.0, list(images)
    chosen = show_one_scene([image for _, image in learning], [weight for weight, _ in learning])
    for weight, image in itertools.compress(learning, chosen):
        # The rate 1/n gives the mean of n frames; MOG2's own schedule gives the last frames more weight.
        total += weight
        model.apply(image, learningRate=weight / total)
    return model


def remove_speckle(
    mask: UInt8[np.ndarray, "height width"], min_blob_px: int
) -> UInt8[np.ndarray, "height width"]:
    """Remove 8-connected blobs with fewer than `min_blob_px` pixels from a mask; larger blobs do not change."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    return mask * (stats[:, cv2.CC_STAT_AREA] >= min_blob_px)[labels]


def coverage(
    mask: UInt8[np.ndarray, "height width"], reduction: int
) -> UInt8[np.ndarray, "reduced_height reduced_width"]:
    """Mean of every `reduction` x `reduction` pixels, rounded.

    Cell (i, j) covers the pixels [r * i, r * i + r) x [r * j, r * j + r). Where the size is no multiple of r,
    the last row and column reach beyond the image's border, where all pixels count as background.
    """
    if reduction == 1:
        return mask
    padded = _pad(mask, reduction, cv2.BORDER_CONSTANT)
    return _reduce(padded, reduction)


def reduce_frame(frame: UInt8[np.ndarray, "height width 3"], settings: ForegroundSettings) -> _Image:
    """Reduce a frame by `working_reduction`; pixels beyond the image's border repeat the pixels at the border."""
    factor = settings.working_reduction
    image = _pad(frame, factor, cv2.BORDER_REPLICATE)
    # OpenCV halves an image in a fraction of the time that another factor takes.
    while factor > 1:
        step = 2 if factor % 2 == 0 else factor
        image, factor = _reduce(image, step), factor // step
    return image


def _pad(image: _Image, factor: int, border: int) -> _Image:
    height, width = image.shape[:2]
    below, right = -height % factor, -width % factor
    if not (below or right):
        return image
    return cv2.copyMakeBorder(image, 0, below, 0, right, border, value=(0, 0, 0))


def _reduce(image: _Image, factor: int) -> _Image:
    height, width = image.shape[:2]
    return cv2.resize(image, (width // factor, height // factor), interpolation=cv2.INTER_AREA)


def _levels(settings: ForegroundSettings) -> UInt8[np.ndarray, "1 levels"]:
    """Mask value of each of MOG2's labels: a table for `cv2.LUT`."""
    weight = {"keep": 1.0, "drop": 0.0, "weight": settings.shadow_weight}[settings.shadows]
    levels = np.zeros((1, 256), np.uint8)
    levels[0, _SHADOW], levels[0, 255] = round(255 * weight), 255
    return levels
