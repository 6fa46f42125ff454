"""Silhouettes of one video on disk: a zarr array, whose key is a digest of the video, the frames and the settings.

This module does not import JAX, because every worker process imports this module.
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import time
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zarr
from jaxtyping import Bool, UInt8
from zarr.codecs import ZstdCodec

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings import MADE_OF, VideoInfo, digest_video, read_frames, read_mask
from psotrack.silhouettes.first_look import look_first
from psotrack.silhouettes.foreground import (
    BackgroundModel,
    Mog2,
    coverage,
    learning_step,
    reduce_frame,
)
from psotrack.silhouettes.living_background import Living
from psotrack.silhouettes.seals import hold, is_whole, write_seal
from psotrack.silhouettes.settings import ScaledSettings
from psotrack.silhouettes.usable_frames import (
    LEAST_FRAMES,
    Interval,
    foreground_is_everywhere,
    intervals_of,
)
from psotrack.support import Advance, digest_file, digest_record, identify

logger = logging.getLogger(__name__)

#: Part of every key; raise it when the same settings give other silhouettes than before.
SCHEMA = 1

#: Number of frames that are compressed and read together.
CHUNK_FRAMES = 25

#: Attribute of stored silhouettes: intervals of the frames in which the foreground makes no sense.
_LEFT_OUT = "left_out"

#: Brighter pixels of an image of what is ignored are ignored.
_GREY = 127

#: An unfinished folder that was not changed for this long was left by a process that was killed, seconds.
_STALE_S = 24 * 3600

#: Longest time that zarr goes on writing, seconds.
_ZARR_WRITES_S = 1.0


@dataclass(frozen=True)
class Task:
    """Task of making one video's silhouettes and storing them in the folder `cache` / `key`.

    Attributes:
        video: the video.
        settings: settings of the silhouettes.
        cache: folder of the store.
        made_of: what the silhouettes are made of (see `made_of`); its digest is their key.
        background: background model; None is MOG2.
        ignore: image of the video's size, white where nothing counts as foreground; None for no such image.
    """

    video: VideoInfo
    settings: ScaledSettings
    cache: Path
    made_of: Mapping[str, Any]
    background: BackgroundModel | None = None
    ignore: Path | None = None

    @property
    def key(self) -> str:
        """Name of the silhouettes' folder."""
        return digest_record(self.made_of)


def made_of(
    video: VideoInfo,
    settings: ScaledSettings,
    background: BackgroundModel | None = None,
    ignore: Path | None = None,
) -> dict[str, Any]:
    """Everything that silhouettes depend on: digest of the video, frames, settings, background model, ignored part.

    Raises:
        InputError: the video cannot be read.
        SettingsError: the key of the background model is no plain data.
    """
    parts: dict[str, Any] = {
        "schema": SCHEMA,
        "content": digest_video(video),
        "num_frames": video.num_frames,
        "settings": msgspec.to_builtins(settings),
    }
    if background is not None:
        parts["background"] = identify(background)
    if ignore is not None:
        parts["ignore"] = digest_file(ignore, expected="a readable image")
    return parts


def key_of(
    video: VideoInfo,
    settings: ScaledSettings,
    background: BackgroundModel | None = None,
    ignore: Path | None = None,
) -> str:
    """Digest of what silhouettes are made of, in 40 digits; arguments and errors as of `made_of`."""
    return digest_record(made_of(video, settings, background, ignore))


def open_stored(path: Path, num_frames: int, shape: tuple[int, int]) -> zarr.Array | None:
    """Open stored silhouettes (frames, height, width); None if they do not exist or are damaged."""
    try:
        array = zarr.open_array(path, mode="r", zarr_format=3)
    except Exception:  # zarr raises whatever a damaged description leads to
        return None
    # zarr reads a missing chunk as zeros, which would look like frames without foreground.
    whole = array.shape == (num_frames, *shape) and array.nchunks_initialized == array.nchunks
    whole &= _LEFT_OUT in array.attrs
    return array if whole else None


def open_whole(path: Path, num_frames: int, shape: tuple[int, int]) -> zarr.Array | None:
    """As `open_stored`, but every byte is compared with the folder's seal first.

    As long as the array is in memory, other processes do not remove the folder from the cache.
    """
    held = hold(path)
    if held is None:
        return None
    array = open_stored(path, num_frames, shape) if is_whole(path) else None
    if array is None:
        held.close()
    else:
        weakref.finalize(array, held.close)
    return array


