"""Messages of OpenCV and FFmpeg, which they print about files that they cannot read."""

from __future__ import annotations

import logging
import os
import tempfile
import threading
from contextlib import AbstractContextManager

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

logger = logging.getLogger(__name__)

_FFMPEG_LOG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_FFMPEG_QUIET = "-8"

#: How the lines begin that libjpeg writes about an image (`jerror.h`): its warnings.
_OF_LIBJPEG = (
    b"Corrupt JPEG data", b"Premature end of JPEG", b"Invalid SOS", b"Inconsistent progression", b"Unknown Adobe color",
    b"Warning: unknown JFIF", b"Invalid progressive",
)  # fmt: skip
#: stderr is the process's: JPEGs are decoded one after the other, so that each has its own messages.
_decoding = threading.Lock()


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

    Errors replace them. Libraries that write to the terminal themselves, such as libjpeg, are not silenced: see
    `decode_jpeg`. FFmpeg reads its log level from the environment whenever a file is opened. A log level that the user
    has set is kept.
    """
    return _silence


def decode_jpeg(
    coded: UInt8[np.ndarray, " bytes"], flags: int, where: object
) -> Shaped[np.ndarray, "..."] | None:
    """Decode a JPEG; None if OpenCV cannot.

    libjpeg writes about damaged images straight to stderr. Its first line becomes a warning with the name of the
    image; what else was written meanwhile, by other threads, goes to stderr afterwards.

    Args:
        coded: content of a JPEG file.
        flags: flags of `cv2.imdecode`.
        where: the file, for the warning.
    """
    with _decoding, silence_opencv(), tempfile.TemporaryFile() as taken:
        stderr = os.dup(2)
        try:
            os.dup2(taken.fileno(), 2)
            image = cv2.imdecode(coded, flags)
        except cv2.error:
            image = None
        finally:
            os.dup2(stderr, 2)
            taken.seek(0)
            lines = taken.read().splitlines(keepends=True)
            os.write(stderr, b"".join(line for line in lines if not line.startswith(_OF_LIBJPEG)))
            os.close(stderr)
    if image is None:
        return None
    said = next((line.decode().strip() for line in lines if line.startswith(_OF_LIBJPEG)), None)
    if said is not None:
        logger.warning("%s is damaged (%s)", where, said)
    return np.asarray(image)
