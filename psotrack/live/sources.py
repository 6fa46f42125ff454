"""Sources of frames: a device, the address of a stream, or a video that is played at its own rate.

A source yields frames with their times on the recording's clock. The frames of a stream are timed by the stream's own
times, or else when they arrive. A stream that breaks off is opened again, once per second.
"""

from __future__ import annotations

import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import InputError
from psotrack.live.addresses import ANSWER_S, device_of, shown_address, why_silent
from psotrack.live.stream_clock import StreamClock
from psotrack.recordings import VideoInfo, read_frames, silence_opencv

logger = logging.getLogger(__name__)

#: How long a stream is left alone after it broke off, seconds.
_AGAIN_S = 1.0
_BY_ARRIVAL = (
    "frames are timed when they arrive: the stream has no times that agree with this computer's clock"
)


@dataclass(frozen=True)
class SourceFrame:
    """A frame of a source.

    Attributes:
        time_s: when it was filmed, on the recording's clock, seconds.
        image: BGR.
        arrived_s: when it arrived, `time.monotonic`.
    """

    time_s: float
    image: UInt8[np.ndarray, "height width 3"]
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
        images = itertools.chain.from_iterable(read_frames(self.video) for _ in range(self.loops))
        # As if the camera had filmed before: to open a video takes as long as several frames.
        images = itertools.chain([next(images)], images)
        began_s = begin()
        for loop, frame_s in itertools.product(range(self.loops), self.time_s.tolist()):
            time_s = frame_s + loop * length_s
            arrives_s = began_s + time_s / self.speed
            while (left_s := arrives_s - time.monotonic()) > 0 and not stopped():
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
        """See `LiveSource`: frames are read when they arrive, by a thread of its own, and wait until they are taken."""
        began_s, is_over = begin(), threading.Event()
        waiting: queue.SimpleQueue[SourceFrame | str | Exception | None] = queue.SimpleQueue()

        def read() -> None:
            try:
                for frame in self._read(began_s, lambda: is_over.is_set() or stopped()):
                    waiting.put(frame)
                waiting.put(None)
            except Exception as error:
                waiting.put(error)

        # A daemon: the program ends also where nobody closes the generator.
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            while (frame := waiting.get()) is not None:
                if isinstance(frame, Exception):
                    raise frame
                yield frame
        finally:
            is_over.set()
            reader.join()

    def _read(self, began_s: float, stopped: Callable[[], bool]) -> Iterator[SourceFrame | str]:
        """The frames as they arrive, from one connection after the other."""
        shown, said = shown_address(self.address), set[bool]()
        while not stopped():
            asked_s, clock = time.monotonic(), StreamClock()
            capture = self._opened()
            is_open = capture.isOpened()
            if not is_open:
                why = why_silent(self.address, time.monotonic() - asked_s)
                yield f"expected frames of {shown}, found {why}; it is tried again every second"
            while not stopped() and capture.grab():
                arrived_s = time.monotonic()
                filmed_s = clock.time_s(capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, arrived_s)
                there, image = capture.retrieve()
                if not there:
                    continue
                self._check_size(image)
                yield SourceFrame(filmed_s - began_s, image, arrived_s)
                if clock.is_used is None or clock.is_used in said:
                    continue
                said.add(clock.is_used)
                if clock.is_used:
                    logger.info("%s: frames are timed by the stream", shown)
                else:
                    yield _BY_ARRIVAL
            capture.release()
            if stopped():
                return
            if is_open:
                yield f"{shown} has broken off; it is tried again every second"
            time.sleep(_AGAIN_S)

    def _check_size(self, image: UInt8[np.ndarray, "height width 3"]) -> None:
        if image.shape[1::-1] != self.image_size_wh:
            expected = "images of {} x {} pixels, as the rig says".format(*self.image_size_wh)
            found = f"{image.shape[1]} x {image.shape[0]}"
            remedy = "let the camera send this size, or calibrate the camera at the size that it sends"
            raise InputError(shown_address(self.address), expected=expected, found=found, remedy=remedy)

    def _opened(self) -> cv2.VideoCapture:
        with silence_opencv():
            if (device := device_of(self.address)) is not None:
                return cv2.VideoCapture(device)
            if self.address.startswith("gstreamer://"):
                if not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
                    expected, found = "a build of OpenCV with GStreamer", "OpenCV without GStreamer"
                    remedy = "build OpenCV from source with GStreamer, or take an address of RTSP or HTTP"
                    raise InputError(self.address, expected=expected, found=found, remedy=remedy)
                return cv2.VideoCapture(self.address.removeprefix("gstreamer://"), cv2.CAP_GSTREAMER)
            limit_ms = round(1000 * ANSWER_S)
            limits = cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms
            return cv2.VideoCapture(self.address, cv2.CAP_FFMPEG, limits)
