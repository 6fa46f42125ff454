"""Image files that are the frames of a video: their order, and reading them; messages of OpenCV and FFmpeg."""

from __future__ import annotations

import contextlib
import glob
import io
import logging
import os
import re
import struct
import tempfile
import threading
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image

from psotrack.errors import InputError, system_errors

logger = logging.getLogger(__name__)

_FFMPEG_LOG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_FFMPEG_QUIET = "-8"

#: How the lines begin that libjpeg writes about an image (`jerror.h`): its warnings.
_OF_LIBJPEG = (
    b"Corrupt JPEG data", b"Premature end of JPEG", b"Invalid SOS", b"Inconsistent progression", b"Unknown Adobe color",
    b"Warning: unknown JFIF", b"Invalid progressive",
)  # fmt: skip
#: How those of libpng begin.
_OF_LIBPNG = b"libpng "
#: stderr is the process's: images are decoded one after the other, so that each has its own messages.
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
    `_decode`. FFmpeg reads its log level from the environment whenever a file is opened. A log level that the user
    has set is kept.
    """
    return _silence


#: Endings of files that are read as images.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
#: Formats that are read beside PNG, by Pillow's names.
_FORMATS = ("JPEG", "BMP", "TIFF", "WEBP", "PPM")
#: Largest number of pixels of an image, seven times that of a large camera: Pillow refuses more.
MOST_PIXELS = 178_956_970
#: Longest side of an image, pixels: OpenCV warps no larger ones.
MOST_SIDE = 2**15 - 2
#: First bytes of a PNG, and number of bytes up to the end of its size.
_PNG, _PNG_HEAD = b"\x89PNG\r\n\x1a\n", 24
#: Numbers of bits that cameras use.
_DEPTHS = (8, 10, 12, 14, 16)


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Key that sorts frame2.png before frame10.png."""
    words = re.split(r"(\d+)", path.name.lower())
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words]


def image_files(folder: Path) -> list[Path]:
    """The images of a folder, in natural order.

    Raises:
        InputError: the folder cannot be read.
    """
    with system_errors(folder, "a folder to read"):
        # A name that begins with a point is a hidden file, such as macOS's ._frame1.png.
        shown = [path for path in folder.iterdir() if not path.name.startswith(".")]
        images = [path for path in shown if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    return sorted(images, key=natural_key)


def read_image(path: Path, depth_bits: int = 16) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image, BGR, as the sensor saw it. Grey images get three equal channels.

    A note on how to turn the image for people (EXIF) is ignored, because a lens is calibrated for the sensor.

    Args:
        path: path of the file.
        depth_bits: number of bits that the values of an image of 16 bits use, of which the upper 8 are kept.

    Raises:
        InputError: the file cannot be read, or is no image.
    """
    image = _decode(path, cv2.IMREAD_COLOR_BGR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.dtype == np.uint16:
        image = np.minimum(image >> (depth_bits - 8), 255)
    elif image.dtype != np.uint8:
        raise InputError(path, expected="an image of 8 or 16 bits", found=f"one of {image.dtype}")
    return image.astype(np.uint8)


def depth_of(paths: Sequence[Path]) -> int:
    """Number of bits that the values of images use, 8 to 16, by the brightest pixel of all.

    Cameras write 10, 12 or 14 bits into images of 16 bits, in which the upper bits are then empty.

    Raises:
        InputError: a file cannot be read, or is no image.
    """
    images = [_decode(path, cv2.IMREAD_UNCHANGED) for path in paths]
    most = max((int(image.max()) for image in images if image.dtype == np.uint16), default=0)
    return next(bits for bits in _DEPTHS if most < 2**bits)


def read_mask(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read an image in grey levels.

    Raises:
        InputError: the file cannot be read, or is no image.
    """
    return np.asarray(_decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION), np.uint8)


