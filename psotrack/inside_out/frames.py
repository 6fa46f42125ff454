"""Frames of one camera, from a video file, a folder of images or a live stream; read and worked on ahead of their use.

In: a path, an address or a device. Out: a `FrameSource`, which describes the frames and reads them one by one as
`Frame` (number, time, image). `read_ahead` and `map_ahead` read frames, and work on them, in separate threads: so the
markers of images and of videos are found for a table.
"""

from __future__ import annotations

import contextlib
import csv
import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.recordings import (
    VideoInfo,
    frame_times,
    is_picture_folder,
    open_video,
    read_frames,
    read_grey,
    silence_opencv,
)
from psotrack.support import Report, atomic_write, no_progress, refuse_to_overwrite, whole_number

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Largest number of items that wait to be used.
_AHEAD = 4
#: Longest uninterrupted wait for an item, seconds. Python handles Ctrl-C in the main thread only; if another thread
#: received the signal, or on Windows, the signal does not end the wait.
_WAIT_S = 0.1
#: Number of threads that detect markers, each in an image of its own.
_WORKERS = min(4, os.cpu_count() or 1)
#: Columns of the table, after the one that says which image or frame.
_COLUMNS = ("id", *(f"{axis}{corner}_px" for corner in range(4) for axis in "xy"), "std_px")


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

    def grey(self) -> UInt8[np.ndarray, "height width"]:
        """(height, width), the image in grey."""
        return np.asarray(cv2.cvtColor(self.bgr, cv2.COLOR_BGR2GRAY), np.uint8)


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


def open_source(source: Path | str, *, fps: float | None = None, live: bool = False) -> FrameSource:
    """Open the frames of a video file, a folder of images, or a stream.

    Args:
        source: path of a video or a folder; or address of a stream, such as rtsp://camera/1; or, with `live`, number
            of a device.
        fps: frames per second; required for a folder of images, and for a video whose header has a wrong rate.
        live: always use the newest frame of a stream, and leave out the frames before.

    Raises:
        InputError: the source cannot be read or has no frames, or its images differ in size.
        SettingsError: `fps` is missing or not above 0.
    """
    if fps is not None:
        check_positive("--fps", fps)
    if live or "://" in str(source):
        return _stream(str(source), fps, live)
    path = Path(source)
    if fps is None and is_picture_folder(path):
        raise SettingsError(
            "--fps",
            expected=f"the rate at which the images in {path} were taken, because images do not state it",
            found="no --fps",
            remedy="add it in frames per second, such as --fps 25",
        )
    return _recorded(open_video(path, fps))


def _recorded(video: VideoInfo) -> FrameSource:
    """The frames of a file or a folder, at their times."""
    times_s = frame_times(video).time_s.tolist()

    def frames() -> Iterator[Frame]:
        shown = zip(times_s, read_frames(video), strict=True)
        return (Frame(number, time_s, bgr) for number, (time_s, bgr) in enumerate(shown))

    return FrameSource(str(video.path), video.image_size_wh, video.num_frames, frames, fps=video.fps)


def _stream(address: str, fps: float | None, live: bool) -> FrameSource:
    """The frames of a network address or of a camera connected to this computer; `live` uses the newest one."""
    number = whole_number(address)
    with silence_opencv():
        capture = cv2.VideoCapture(address if number is None else number)
    there, first = capture.read() if capture.isOpened() else (False, None)
    if not there or first is None:
        capture.release()
        found = "none that can be opened" if first is None and not there else "one without frames"
        raise InputError(address, expected="a camera or a stream", found=found)

    def frames() -> Iterator[Frame]:
        bgr = first
        try:
            for number, time_s in enumerate(_times_s(lambda: capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, fps)):
                if bgr.shape != first.shape:
                    size = f"{first.shape[1]} x {first.shape[0]} pixels"
                    found = f"{bgr.shape[1]} x {bgr.shape[0]} in frame {number}"
                    raise InputError(address, expected=size, found=found)
                yield Frame(number, time_s, np.asarray(bgr, np.uint8))
                there, bgr = capture.read()
                if not there:
                    break
        finally:
            capture.release()

    return FrameSource(
        address, (first.shape[1], first.shape[0]), None, frames, stream=True, newest=live, fps=fps
    )


