"""Where a camera's frames come from: a video, a folder of images, or a live stream, all as one."""

from __future__ import annotations

import contextlib
import math
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.recordings import probe, quiet, read_frames

_Item = TypeVar("_Item")

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

#: Frames that are read ahead of those that are worked on.
_AHEAD = 4


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        number: from 0; a live stream leaves out those that nobody had time for.
        time_s: since the first frame.
        bgr: (height, width, 3).
    """

    number: int
    time_s: float
    bgr: UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Source:
    """Frames of one camera.

    Attributes:
        name: what people call it: a path, a device or an address.
        image_size_wh: width and height in pixels.
        num_frames: how many there are; None of a stream, which ends when it ends.
        frames: reads them from the first on; at most once of a stream.
        stream: whether frames come but once.
        newest: whether to leave frames out that come too fast.
    """

    name: str
    image_size_wh: tuple[int, int]
    num_frames: int | None
    frames: Callable[[], Iterator[Frame]]
    stream: bool = False
    newest: bool = False

    def first(self, num_frames: int | None) -> Source:
        """Its leading frames only; None keeps all.

        Raises:
            SettingsError: there are not so many.
        """
        if num_frames is None:
            return self
        most = math.inf if self.num_frames is None else self.num_frames
        if not 0 < num_frames <= most:
            expected = "1 or more" if self.num_frames is None else f"1 to {most}, the frames of {self.name}"
            raise SettingsError("frames", expected=expected, found=f"{num_frames}")
        # The frame after the last is not asked for: it may be broken.
        return replace(self, num_frames=num_frames, frames=lambda: islice(self.frames(), num_frames))


def open_source(source: Path | str, *, fps: float | None = None, live: bool = False) -> Source:
    """The frames of a video file, a folder of images, or a stream.

    Args:
        source: a path; or the address of a stream, such as rtsp://camera/1; or, live, the number of a device.
        fps: frames per second of a folder of images, which it needs, or of a video whose header is wrong.
        live: work on the newest frame of a stream, and leave out those that come meanwhile.

    Raises:
        InputError: it cannot be read, or has no frames; images differ in size.
        SettingsError: the rate is missing or not above 0.
    """
    if fps is not None:
        check_positive("--fps", fps)
    if live or "://" in str(source):
        return _stream(str(source), fps, live)
    path = Path(source)
    if path.is_dir():
        return _images(path, fps)
    video = probe(path)
    rate = fps or video.fps

    def frames() -> Iterator[Frame]:
        return (Frame(index, index / rate, bgr) for index, bgr in enumerate(read_frames(video)))

    return Source(str(path), video.image_size_wh, video.num_frames, frames)


def read_ahead(items: Iterator[_Item], *, newest: bool = False) -> Iterator[_Item]:
    """The same items, made in a thread, some ahead of the one that is worked on; its errors are raised here.

    Args:
        items: to be had one after the other.
        newest: when they are made faster than they are used, leave out the older ones, instead of waiting.
    """
    done = object()
    waiting: queue.Queue[object] = queue.Queue(maxsize=1 if newest else _AHEAD)
    stop = threading.Event()

    def put(item: object, *, force: bool = False) -> None:
        while not stop.is_set():
            with contextlib.suppress(queue.Full):
                waiting.put(item, timeout=0.0 if newest and not force else 0.1)
                return
            if newest and not force:
                with contextlib.suppress(queue.Empty):
                    waiting.get_nowait()

    def work() -> None:
        try:
            for item in items:
                if stop.is_set():
                    break
                put(item)
            put(done, force=True)
        except BaseException as error:
            # It is raised where the items are used.
            put(error, force=True)
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()

    thread = threading.Thread(target=work, daemon=True, name="psotrack-frames")
    thread.start()
    try:
        while (item := waiting.get()) is not done:
            if isinstance(item, BaseException):
                raise item
            yield item  # type: ignore[misc]
    finally:
        stop.set()
        # A camera that hangs must not hang the program.
        thread.join(timeout=1.0)


def holds_images(folder: Path) -> bool:
    """Whether a folder has images in it."""
    return bool(_image_paths(folder))


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sorts frame2.png before frame10.png."""
    words = re.split(r"(\d+)", path.name.lower())
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words]


