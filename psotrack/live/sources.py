"""Sources of frames: a device, the address of a stream, or a video that is played at its own rate.

A source yields frames with their times on the recording's clock. The frames of a stream are timed when they arrive. A
stream that breaks off is opened again, once per second.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import InputError
from psotrack.recordings import VideoInfo, read_frames, silence_opencv

#: How long a stream may take to answer and to bring a frame, seconds, and how long it is left alone after it broke off.
_ANSWER_S, _AGAIN_S = 5.0, 1.0
#: A frame that is read in less time was waiting: the program is behind the camera, seconds.
_WAITING_S = 0.002


@dataclass(frozen=True)
class SourceFrame:
    """A frame of a source.

    Attributes:
        time_s: when it was filmed, on the recording's clock, seconds.
        image: BGR; None for a frame that was left out, because the program is behind.
        arrived_s: when it arrived, `time.monotonic`.
    """

    time_s: float
    image: UInt8[np.ndarray, "height width 3"] | None
    arrived_s: float


@runtime_checkable
class LiveSource(Protocol):
    """A source of one camera's frames."""

    def frames(self, begin: Callable[[], float], stopped: Callable[[], bool]) -> Generator[SourceFrame | str]:
        """Yield frames, and a line of text where the source has broken off.

        Args:
            begin: waits until all sources are ready, and tells when the recording's clock showed 0, `time.monotonic`.
            stopped: whether the session has ended.

        Raises:
            InputError: the source can never bring frames.
        """
        ...


@dataclass(frozen=True)
class ReplayedVideo:
    """A video that is played at its own rate, or faster, again and again if it is looped.

    Attributes:
        video: the video.
        time_s: (frames,), times of its frames on the recording's clock, seconds.
        speed: seconds of video per second.
        loops: how often the video is played.
    """

    video: VideoInfo
    time_s: Float[np.ndarray, "frames"]
    speed: float = 1.0
    loops: int = 1

    def frames(self, begin: Callable[[], float], stopped: Callable[[], bool]) -> Generator[SourceFrame | str]:
        """See `LiveSource`: a frame arrives when its time has come."""
        length_s = float(self.time_s[-1] - self.time_s[0]) * (1 + 1 / max(1, len(self.time_s) - 1))
        images = read_frames(self.video)
        # As if the camera had filmed before: to open a video takes as long as several frames.
        first = next(images)
        began_s = begin()
        for loop in range(self.loops):
            images = read_frames(self.video) if loop else itertools.chain([first], images)
            for frame_s in self.time_s.tolist():
                time_s = frame_s + loop * length_s
                arrives_s = began_s + time_s / self.speed
                while (left_s := arrives_s - time.monotonic()) > 0:
                    if stopped():
                        return
                    time.sleep(min(left_s, 0.1))
                if stopped():
                    return
                yield SourceFrame(time_s, next(images), arrives_s)


@dataclass(frozen=True)
class CameraStream:
    """A device, or the address of a stream.

    Attributes:
        address: number of a device, or an address such as rtsp://camera/1, http://camera/video or gstreamer://PIPELINE.
        image_size_wh: width and height of the images that the rig expects, pixels.
    """

    address: str | int
    image_size_wh: tuple[int, int]

    def frames(self, begin: Callable[[], float], stopped: Callable[[], bool]) -> Generator[SourceFrame | str]:
        """See `LiveSource`: frames are timed when they arrive."""
        began_s = begin()
        while not stopped():
            capture = self._opened()
            if capture is None:
                yield f"{self.address} does not answer"
            else:
                try:
                    yield from self._read(capture, began_s, stopped)
                finally:
                    capture.release()
                if not stopped():
                    yield f"{self.address} has broken off"
            for _ in range(10):
                if not stopped():
                    time.sleep(_AGAIN_S / 10)

    def _opened(self) -> cv2.VideoCapture | None:
        milliseconds = round(1000 * _ANSWER_S)
        timeouts = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            milliseconds,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            milliseconds,
        ]
        with silence_opencv():
            if isinstance(self.address, int):
                capture = cv2.VideoCapture(self.address)
            elif self.address.startswith("gstreamer://"):
                capture = cv2.VideoCapture(self.address.removeprefix("gstreamer://"), cv2.CAP_GSTREAMER)
            else:
                capture = cv2.VideoCapture(self.address, cv2.CAP_FFMPEG, timeouts)
        return capture if capture.isOpened() else None

    def _read(
        self, capture: cv2.VideoCapture, began_s: float, stopped: Callable[[], bool]
    ) -> Generator[SourceFrame]:
        while not stopped():
            asked_s = time.monotonic()
            if not capture.grab():
                return
            arrived_s = time.monotonic()
            is_behind = arrived_s - asked_s < _WAITING_S
            there, image = (False, None) if is_behind else capture.retrieve()
            if there and image is not None and image.shape[1::-1] != self.image_size_wh:
                width, height = self.image_size_wh
                raise InputError(
                    self.address,
                    expected=f"images of {width} x {height} pixels, as the rig says",
                    found=f"{image.shape[1]} x {image.shape[0]}",
                )
            yield SourceFrame(arrived_s - began_s, image if there else None, arrived_s)
