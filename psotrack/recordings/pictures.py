"""Videos of any form: a video file, or a folder of pictures that are its frames.

Every command that takes a video takes a folder of pictures through `open_video`. The pictures are the folder's image
files in the order of their numbers; other files are ignored. Grey pictures, and pictures of 16
bits, become pictures of three channels of 8 bits (see `VideoInfo.depth_bits`).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from psotrack.errors import InputError, check_positive
from psotrack.recordings.image_files import IMAGE_SUFFIXES, image_files
from psotrack.recordings.video import VideoInfo, probe, probe_images

_logger = logging.getLogger(__name__)
#: Largest number of missing numbers that a message names.
_SHOWN = 5


def open_video(path: Path | str, fps: float | None = None) -> VideoInfo:
    """A video file, or a folder of pictures as a video.

    Args:
        path: path of the file or the folder.
        fps: frames per second; needed for pictures, which do not state it. For a video file, instead of its own times.

    Raises:
        InputError: there is no video at the path, the folder has no pictures, or the rate of pictures is not given.
        SettingsError: the rate is not above 0.
    """
    path = Path(path)
    if path.is_dir():
        return open_pictures(path, fps)
    if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
        raise InputError(
            path,
            expected="a video, or a folder of pictures",
            found="one picture",
            remedy=f"name its folder, {path.parent}",
        )
    video = probe(path)
    if fps is None:
        return video
    check_positive("fps", fps)
    return video.at_rate(fps)


def open_pictures(folder: Path, fps: float | None) -> VideoInfo:
    """A folder of pictures as a video; see `open_video`. Missing numbers among the pictures are a warning."""
    paths = image_files(folder)
    if not paths:
        raise InputError(folder, expected=f"images, which end in {', '.join(IMAGE_SUFFIXES)}", found="none")
    if fps is None:
        raise InputError(
            folder,
            expected="the rate of its pictures, because pictures do not state it",
            found="none",
            remedy="state it as fps, in frames per second",
        )
    warn_of_missing_numbers(folder, paths)
    return probe_images(paths, fps)


def is_picture_folder(path: Path) -> bool:
    """Whether a path is a folder with pictures."""
    return path.is_dir() and bool(image_files(path))


def warn_of_missing_numbers(folder: Path, paths: Sequence[Path]) -> None:
    """Warn of numbers that are missing: each picture counts as the frame after the one before."""
    found = [re.findall(r"\d+", path.stem) for path in paths]
    if len(paths) < 3 or not all(found):
        return
    numbers = [int(each[-1]) for each in found]
    steps = [after - before for before, after in pairwise(numbers)]
    usual = sorted(steps)[len(steps) // 2]
    if usual < 1 or min(steps) < usual:
        return
    missing = [
        before + usual * index
        for before, step in zip(numbers[:-1], steps, strict=True)
        for index in range(1, min(step // usual, _SHOWN + 2))
    ]
    if missing:
        shown = ", ".join(map(str, missing[:_SHOWN])) + (" and others" if len(missing) > _SHOWN else "")
        _logger.warning(
            "%s: no pictures with the numbers %s: the pictures count as frames without a gap", folder, shown
        )