def read_grey(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read an image of any depth as grey levels; in an image of 16 bits, its brightest pixel shows how many are used.

    Raises:
        InputError: the file cannot be read, or is no image.
    """
    image = _decode(path, cv2.IMREAD_COLOR_BGR | cv2.IMREAD_ANYDEPTH)
    levels = image if image.dtype == np.uint8 else read_image(path, depth_of([path]))
    return np.asarray(cv2.cvtColor(np.asarray(levels, np.uint8), cv2.COLOR_BGR2GRAY), np.uint8)


def is_image(path: Path) -> bool:
    """Whether a file is an image by its name, or by its content; a file that cannot be read is none."""
    return path.suffix.lower() in IMAGE_SUFFIXES or bool(path.is_file() and cv2.haveImageReader(str(path)))


def _decode(path: Path, flags: int) -> Shaped[np.ndarray, "..."]:
    """Decode an image file, whose damage becomes a warning where OpenCV decodes the rest.

    libjpeg and libpng write about damaged images straight to stderr. libjpeg's first line becomes the warning; what
    else was written meanwhile, by other threads, goes to stderr afterwards.
    """
    with system_errors(path, "an image"):
        coded = np.fromfile(path, np.uint8)
    data = coded.tobytes()
    check_pixels(path, *_claimed_size_wh(data, path))
    image: Shaped[np.ndarray, "..."] | None = None
    with _decoding, silence_opencv(), tempfile.TemporaryFile() as taken:
        stderr = os.dup(2)
        try:
            os.dup2(taken.fileno(), 2)
            with contextlib.suppress(cv2.error):
                image = cv2.imdecode(coded, flags)
        finally:
            os.dup2(stderr, 2)
            taken.seek(0)
            lines = taken.read().splitlines(keepends=True)
            own = (_OF_LIBPNG, *_OF_LIBJPEG)
            os.write(stderr, b"".join(line for line in lines if not line.startswith(own)))
            os.close(stderr)
    if image is None:
        is_png = data.startswith(_PNG)
        found = "a PNG that is cut short or damaged" if is_png else "a file that OpenCV cannot decode"
        raise InputError(path, expected="an image", found=found)
    said = next((line.decode().strip() for line in lines if line.startswith(_OF_LIBJPEG)), None)
    if said is not None:
        logger.warning("%s is damaged (%s)", path, said)
    return np.asarray(image)


def check_pixels(where: object, width: int, height: int) -> None:
    """Raise `InputError` for images, also of a video, that would take gigabytes or that OpenCV cannot warp."""
    if width * height > MOST_PIXELS:
        expected = f"images of at most {MOST_PIXELS} pixels"
    elif max(width, height) > MOST_SIDE:
        expected = f"images of at most {MOST_SIDE} pixels a side"
    else:
        return
    raise InputError(where, expected=expected, found=f"{width} x {height} pixels")


def _claimed_size_wh(data: bytes, where: object) -> tuple[int, int]:
    """Width and height that the header of an image states, before OpenCV asks for the memory that they take."""
    # Pillow refuses a PNG whose notes are damaged, too.
    if data.startswith(_PNG) and len(data) >= _PNG_HEAD:
        if not _has_its_parts(data):
            raise InputError(where, expected="an image", found="a PNG that is cut short or damaged")
        return struct.unpack_from(">II", data, _PNG_HEAD - 8)
    try:
        with warnings.catch_warnings():
            # OpenCV decides whether the rest of a damaged file can be read.
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                return image.size
    except Image.DecompressionBombError as error:
        found = str(error).partition("(")[2].partition(")")[0]
        raise InputError(where, expected=f"images of at most {MOST_PIXELS} pixels", found=found) from error
    # Of the other formats that OpenCV decodes, a few bytes can take gigabytes. A damaged header leads to any error.
    except Exception as error:
        found = f"a file that is no PNG, {', '.join(_FORMATS)}, or a damaged one"
        raise InputError(where, expected="an image", found=found) from error


def _has_its_parts(png: bytes) -> bool:
    """Whether all parts of a PNG lie within the file: OpenCV takes the memory that a part states as its length."""
    begin = len(_PNG)
    while begin < len(png) and png[begin + 4 : begin + 8] != b"IEND":
        # Length, name and checksum of a part take twelve bytes.
        begin += 12 + int.from_bytes(png[begin : begin + 4], "big")
    return begin < len(png)


def find_images(folder: Path, pattern: str, where: str) -> tuple[Path, ...]:
    """The files that fit a pattern such as `left/*.png`, in natural order.

    Args:
        folder: folder to which the pattern is relative.
        pattern: pattern of the files' paths.
        where: place of the pattern, for messages.

    Raises:
        InputError: no file fits.
    """
    found = sorted(
        (Path(path) for path in glob.glob(str(Path(glob.escape(str(folder))) / pattern))), key=natural_key
    )
    files = tuple(path for path in found if path.is_file())
    if not files:
        raise InputError(where, expected="a pattern that fits image files, such as left/*.png", found=pattern)
    return files