def left_out(array: zarr.Array) -> list[Interval]:
    """Intervals of the frames of stored silhouettes in which the foreground makes no sense."""
    intervals: Any = array.attrs[_LEFT_OUT]  # as JSON keeps them
    return [(int(start), int(stop)) for start, stop in intervals]


def reduced_shape(video: VideoInfo, reduction: int) -> tuple[int, int]:
    """Height and width of a video's silhouettes, cells."""
    width, height = video.image_size_wh
    return -(-height // reduction), -(-width // reduction)


def frames_to_decode(task: Task) -> int:
    """Number of frames of which `store` tells its progress."""
    num_frames = task.video.num_frames
    if isinstance(task.background, Living):
        return num_frames
    return num_frames + len(range(0, num_frames, learning_step(num_frames, task.settings)))


def store(task: Task, advance: Advance) -> dict[str, float]:
    """Make the silhouettes of one video and store them; returns the seconds of "decode" and "foreground".

    The folder appears whole or not at all. If two processes make the same silhouettes, the first folder stays.

    Raises:
        InputError: the video ends early.
        SettingsError: the background model yields masks of a wrong number, type or shape.
        OutputError: the store cannot be written.
    """
    path = task.cache / task.key
    temporary = task.cache / f".{task.key}.{secrets.token_hex(4)}.partial"
    shape = reduced_shape(task.video, task.settings.reduction)
    try:
        temporary.mkdir(parents=True)
        seconds = _write(temporary, shape, task, advance)
        write_seal(temporary)
        if open_stored(temporary, task.video.num_frames, shape) is None:
            raise OSError("another program changed the folder")
        _publish(temporary, path, task.video.num_frames, shape)
    except OSError as error:
        raise OutputError(
            path,
            expected="to write silhouettes",
            found=error.strerror or f"{error}",
            remedy="what was stored before is unchanged",
        ) from error
    finally:
        _remove(temporary)
    return seconds


def _remove(folder: Path) -> None:
    """Remove an unfinished folder. Zarr writes in a thread of its own, after an exception for some moments too."""
    end_s = time.monotonic() + _ZARR_WRITES_S
    while folder.exists() and time.monotonic() < end_s:
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.02)


def remove_stale(cache: Path) -> None:
    """Remove unfinished folders of processes that were killed more than a day ago."""
    for folder in cache.glob(".*.partial"):
        try:
            newest = max(file.stat().st_mtime for file in (folder, *folder.rglob("*")))
        except OSError:
            continue  # another process works in the folder, or has just finished
        if time.time() - newest > _STALE_S:
            logger.info("removing %s, left by a process that was killed", folder)
            shutil.rmtree(folder, ignore_errors=True)


