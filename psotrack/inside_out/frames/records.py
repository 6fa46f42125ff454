"""A frame of a camera, and a source of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import UInt8

from psotrack.errors import SettingsError


@dataclass(frozen=True)
class Frame:
    """One frame of a camera.

    Attributes:
        number: number of the frame, from 0; in a live stream, numbers of frames that were left out are missing.
        time_s: time since the first frame, seconds.
        bgr: (height, width, 3), the image.
    """

    number: int
    time_s: float
    bgr: UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class FrameSource:
    """Frames of one camera, with the facts that are known before the frames are read.

    Attributes:
        name: name in messages: a path, a device or an address.
        image_size_wh: width and height in pixels.
        num_frames: number of frames; None for a stream.
        frames: function that returns the frames, from the first one; a stream can be read only once.
        stream: whether the frames come from a stream.
        newest: whether frames of a stream that come faster than they are used are left out.
        fps: frames per second; None if unknown.
    """

    name: str
    image_size_wh: tuple[int, int]
    num_frames: int | None
    frames: Callable[[], Iterator[Frame]]
    stream: bool = False
    newest: bool = False
    fps: float | None = None

    def first(self, num_frames: int | None) -> FrameSource:
        """Limit the source to its first `num_frames` frames; None keeps all frames.

        Raises:
            SettingsError: the source has fewer frames.
        """
        if num_frames is None:
            return self
        most = math.inf if self.num_frames is None else self.num_frames
        if not 0 < num_frames <= most:
            expected = "1 or more" if self.num_frames is None else f"1 to {most}, the frames of {self.name}"
            raise SettingsError("frames", expected=expected, found=f"{num_frames}")
        # The frame after the last one is not read: it may be broken.
        return replace(self, num_frames=num_frames, frames=lambda: islice(self.frames(), num_frames))
