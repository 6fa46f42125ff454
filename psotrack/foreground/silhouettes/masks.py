"""Masks: the foreground of every frame at the size of the video, as images or as a video.

A mask is what the background model yields, before it is reduced to the stored silhouettes: each of its pixels covers
`working_reduction` x `working_reduction` pixels of the video.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.silhouettes.computation import num_processes, tasks_of
from psotrack.foreground.silhouettes.settings import SilhouetteSettings
from psotrack.foreground.silhouettes.store import Task, foreground_of
from psotrack.recordings import Recording, encoded_video
from psotrack.support import (
    Advance,
    Report,
    atomic_write,
    check_file_name,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
)

#: Codecs of videos of masks, by ending; that of .avi loses nothing.
_CODECS = {".mp4": "mp4v", ".avi": "FFV1"}


def write_masks(
    recording: Recording,
    settings: SilhouetteSettings,
    out: Path,
    *,
    jobs: int | None = None,
    force: bool = False,
    report: Report = no_progress,
) -> dict[str, Path]:
    """Write the masks of all cameras, 0 for background to 255 for foreground; returns the place of each camera's.

    Images are named 000000.png and so on. What is written appears at its place when it is complete.

    Args:
        recording: a recording with a video for each camera.
        settings: settings of the silhouettes; `reduction` plays no part.
        out: a folder, in which each camera gets a folder, or a video file that ends in .mp4 or .avi.
        jobs: largest number of processes; None is one per processor.
        force: replace what is there.
        report: progress bar for the decoded frames of all cameras.

    Raises:
        SettingsError: a video file is named for several cameras or for an odd size, the background model yields masks
            of a wrong number, type or shape, or `jobs` is below 1.
        InputError: a video ends early, or the folder is a file.
        OutputError: the masks are there and `force` is not set, or they cannot be written.
    """
    jobs = num_processes(jobs)
    places = masks_out(out, list(recording.videos))
    for path in places.values():
        refuse_to_overwrite(path, force)
    tasks = tasks_of(recording, settings, out)
    with report("masks", sum(task.num_decoded for task in tasks.values())) as advance:
        both = [(task, places[name]) for name, task in tasks.items()]
        map_in_processes(_write_camera, both, jobs=jobs, advance=advance)
    return places


def masks_out(out: Path, cameras: Sequence[str]) -> dict[str, Path]:
    """Where `write_masks` writes the masks of each camera; errors as there."""
    if out.suffix.lower() in _CODECS:
        if len(cameras) > 1:
            found = f"{out.name} for {len(cameras)} cameras"
            raise SettingsError("--masks", expected="a folder, or one camera by --cameras", found=found)
        return {cameras[0]: out}
    if out.is_file():
        expected = f"a folder, or a file that ends in {', '.join(_CODECS)}"
        raise InputError(out, expected=expected, found="another file")
    return {name: out / check_file_name(name, "--cameras") for name in cameras}


def _write_camera(both: tuple[Task, Path], advance: Advance) -> None:
    """Write the masks of one video to a folder or a video file."""
    task, out = both
    (width, height), reduction = task.video.image_size_wh, task.settings.working_reduction
    nothing = np.zeros((height, width), np.uint8)
    masks = (
        nothing
        if mask is None
        else np.repeat(np.repeat(mask, reduction, axis=0), reduction, axis=1)[:height, :width]
        for mask in foreground_of(task, {"decode": 0.0}, advance)
    )
    codec = _CODECS.get(out.suffix.lower())
    if codec is None:
        with atomic_write(out) as temporary:
            temporary.mkdir()
            for index, mask in enumerate(masks):
                coded = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
                # Not `coded.tofile`, which reports no error where the last bytes are not written.
                (temporary / f"{index:06d}.png").write_bytes(coded.tobytes())
        return
    if width % 2 or height % 2:
        expected = "a folder, because a video has an even width and height"
        raise SettingsError("--masks", expected=expected, found=f"{out.name} for {width} x {height} pixels")
    with encoded_video(out, codec, task.video.fps, (width, height)) as encoder:
        for mask in masks:
            encoder.write(cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR))