def _write(folder: Path, shape: tuple[int, int], task: Task, advance: Advance) -> dict[str, float]:
    video, settings = task.video, task.settings
    array: zarr.Array = zarr.create_array(
        folder,
        shape=(video.num_frames, *shape),
        chunks=(CHUNK_FRAMES, *shape),
        dtype=np.uint8,
        compressors=ZstdCodec(level=3, checksum=True),
        attributes={"video": video.path.name, MADE_OF: dict(task.made_of)},
        # Chunks of zeros are written too, so that a missing chunk is always a damage.
        config={"write_empty_chunks": True},
        overwrite=True,
    )
    started, seconds = time.perf_counter(), {"decode": 0.0, "foreground": 0.0}
    chunk, everywhere = np.empty((CHUNK_FRAMES, *shape), np.uint8), []
    for index, mask in enumerate(foreground_of(task, seconds, advance)):
        chunk[index % CHUNK_FRAMES] = coverage(mask, settings.reduction // settings.working_reduction)
        count = index % CHUNK_FRAMES + 1
        if count == CHUNK_FRAMES or index + 1 == video.num_frames:
            array[index + 1 - count : index + 1] = chunk[:count]
            everywhere.append(foreground_is_everywhere(chunk[:count]))
    unusable = np.concatenate([np.zeros(0, bool), *everywhere])
    array.update_attributes({_LEFT_OUT: intervals_of(unusable, LEAST_FRAMES)})
    seconds["foreground"] = time.perf_counter() - started - seconds["decode"]
    return seconds


def foreground_of(
    task: Task, seconds: dict[str, float], advance: Advance
) -> Iterator[UInt8[np.ndarray, "working_height working_width"]]:
    """Yield the mask of each frame, without what is ignored: 0 to 255, a pixel per `working_reduction` pixels.

    Args:
        task: the video, the settings and the background model.
        seconds: the time of "decode" is added.
        advance: is told of each decoded frame, `frames_to_decode` in all.

    Raises:
        InputError: the video ends early.
        SettingsError: the background model yields masks of a wrong number, type or shape.
    """
    video, settings = task.video, task.settings
    background = Mog2(settings) if task.background is None else task.background
    if isinstance(background, Living) and settings.working_reduction > 1:
        # Only reduced frames are kept. A model that the user brings may keep what it is given.
        read = read_frames(video, into_one=True)
    else:
        read = read_frames(video)
    frames = _decoded(read, seconds, advance)
    if isinstance(background, Living) and settings.first_look:
        masks = background.masks(*look_first(video, frames, settings))
    elif isinstance(background, Living):
        masks = background.masks_as_they_come(reduce_frame(frame, settings) for frame in frames)
    else:
        learning = read_frames(video, learning_step(video.num_frames, settings))
        masks = background.foreground(_decoded(learning, seconds, advance), frames)
    ignored = (
        None
        if task.ignore is None
        else ignored_pixels(task.ignore, video.path.name, video.image_size_wh, settings.working_reduction)
    )
    index = -1
    for index, mask in enumerate(masks):
        _check_mask(mask, index, task)
        yield mask if ignored is None else np.where(ignored, np.uint8(0), mask)
    if index + 1 < video.num_frames:
        raise SettingsError(
            _model_name(task), expected=f"{video.num_frames} masks, one per frame", found=f"{index + 1}"
        )


def ignored_pixels(
    ignore: Path, video: object, image_size_wh: tuple[int, int], reduction: int
) -> Bool[np.ndarray, "working_height working_width"]:
    """Pixels of the masks of which a part is ignored.

    Args:
        ignore: image that is white where nothing counts as foreground.
        video: name of the video, for messages.
        image_size_wh: width and height of the video's images, pixels.
        reduction: image pixels per pixel of the masks, along each side.

    Raises:
        InputError: the image cannot be read, or has another size.
    """
    white = (read_mask(ignore) > _GREY).astype(np.uint8)
    width, height = image_size_wh
    if white.shape != (height, width):
        expected = f"{width} x {height} pixels as in {video}"
        raise InputError(ignore, expected=expected, found=f"{white.shape[1]} x {white.shape[0]}")
    return coverage(255 * white, reduction) > 0


def _check_mask(mask: object, index: int, task: Task) -> None:
    """Raise `SettingsError` unless a background model's mask has the right type and shape, and belongs to a frame."""
    shape = reduced_shape(task.video, task.settings.working_reduction)
    is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.uint8 and mask.shape == shape
    if not is_mask or index >= task.video.num_frames:
        found = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else type(mask).__name__
        raise SettingsError(
            _model_name(task),
            expected=f"{task.video.num_frames} masks of type uint8 and shape {shape}, the frame's height and width "
            f"divided by silhouettes.working_reduction = {task.settings.working_reduction}",
            found=f"{found} as mask {index}",
        )


def _model_name(task: Task) -> str:
    return f"background model {type(task.background or Mog2).__name__}"


def _decoded(
    frames: Iterator[UInt8[np.ndarray, "height width 3"]], seconds: dict[str, float], advance: Advance
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield frames; adds the time that they take to `seconds`, and advances the progress bar by each frame."""
    while True:
        started = time.perf_counter()
        frame = next(frames, None)
        seconds["decode"] += time.perf_counter() - started
        if frame is None:
            return
        yield frame
        advance(1)


def _publish(temporary: Path, path: Path, num_frames: int, shape: tuple[int, int]) -> None:
    """Move a folder to its place, unless another process has put an undamaged folder there.

    An undamaged folder is never moved away, because a process that reads it would see zeros meanwhile.
    """
    try:
        os.rename(temporary, path)  # fails if `path` is a folder that is not empty
        return
    except OSError:
        if not path.exists():
            raise
    if open_whole(path, num_frames, shape) is not None:
        return
    damaged = temporary.with_name(f"{temporary.stem}.damaged{temporary.suffix}")
    os.rename(path, damaged)
    os.rename(temporary, path)
    shutil.rmtree(damaged, ignore_errors=True)
