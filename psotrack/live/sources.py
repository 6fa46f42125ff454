"""The cameras of a session, and their sources of frames: a device, the address of a stream, or a video that is played.

A source yields frames with their times on the recording's clock. The frames of a stream are timed by the stream's own
times, or else when they arrive. A stream that breaks off is opened again, once per second.
"""

from __future__ import annotations

import itertools
import logging
import os
import queue
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable
from urllib.parse import urlsplit

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import InputError
from psotrack.geometry import chosen_cameras
from psotrack.live.recorder import CameraRecorder
from psotrack.recordings import Recording, VideoInfo, read_frames, silence_opencv

#: How long a stream may take to answer and to bring a frame, seconds.
ANSWER_S = 5.0
_PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443, "rtmp": 1935}
#: How the recording's addresses name devices.
_DEVICE = "device "


def device_of(address: str) -> int | str | None:
    """Number or path of a device; None for an address of a stream."""
    if not address.startswith(_DEVICE):
        return None
    device = address.removeprefix(_DEVICE)
    return int(device) if device.isdecimal() else device


def shown_address(address: str) -> str:
    """The address without its password, which does not belong into logs."""
    return re.sub(r"(://[^/@:]*):[^/@]*@", r"\1:***@", address)


def why_silent(address: str, took_s: float) -> str:
    """Why a camera could not be opened, as the end of a sentence after "found".

    Args:
        address: address of a stream, or a device.
        took_s: time after which OpenCV gave up, seconds.
    """
    device = device_of(address)
    if device is not None:
        return _why_no_device(f"/dev/video{device}" if isinstance(device, int) else device)
    if took_s >= ANSWER_S:
        return f"that it does not answer within {ANSWER_S:g} s"
    parts = urlsplit(address)
    port = parts.port or _PORTS.get(parts.scheme)
    if parts.hostname is None or port is None:
        return "that it does not answer"
    try:
        socket.create_connection((parts.hostname, port), ANSWER_S).close()
    except OSError as error:
        return f"that it does not answer: {error.strerror or error}".lower()
    return "no video there; are path, user name and password right?"


def _why_no_device(path: str) -> str:
    if sys.platform == "linux" and not os.path.exists(path):
        return f"no {path}; is the camera plugged in?"
    if sys.platform == "linux" and not os.access(path, os.R_OK | os.W_OK):
        return f"no permission for {path}; is this user in the group that owns it, mostly `video`?"
    return "no such camera, or another program that uses it"


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
        """See `LiveSource`: a frame arrives, decoded, when its time has come."""
        length_s = float(self.time_s[-1] - self.time_s[0]) * (1 + 1 / max(1, len(self.time_s) - 1))
        images = itertools.chain.from_iterable(read_frames(self.video) for _ in range(self.loops))
        image, began_s = next(images, None), begin()
        for loop, frame_s in itertools.product(range(self.loops), self.time_s.tolist()):
            time_s = frame_s + loop * length_s
            arrives_s = began_s + time_s / self.speed
            assert image is not None, "a video has as many frames as times"
            while (left_s := arrives_s - time.monotonic()) > 0 and not stopped():
                time.sleep(min(left_s, 0.1))
            if stopped():
                return
            yield SourceFrame(time_s, image, arrives_s)
            image = next(images, None)


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


#: Time over which the least delay of a stream is taken, seconds.
_BLOCK_S = 2.0
#: The least delays of two blocks that differ by more do not come from one clock, seconds: 0.5 % of `_BLOCK_S`, a frame
#: that the stream does not count, or a network that is held up for the whole block.
_AGREED_S = 0.01


