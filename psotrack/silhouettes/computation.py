"""Silhouettes of all cameras: computed once, in parallel, and then read from the store in pieces."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import zarr
from jaxtyping import UInt8

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings import Recording
from psotrack.silhouettes.foreground import BackgroundModel
from psotrack.silhouettes.settings import SilhouetteSettings, check_whole
from psotrack.silhouettes.store import (
    Task,
    frames_to_decode,
    key_of,
    open_stored,
    reduced_shape,
    remove_stale,
    store,
)
from psotrack.support import Report, map_in_processes, no_progress, short_repr

__all__ = ["SilhouetteSettings", "Silhouettes", "compute"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class Silhouettes:
    """Stored silhouettes of all cameras of a sequence.

    Attributes:
        cameras: names of the cameras, in the order of the rig.
        keys: key of each camera's silhouettes in the store, by camera name.
        reduction: r; cell (i, j) covers the pixels [r * i, r * i + r) x [r * j, r * j + r). Pixels beyond the image's
            border count as background.
        num_frames: number of frames of each camera.
        shape: height and width of one silhouette, cells.
        seconds: time spent on "decode" and "foreground", summed over workers; 0 for silhouettes from the store.
        arrays: one array (frames, height, width) per camera, stored or in memory.
    """

    cameras: tuple[str, ...]
    keys: Mapping[str, str]
    reduction: int
    num_frames: int
    shape: tuple[int, int]
    seconds: Mapping[str, float]
    arrays: tuple[zarr.Array | UInt8[np.ndarray, "frames height width"], ...]

    __repr__ = short_repr

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "frames cameras height width"]:
        """Read the coverage of the frames [start, stop), 0 to 255: (frames, cameras, height, width).

        Raises:
            SettingsError: the frames do not exist.
            InputError: the store was damaged after it was opened.
        """
        if not 0 <= start <= stop <= self.num_frames:
            raise SettingsError(
                "frames", expected=f"a part of 0 to {self.num_frames}", found=f"{start} to {stop}"
            )
        frames = np.empty((stop - start, len(self.cameras), *self.shape), np.uint8)
        for index, array in enumerate(self.arrays):
            try:
                frames[:, index] = array[start:stop]
            except (OSError, ValueError, RuntimeError) as error:
                raise InputError(
                    f"silhouettes {self.keys[self.cameras[index]]}",
                    expected="readable silhouettes",
                    found=f"{error}",
                    remedy="remove this folder from the cache; the next run makes it again",
                ) from error
        return frames


def compute(
    recording: Recording,
    settings: SilhouetteSettings = SilhouetteSettings(),  # noqa: B008  frozen
    *,
    cache: Path | str,
    jobs: int | None = None,
    background: BackgroundModel | None = None,
    report: Report = no_progress,
) -> Silhouettes:
    """Silhouettes of a sequence, read from the store; missing silhouettes are computed and stored.

    Each camera's silhouettes are stored when they are finished, under a key made of the video's content, the number of
    frames and all settings. After an interruption, the next call computes only the missing cameras.

    Args:
        recording: a recording with a video for each camera, all of the same length and size.
        settings: settings of the silhouettes.
        cache: folder of the store; made if it does not exist.
        jobs: largest number of processes; None is one per processor.
        background: background model instead of MOG2; None is MOG2 with the given settings.
        report: progress bar for the frames of all cameras, including the frames from which the background is learned.

    Raises:
        InputError: a video is missing, unreadable, ends early, or differs from the others in length or size.
        SettingsError: `jobs` is below 1, or the background model yields masks of a wrong number, type or shape.
        OutputError: the store cannot be written; the cameras that were finished stay in the store.
    """
    cache = Path(cache)
    jobs = jobs if jobs is not None else os.cpu_count() or 1
    check_whole("jobs", jobs, lowest=1)
    recording = recording.usable()
    cameras = recording.rig.names
    videos = [recording.videos[name] for name in cameras]
    shape = reduced_shape(videos[0], settings.reduction)
    with ThreadPoolExecutor(jobs) as threads:
        keys = list(threads.map(partial(key_of, settings=settings, background=background), videos))
    tasks = [Task(video, settings, cache, key, background) for video, key in zip(videos, keys, strict=True)]
    seconds = _make_missing(tasks, shape, jobs, report)
    return Silhouettes(
        cameras=cameras,
        keys=dict(zip(cameras, keys, strict=True)),
        reduction=settings.reduction,
        num_frames=recording.num_frames,
        shape=shape,
        seconds=seconds,
        arrays=tuple(_open(task, shape) for task in tasks),
    )


def _make_missing(tasks: list[Task], shape: tuple[int, int], jobs: int, report: Report) -> dict[str, float]:
    """Make and store missing silhouettes; returns the seconds of each stage, summed over the workers."""
    # Two cameras with the same content have the same key, so their silhouettes are made once.
    missing = list({task.key: task for task in tasks if _stored(task, shape) is None}.values())
    seconds = {"decode": 0.0, "foreground": 0.0}
    if not missing:
        return seconds
    logger.info("silhouettes: computing %d of %d videos", len(missing), len(tasks))
    cache = missing[0].cache
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            cache, expected="a folder to write to", found=error.strerror or f"{error}"
        ) from error
    remove_stale(cache)
    with report("silhouettes", sum(frames_to_decode(task) for task in missing)) as advance:
        for taken in map_in_processes(store, missing, jobs=jobs, advance=advance):
            seconds = {stage: seconds[stage] + taken[stage] for stage in seconds}
    return seconds


def _stored(task: Task, shape: tuple[int, int]) -> zarr.Array | None:
    return open_stored(task.cache / task.key, task.video.num_frames, shape)


def _open(task: Task, shape: tuple[int, int]) -> zarr.Array:
    array = _stored(task, shape)
    if array is None:
        raise InputError(task.cache / task.key, expected="the silhouettes just stored", found="none")
    return array
