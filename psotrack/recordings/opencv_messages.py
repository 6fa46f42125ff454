"""Messages of OpenCV and FFmpeg, which they print about files that they cannot read."""

from __future__ import annotations

import os
import threading
from contextlib import AbstractContextManager

import cv2

_FFMPEG_LOG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_FFMPEG_QUIET = "-8"


class _Silence:
    """Levels of messages, which are the process's: the first of several threads sets them, the last restores them."""

    def __init__(self) -> None:
        self._lock, self._num_threads = threading.Lock(), 0
        self._level, self._is_chosen = 0, False

    def __enter__(self) -> None:
        with self._lock:
            if self._num_threads == 0:
                self._level, self._is_chosen = (
                    cv2.utils.logging.getLogLevel(),
                    _FFMPEG_LOG_LEVEL in os.environ,
                )
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
                os.environ.setdefault(_FFMPEG_LOG_LEVEL, _FFMPEG_QUIET)
            self._num_threads += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._num_threads -= 1
            if self._num_threads == 0:
                cv2.utils.logging.setLogLevel(self._level)
                if not self._is_chosen:
                    del os.environ[_FFMPEG_LOG_LEVEL]


_silence = _Silence()


def silence_opencv() -> AbstractContextManager[None]:
    """Suppress the messages of OpenCV and FFmpeg about a file that is opened, decoded or written in this block.

    Errors replace them. Libraries that write to the terminal themselves, such as libjpeg, are not silenced. FFmpeg
    reads its log level from the environment whenever a file is opened. A log level that the user has set is kept.
    """
    return _silence
