"""Messages of OpenCV and FFmpeg, which they print about files that they cannot read."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

import cv2

_FFMPEG_LOG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_FFMPEG_QUIET = "-8"
#: Levels are the process's: two threads that set and restore them at once would leave them set.
_opening = threading.Lock()


@contextlib.contextmanager
def silence_opencv() -> Iterator[None]:
    """Suppress the messages of OpenCV and FFmpeg about a file that is opened or decoded in this block.

    Errors replace them. Libraries that write to the terminal themselves, such as libpng, are not silenced.
    FFmpeg reads its log level from the environment whenever a file is opened. A log level that the user has set is
    kept.
    """
    with _opening:
        level = cv2.utils.logging.getLogLevel()
        chosen = _FFMPEG_LOG_LEVEL in os.environ
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        os.environ.setdefault(_FFMPEG_LOG_LEVEL, _FFMPEG_QUIET)
        try:
            yield
        finally:
            cv2.utils.logging.setLogLevel(level)
            if not chosen:
                del os.environ[_FFMPEG_LOG_LEVEL]
