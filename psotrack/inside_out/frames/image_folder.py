"""Frames from a folder of images."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, SettingsError
from psotrack.inside_out.frames.records import Frame, FrameSource

#: Endings of files that are read as images.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def folder_has_images(folder: Path | str) -> bool:
    """Whether a folder contains images."""
    return bool(_image_paths(Path(folder)))


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Key that sorts frame2.png before frame10.png."""
    words = re.split(r"(\d+)", path.name.lower())
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words]


def open_image_folder(folder: Path, fps: float | None) -> FrameSource:
    """Open the images of a folder, in natural order, as frames at `fps` frames per second.

    Raises:
        InputError: the folder cannot be read or has no images; or, when frames are read, image sizes differ.
        SettingsError: `fps` is None.
    """
    paths = _image_paths(folder)
    if not paths:
        raise InputError(folder, expected=f"images, which end in {', '.join(IMAGE_SUFFIXES)}", found="none")
    if fps is None:
        raise SettingsError("--fps", expected=f"frames per second of the images in {folder}", found="none")
    height, width, _ = _read_image(paths[0]).shape

    def frames() -> Iterator[Frame]:
        for number, path in enumerate(paths):
            bgr = _read_image(path)
            if bgr.shape != (height, width, 3):
                raise InputError(
                    path,
                    expected=f"{width} x {height} pixels as in {paths[0].name}",
                    found=f"{bgr.shape[1]} x {bgr.shape[0]}",
                )
            yield Frame(number, number / fps, bgr)

    return FrameSource(str(folder), (width, height), len(paths), frames)


def _image_paths(folder: Path) -> list[Path]:
    try:
        return sorted(
            (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES), key=natural_key
        )
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(folder, expected="a folder to read", found=found) from error


def _read_image(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    try:
        coded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(path, expected="an image", found=(error.strerror or str(error)).lower()) from error
    image = cv2.imdecode(coded, cv2.IMREAD_COLOR_BGR) if len(coded) else None
    if image is None:
        raise InputError(path, expected="an image", found="a file that OpenCV cannot decode")
    return np.asarray(image, np.uint8)
