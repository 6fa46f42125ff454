"""Masks: the foreground of every frame at the size of the video, as images or as a video.

A mask is what the background model yields, before it is reduced to the stored silhouettes: each of its pixels covers
`working_reduction` x `working_reduction` pixels of the video.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings import VideoEncoder, VideoInfo, check_video_written
from psotrack.silhouettes.store import Task, foreground_of
from psotrack.support import Advance, atomic_write, check_file_name

#: Codecs of videos of masks, by ending; that of .avi loses nothing.
CODECS = {".mp4": "mp4v", ".avi": "FFV1"}


@dataclass(frozen=True)
class MaskTask:
    """Task of writing the masks of one video.

    Attributes:
        foreground: the video and what its foreground is made with; its cache and key are not used.
        out: the folder of the images, or a video file with an ending of `CODECS`.
    """

    foreground: Task
    out: Path


def write_masks(task: MaskTask, advance: Advance) -> int:
    """Write the masks of one video, 0 for background to 255 for foreground; returns their number.

    Images are named 000000.png and so on. What is written appears at its place when it is complete, and replaces what
    was there.

    Raises:
        InputError: the video ends early.
        SettingsError: the background model yields masks of a wrong number, type or shape.
        OutputError: the masks cannot be written.
    """
    video, reduction = task.foreground.video, task.foreground.settings.working_reduction
    width, height = video.image_size_wh
    if task.out.suffix.lower() in CODECS and (width % 2 or height % 2):
        raise SettingsError(
            "--masks",
            expected="a folder, because a video has an even width and height",
            found=f"{task.out.name} for {width} x {height} pixels",
        )
    masks = (
        np.repeat(np.repeat(mask, reduction, axis=0), reduction, axis=1)[:height, :width]
        for mask in foreground_of(task.foreground, {"decode": 0.0, "foreground": 0.0}, advance)
    )
    with atomic_write(task.out) as temporary:
        if task.out.suffix.lower() in CODECS:
            return _write_video(task.out, temporary, video, masks)
        count = 0
        temporary.mkdir()
        for count, mask in enumerate(masks, 1):
            there, coded = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            assert there, "PNG takes every mask"
            # Not `coded.tofile`, which reports no error where the last bytes are not written.
            (temporary / f"{count - 1:06d}.png").write_bytes(coded.tobytes())
    return count


def _write_video(
    path: Path, temporary: Path, video: VideoInfo, masks: Iterator[UInt8[np.ndarray, "height width"]]
) -> int:
    """Write a video to a temporary file, whose ending says the container."""
    try:
        encoder = VideoEncoder(temporary, CODECS[path.suffix.lower()], video.fps, video.image_size_wh)
    except OSError as error:
        raise OutputError(path, expected="a video that can be written", found=str(error)) from error
    try:
        for mask in masks:
            encoder.write(cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR))
    finally:
        encoder.close()
    check_video_written(path, temporary, encoder.num_frames)
    return encoder.num_frames


def masks_out(out: Path, cameras: tuple[str, ...]) -> dict[str, Path]:
    """Where the masks of each camera are written.

    Args:
        out: a folder, in which each camera gets a folder, or a video file.
        cameras: names of the cameras.

    Raises:
        SettingsError: a video file is named for several cameras, or its ending is unknown.
        InputError: the folder is a file.
    """
    if out.suffix.lower() in CODECS:
        if len(cameras) > 1:
            found = f"{out.name} for {len(cameras)} cameras"
            raise SettingsError("--masks", expected="a folder, or one camera by --cameras", found=found)
        return {cameras[0]: out}
    if out.is_file():
        raise InputError(
            out, expected=f"a folder, or a file that ends in {', '.join(CODECS)}", found="another file"
        )
    return {name: out / check_file_name(name, "--cameras") for name in cameras}
