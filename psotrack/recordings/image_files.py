"""Image files that are the frames of a video: their order, and reading them."""

from __future__ import annotations

import glob
import re
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError

#: Endings of files that are read as images.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Key that sorts frame2.png before frame10.png."""
    words = re.split(r"(\d+)", path.name.lower())
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words]


def image_files(folder: Path) -> list[Path]:
    """The images of a folder, in natural order.

    Raises:
        InputError: the folder cannot be read.
    """
    try:
        return sorted(
            (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES), key=natural_key
        )
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(folder, expected="a folder to read", found=found) from error


def read_image(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image, BGR.

    Raises:
        InputError: the file cannot be read, or is no image.
    """
    return _decode(path, cv2.IMREAD_COLOR_BGR)


def read_mask(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read an image in grey levels.

    Raises:
        InputError: the file cannot be read, or is no image.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE)


def _decode(path: Path, flags: int) -> UInt8[np.ndarray, "..."]:
    try:
        coded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(path, expected="an image", found=(error.strerror or str(error)).lower()) from error
    image = cv2.imdecode(coded, flags) if len(coded) else None
    if image is None:
        raise InputError(path, expected="an image", found="a file that OpenCV cannot decode")
    return np.asarray(image, np.uint8)


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
