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
from psotrack.live.addresses import ANSWER_S, device_of, shown_address, why_silent
from psotrack.recordings import VideoInfo, read_frames, silence_opencv

#: How long a stream is left alone after it broke off, seconds.
_AGAIN_S = 1.0
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
        address: an address such as rtsp://camera/1, http://camera/video or gstreamer://PIPELINE; or a device, such as
            "device 0" or "device /dev/v4l/by-id/left".
        image_size_wh: width and height of the images that the rig expects, pixels.
    """

    address: str
    image_size_wh: tuple[int, int]

    def frames(self, begin: Callable[[], float], stopped: Callable[[], bool]) -> Generator[SourceFrame | str]:
        """See `LiveSource`: frames are timed when they arrive."""
        began_s = begin()
        while not stopped():
            asked_s = time.monotonic()
            capture = self._opened()
            if not capture.isOpened():
                why = why_silent(self.address, time.monotonic() - asked_s)
                yield f"expected frames of {shown_address(self.address)}, found {why}; it is tried again every second"
            else:
                try:
                    yield from self._read(capture, began_s, stopped)
                finally:
                    capture.release()
                if not stopped():
                    yield f"{shown_address(self.address)} has broken off; it is tried again every second"
            for _ in range(10):
                if not stopped():
                    time.sleep(_AGAIN_S / 10)

    def _opened(self) -> cv2.VideoCapture:
        milliseconds = round(1000 * ANSWER_S)
        timeouts = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            milliseconds,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            milliseconds,
        ]
        with silence_opencv():
            if (device := device_of(self.address)) is not None:
                return cv2.VideoCapture(device)
            if self.address.startswith("gstreamer://"):
                if not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
                    raise InputError(
                        self.address,
                        expected="a build of OpenCV with GStreamer",
                        found="OpenCV without GStreamer",
                        remedy="build OpenCV from source with GStreamer, or take an address of RTSP or HTTP",
                    )
                return cv2.VideoCapture(self.address.removeprefix("gstreamer://"), cv2.CAP_GSTREAMER)
            return cv2.VideoCapture(self.address, cv2.CAP_FFMPEG, timeouts)

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
                    shown_address(self.address),
                    expected=f"images of {width} x {height} pixels, as the rig says",
                    found=f"{image.shape[1]} x {image.shape[0]}",
                    remedy="let the camera send this size, or calibrate the camera at the size that it sends",
                )
            yield SourceFrame(arrived_s - began_s, image if there else None, arrived_s)