def _image_paths(folder: Path) -> list[Path]:
    try:
        return sorted((path for path in folder.iterdir() if path.suffix.lower() in IMAGES), key=natural_key)
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(folder, expected="a folder to read", found=found) from error


def _images(folder: Path, fps: float | None) -> Source:
    paths = _image_paths(folder)
    if not paths:
        raise InputError(folder, expected=f"images, which end in {', '.join(IMAGES)}", found="none")
    if fps is None:
        raise SettingsError("--fps", expected=f"frames per second of the images in {folder}", found="none")
    height, width, _ = _image(paths[0]).shape

    def frames() -> Iterator[Frame]:
        for number, path in enumerate(paths):
            bgr = _image(path)
            if bgr.shape != (height, width, 3):
                raise InputError(
                    path,
                    expected=f"{width} x {height} pixels as {paths[0].name} has",
                    found=f"{bgr.shape[1]} x {bgr.shape[0]}",
                )
            yield Frame(number, number / fps, bgr)

    return Source(str(folder), (width, height), len(paths), frames)


def _image(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    try:
        coded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(path, expected="an image", found=(error.strerror or str(error)).lower()) from error
    image = cv2.imdecode(coded, cv2.IMREAD_COLOR_BGR) if len(coded) else None
    if image is None:
        raise InputError(path, expected="an image", found="a file that OpenCV cannot decode")
    return np.asarray(image, np.uint8)


def _stream(address: str, fps: float | None, live: bool) -> Source:
    with quiet():
        capture = cv2.VideoCapture(int(address) if address.isdecimal() else address)
    there, first = capture.read() if capture.isOpened() else (False, None)
    if not there or first is None:
        capture.release()
        found = "none that can be opened" if first is None and not there else "one without frames"
        raise InputError(address, expected="a camera or a stream", found=found)

    def frames() -> Iterator[Frame]:
        bgr, number = first, 0
        clock = _Clock(lambda: capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, fps)
        try:
            while True:
                yield Frame(number, clock.time_s(number), np.asarray(bgr, np.uint8))
                there, bgr = capture.read()
                number += 1
                if not there:
                    break
                if bgr.shape != first.shape:
                    size = f"{first.shape[1]} x {first.shape[0]} pixels"
                    found = f"{bgr.shape[1]} x {bgr.shape[0]} in frame {number}"
                    raise InputError(address, expected=size, found=found)
        finally:
            capture.release()

    return Source(address, (first.shape[1], first.shape[0]), None, frames, stream=True, newest=live)


class _Clock:
    """Times of a stream's frames: by its rate where that is given, by its own stamps, or when they come.

    Args:
        stamp_s: of the frame that was read last.
        fps: frames per second, where they are known.
    """

    def __init__(self, stamp_s: Callable[[], float], fps: float | None) -> None:
        self._stamp_s, self._fps = stamp_s, fps
        self._began_s, self._last_stamp_s = time.monotonic(), stamp_s()
        self._time_s, self._stamped = 0.0, True

    def time_s(self, number: int) -> float:
        """Of the frame that was read last, later than the one before."""
        if self._fps is not None:
            return number / self._fps
        if number == 0:
            return 0.0
        stamp_s = self._stamp_s()
        # Some cameras stamp nothing, and some streams start anew.
        self._stamped &= stamp_s > self._last_stamp_s
        if self._stamped:
            self._time_s += stamp_s - self._last_stamp_s
            self._last_stamp_s = stamp_s
        else:
            self._time_s = max(time.monotonic() - self._began_s, self._time_s + 1e-3)
        return self._time_s