def _times_s(stamp_s: Callable[[], float], fps: float | None) -> Iterator[float]:
    """Increasing times of a stream's frames, seconds, one each time that a frame was read.

    From a given rate, else from the stream's timestamps, else from the times of arrival.

    Args:
        stamp_s: returns the timestamp of the frame that was read last, seconds.
        fps: frames per second; None if unknown.
    """
    if fps is not None:
        yield from (number / fps for number in count())
    began_s, last_s, time_s, is_stamped = time.monotonic(), stamp_s(), 0.0, True
    while True:
        yield time_s
        # Some cameras give no timestamps, and the timestamps of some streams restart at 0.
        now_s = stamp_s()
        is_stamped &= now_s > last_s
        time_s = time_s + now_s - last_s if is_stamped else max(time.monotonic() - began_s, time_s + 1e-3)
        last_s = now_s


def read_ahead(items: Iterator[_Item], *, newest: bool = False) -> Iterator[_Item]:
    """Iterate over items that a thread produces, a few items ahead of the item in use.

    Errors of the thread are raised here. Ctrl-C ends the iteration within about a second, even if the thread hangs.

    Args:
        items: iterator that the thread runs.
        newest: leave out older items if items are produced faster than they are used; else the thread waits.
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
            # Any error is raised where the items are used.
            put(error, force=True)
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()

    thread = threading.Thread(target=work, daemon=True, name="psotrack-frames")
    thread.start()
    try:
        while (item := _until_there(lambda: waiting.get(timeout=_WAIT_S), queue.Empty)) is not done:
            if isinstance(item, BaseException):
                raise item
            yield item  # type: ignore[misc]
    finally:
        stop.set()
        # A camera that does not respond must not block the program.
        thread.join(timeout=1.0)


def _until_there(get: Callable[[], _Item], not_yet: type[Exception]) -> _Item:
    """Call a function until it does not raise `not_yet`; Ctrl-C can interrupt the wait."""
    while True:
        with contextlib.suppress(not_yet):
            return get()


def map_ahead(
    function: Callable[[_Item], _Result], items: Iterator[_Item], workers: int
) -> Iterator[_Result]:
    """Results of a function for items, in their order, computed by threads a few items ahead of the result in use.

    Errors of the function and of the items are raised here, in their order. Ctrl-C ends the iteration.

    Args:
        function: called in several threads at once.
        items: its arguments.
        workers: number of threads; 0 computes each result when it is asked for, so that no item waits.
    """
    if workers < 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="psotrack-map")
    waiting: deque[Future[_Result]] = deque()

    def first() -> _Result:
        future = waiting.popleft()
        return _until_there(lambda: future.result(timeout=_WAIT_S), NotYetError)

    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            # One item more than threads, so that no thread is idle while a result is in use.
            if len(waiting) > workers:
                yield first()
        while waiting:
            yield first()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def markers_of(
    source: FrameSource | Sequence[Path], dictionary: str, report: Report = no_progress
) -> Iterator[DetectedMarkers]:
    """Markers of a video's frames, or of photographs, which may differ in size and are searched thoroughly, in turn.

    Raises:
        InputError: a file is no image, the video ends early, or a frame has another size.
        SettingsError: there is no dictionary of this name.
    """
    items: Iterator[Frame | Path]
    if isinstance(source, FrameSource):
        items, count = read_ahead(source.frames()), source.num_frames or 0
    else:
        items, count = iter(source), len(source)
    detector = MarkerDetector(dictionary, thorough=not isinstance(source, FrameSource))

    def found(item: Frame | Path) -> DetectedMarkers:
        return detector.detect(item.grey() if isinstance(item, Frame) else read_grey(item))

    with report("markers", count) as advance:
        for markers in map_ahead(found, items, _WORKERS):
            advance(1)
            yield markers


def write_marker_table(
    path: Path,
    found: Sequence[DetectedMarkers],
    names: Sequence[str] | None = None,
    *,
    force: bool = False,
) -> None:
    """Write markers as CSV: one row per marker, with image or frame, id, corners and their standard deviation.

    Args:
        path: the file.
        found: markers of each image or frame.
        names: names of the images, for a column `image`; None for a column `frame` with numbers from 0.
        force: replace an existing file.

    Raises:
        OutputError: the file exists, or cannot be written.
    """
    refuse_to_overwrite(path, force)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("frame" if names is None else "image", *_COLUMNS))
        for where, markers in zip(names or map(str, range(len(found))), found, strict=True):
            for marker, corners, std_px in zip(
                markers.ids.tolist(), markers.corners_px, markers.std_px, strict=True
            ):
                rows.writerow((where, marker, *(f"{value:.3f}" for value in (*corners.ravel(), std_px))))
