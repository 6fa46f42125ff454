"""Frames from a stream: a network address, or a camera connected to this computer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from psotrack.errors import InputError
from psotrack.inside_out.frames.records import Frame, FrameSource
from psotrack.recordings import silence_opencv
from psotrack.support import whole_number


def open_stream(address: str, fps: float | None, live: bool) -> FrameSource:
    """Open the frames of a stream.

    Args:
        address: address of the stream, such as rtsp://camera/1, or number of a device.
        fps: frames per second; None takes the times from the stream, or the times of arrival.
        live: leave out frames that come faster than they are used.

    Raises:
        InputError: the stream cannot be opened or has no frames; or, when frames are read, frame sizes differ.
    """
    number = whole_number(address)
    with silence_opencv():
        capture = cv2.VideoCapture(address if number is None else number)
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

    return FrameSource(
        address, (first.shape[1], first.shape[0]), None, frames, stream=True, newest=live, fps=fps
    )


class _Clock:
    """Times of a stream's frames: from a given rate, else from the stream's timestamps, else from the times of arrival.

    Args:
        stamp_s: returns the timestamp of the frame that was read last, seconds.
        fps: frames per second; None if unknown.
    """

    def __init__(self, stamp_s: Callable[[], float], fps: float | None) -> None:
        self._stamp_s, self._fps = stamp_s, fps
        self._began_s, self._last_stamp_s = time.monotonic(), stamp_s()
        self._time_s, self._stamped = 0.0, True

    def time_s(self, number: int) -> float:
        """Time of the frame that was read last, seconds; always later than the time of the frame before."""
        if self._fps is not None:
            return number / self._fps
        if number == 0:
            return 0.0
        stamp_s = self._stamp_s()
        # Some cameras give no timestamps, and the timestamps of some streams restart at 0.
        self._stamped &= stamp_s > self._last_stamp_s
        if self._stamped:
            self._time_s += stamp_s - self._last_stamp_s
            self._last_stamp_s = stamp_s
        else:
            self._time_s = max(time.monotonic() - self._began_s, self._time_s + 1e-3)
        return self._time_s