class StreamClock:
    """Removes the jitter of arrival from the times of a stream's frames.

    A frame is filmed at its stream's time plus a delay that nobody knows, and arrives late by an amount that changes
    from frame to frame. The least delay of the last seconds is the one with no such lateness in it. It is found anew
    every two seconds, because two clocks drift apart. The times are used only where the last two least delays agree:
    a stream of JPEG images over HTTP, for instance, carries no times, and FFmpeg invents them at 25 per second.

    Attributes:
        is_used: whether the stream's times are used; None until the first two blocks are over.
    """

    def __init__(self) -> None:
        self.is_used: bool | None = None
        self._ends_s = self._last_s = -np.inf
        self._least_s = self._before_s = np.inf

    def time_s(self, stream_s: float, arrived_s: float) -> float:
        """When a frame would have arrived without jitter; its arrival where the stream's times cannot be used.

        Args:
            stream_s: the frame's time in the stream, seconds.
            arrived_s: when it arrived, seconds of `time.monotonic`.
        """
        if arrived_s >= self._ends_s:
            self._end_block(arrived_s)
        # A time that does not increase is none, and agrees with nothing.
        delay_s = arrived_s - stream_s if stream_s > self._last_s else -np.inf
        self._last_s = stream_s
        self._least_s = min(self._least_s, delay_s)
        least_s = min(self._least_s, self._before_s)
        return stream_s + least_s if self.is_used and np.isfinite(least_s) else arrived_s

    def _end_block(self, now_s: float) -> None:
        least_s = np.array([self._before_s, self._least_s])
        if not np.isposinf(least_s).any():  # else a block had no frame
            self.is_used = bool(np.isfinite(least_s).all() and np.ptp(least_s) <= _AGREED_S)
        self._before_s, self._least_s = self._least_s, np.inf
        self._ends_s = now_s + _BLOCK_S


#: Rate of a stream that does not tell its own, frames per second.
_USUAL_HZ = 25.0


@dataclass(frozen=True)
class LiveCamera:
    """A camera of a session.

    Attributes:
        name: name of the camera in the rig.
        source: source of its frames.
        fps: frames per second.
        line_time_s: time from row to row of a rolling shutter, seconds; 0 for a global shutter.
        ignore: image that is white where nothing counts as foreground; None for no such image.
        recorder: keeps the frames; None where they are not kept.
    """

    name: str
    source: LiveSource
    fps: float
    line_time_s: float = 0.0
    ignore: Path | None = None
    recorder: CameraRecorder | None = None


def live_cameras(
    recording: Recording,
    names: Sequence[str] | None = None,
    *,
    replay: bool,
    speed: float = 1.0,
    loops: int = 1,
) -> list[LiveCamera]:
    """The cameras of a recording that have a source of frames: streams and devices, or videos that are replayed.

    Args:
        recording: the recording.
        names: names of the cameras to use; None: all that have a source.
        replay: play the videos.
        speed: seconds of video per second.
        loops: how often the videos are played.

    Raises:
        InputError: fewer than two cameras have a source.
        SettingsError: a name fits no camera, or a camera is named twice.
    """
    rig = recording.rig if names is None else recording.rig.select(chosen_cameras(names, recording.rig.names))
    found = []
    for name, (width, height) in zip(rig.names, rig.cameras.image_size_wh.astype(int).tolist(), strict=True):
        camera = recording.by_name[name]
        video, times = camera.video, camera.times
        source: LiveSource
        if replay and video is not None and times is not None:
            source = ReplayedVideo(video, times.time_s, speed, loops)
        elif not replay and camera.stream is not None:
            source = CameraStream(camera.stream, (width, height))
        else:
            continue
        fps = times.fps if times is not None else _USUAL_HZ
        found.append(LiveCamera(name, source, fps, camera.line_time_s, camera.ignore))
    if len(found) < 2:
        what = "videos" if replay else "the address of a stream or the number of a device as `video`"
        expected, there = f"at least two cameras of the rig with {what}", [each.name for each in found]
        remedy = "" if replay else "--replay plays the videos of a recording"
        raise InputError(recording.folder, expected=expected, found=", ".join(there) or "none", remedy=remedy)
    return found
