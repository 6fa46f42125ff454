"""Silhouettes of one video on disk: a zarr array, whose key is a digest of the video, the frames and the settings.

This module does not import JAX, because every worker process imports this module.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zarr
from jaxtyping import Bool, UInt8
from zarr.codecs import ZstdCodec
from zarr.core.buffer import Buffer
from zarr.core.buffer.cpu import Buffer as _Buffer
from zarr.storage import MemoryStore

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.silhouettes.first_look import look_first
from psotrack.foreground.silhouettes.foreground import (
    BackgroundModel,
    OwnBackground,
    coverage,
    learning_step,
    reduce_frame,
)
from psotrack.foreground.silhouettes.living_background import Living
from psotrack.foreground.silhouettes.repeated_frames import FrameChanges, repeated_frames
from psotrack.foreground.silhouettes.settings import ForegroundSettings
from psotrack.foreground.silhouettes.usable_frames import LEAST_FRAMES, foreground_is_everywhere, intervals_of
from psotrack.recordings import (
    ARRAY_FILE,
    MADE_OF,
    StoredSilhouettes,
    VideoInfo,
    digest_video,
    read_frames,
    read_mask,
)
from psotrack.support import Advance, atomic_write, digest_file, digest_record, identify

#: Name of the seal in a folder of stored silhouettes. zarr ignores the file.
SEAL_FILE = "seal"

#: Folder of the chunks of a zarr array.
CHUNKS = "c"


def read_files(folder: Path) -> dict[str, bytes]:
    """Content of the files of the array in a folder, and of its seal, by their paths in the folder.

    Raises:
        OSError: a file cannot be read.
    """
    paths = [folder / ARRAY_FILE, folder / SEAL_FILE, *(folder / CHUNKS).rglob("*")]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths if path.is_file()}


def seal_of(files: Mapping[str, bytes]) -> bytes:
    """The seal of the files of an array."""
    array = {name: content for name, content in files.items() if name != SEAL_FILE}
    return digest_record({name: hashlib.blake2b(array[name]).hexdigest() for name in array}).encode()


def is_whole(folder: Path) -> bool:
    """Whether a folder has a seal, and no byte of the folder was changed since; every byte is read."""
    try:
        files = read_files(folder)
    except OSError:
        return False
    return files.get(SEAL_FILE) == seal_of(files)


#: Part of every key; raise it when the same settings give other silhouettes than before.
SCHEMA = 4

#: Number of frames that are compressed and read together.
CHUNK_FRAMES = 25

#: Attributes of stored silhouettes: intervals of the frames in which the foreground makes no sense, and of those that
#: repeat the picture before, or do not show the scene.
LEFT_OUT, REPEATED, UNSEEN = "left_out", "repeated", "unseen"

#: Brighter pixels of an image of what is ignored are ignored.
_GREY = 127


@dataclass(frozen=True)
class Task:
    """Task of making one video's silhouettes.

    Attributes:
        video: the video.
        settings: settings of the silhouettes.
        background: background model.
        ignore: image of the video's size, white where nothing counts as foreground; None for no such image.
        stored: where the silhouettes are stored, and what they are made of; the digest of this is their key.
    """

    video: VideoInfo
    settings: ForegroundSettings
    background: BackgroundModel
    ignore: Path | None
    stored: StoredSilhouettes

    @property
    def num_decoded(self) -> int:
        """Number of frames that are decoded: all, and those of a pass that learns the background."""
        num_frames = self.video.num_frames
        if isinstance(self.background, OwnBackground):
            return num_frames
        return num_frames + len(range(0, num_frames, learning_step(num_frames, self.settings)))


def task_of(
    video: VideoInfo,
    settings: ForegroundSettings,
    background: BackgroundModel,
    ignore: Path | None,
    cache: Path,
) -> Task:
    """The task of making a video's silhouettes, stored in a folder of `cache`; nothing is computed but digests.

    Raises:
        InputError: the video cannot be read.
        SettingsError: the key of the background model is no plain data.
    """
    made_of: dict[str, Any] = {
        "schema": SCHEMA,
        "content": digest_video(video),
        "num_frames": video.num_frames,
        "settings": msgspec.to_builtins(settings),
        "background": identify(background),
    }
    if ignore is not None:
        made_of["ignore"] = digest_file(ignore, expected="a readable image")
    stored = StoredSilhouettes(cache / digest_record(made_of), video.num_frames, made_of)
    return Task(video, settings, background, ignore, stored)


def reduced_shape(image_size_wh: tuple[int, int], reduction: int) -> tuple[int, int]:
    """Height and width of images that are reduced, cells; a cell at the border may reach beyond the image."""
    width, height = image_size_wh
    return -(-height // reduction), -(-width // reduction)


def open_stored(path: Path, shape: tuple[int, int, int], *, is_sealed: bool) -> zarr.Array | None:
    """Read stored silhouettes (frames, height, width); None if they do not exist or are damaged.

    They are in memory, compressed (about 1 kB per frame of 480 x 270 cells), so that no later change of the folder has
    an effect.

    Args:
        path: folder of the array.
        shape: numbers of frames, rows and columns.
        is_sealed: whether the folder has a seal, with which every byte is compared; if not, each chunk is decompressed.
    """
    if is_sealed:
        with contextlib.suppress(OSError):  # a cache that cannot be written
            os.utime(path / SEAL_FILE)  # the time of this use
    try:
        files = read_files(path)
        if is_sealed and files.get(SEAL_FILE) != seal_of(files):
            return None
        memory: dict[str, Buffer] = {name: _Buffer.from_bytes(content) for name, content in files.items()}
        array = zarr.open_array(MemoryStore(memory), mode="r", zarr_format=3)
        # zarr reads a missing chunk as zeros, which would look like frames without foreground.
        if array.shape != shape or array.nchunks_initialized < array.nchunks or LEFT_OUT not in array.attrs:
            return None
        for start in range(0, 0 if is_sealed else shape[0], array.chunks[0]):
            _ = array[start]
    except Exception:  # zarr raises whatever a damaged description leads to
        return None
    return array


def store(task: Task, advance: Advance) -> dict[str, float]:
    """Make the silhouettes of one video and store them; returns the seconds of "decode" and "foreground".

    The folder appears whole or not at all. If two processes make the same silhouettes, the first folder stays.

    Raises:
        InputError: the video ends early.
        SettingsError: the background model yields masks of a wrong number, type or shape.
        OutputError: the store cannot be written.
    """
    video, seconds = task.video, {"decode": 0.0, "foreground": 0.0}
    with contextlib.suppress(_StoredMeanwhileError), atomic_write(task.stored.path) as temporary:
        shape = (video.num_frames, *reduced_shape(video.image_size_wh, task.settings.reduction))
        _write(temporary, shape, task, seconds, advance)
        (temporary / SEAL_FILE).write_bytes(seal_of(read_files(temporary)))
        # A whole folder is not replaced, because a process that reads it would find no files meanwhile.
        if is_whole(task.stored.path):
            raise _StoredMeanwhileError
    return seconds


class _StoredMeanwhileError(Exception):
    """Another process has stored the same silhouettes."""


def _write(
    folder: Path, shape: tuple[int, int, int], task: Task, seconds: dict[str, float], advance: Advance
) -> None:
    video, settings, started = task.video, task.settings, time.perf_counter()
    files: dict[str, Buffer] = {}
    array: zarr.Array = zarr.create_array(
        # Zarr writes in a thread of its own, which would go on for some moments after an exception.
        MemoryStore(files),
        shape=shape,
        chunks=(CHUNK_FRAMES, *shape[1:]),
        dtype=np.uint8,
        compressors=ZstdCodec(level=3, checksum=True),
        attributes={"video": video.path.name, MADE_OF: dict(task.stored.made_of)},
        # Chunks of zeros are written too, so that a missing chunk is always a damage.
        config={"write_empty_chunks": True},
    )
    chunk, everywhere = np.empty((CHUNK_FRAMES, *shape[1:]), np.uint8), [np.zeros(0, bool)]
    changes, unseen = FrameChanges(), np.zeros(video.num_frames, bool)
    for index, mask in enumerate(foreground_of(task, seconds, advance, changes)):
        unseen[index] = mask is None
        chunk[index % CHUNK_FRAMES] = (
            0 if mask is None else coverage(mask, settings.reduction // settings.working_reduction)
        )
        count = index % CHUNK_FRAMES + 1
        if count == CHUNK_FRAMES or index + 1 == video.num_frames:
            array[index + 1 - count : index + 1] = chunk[:count]
            everywhere.append(foreground_is_everywhere(chunk[:count]))
            _move_to_disk(files, folder)
    # A camera that shakes shows its scene in none of these frames, or foreground everywhere.
    is_everywhere, is_long = np.concatenate(everywhere), np.zeros(video.num_frames, bool)
    for start, stop in intervals_of(is_everywhere | unseen, LEAST_FRAMES):
        is_long[start:stop] = True
    shaken = intervals_of(is_everywhere & is_long)
    repeated = intervals_of(repeated_frames(changes.found) & ~unseen)
    array.update_attributes({LEFT_OUT: shaken, REPEATED: repeated, UNSEEN: intervals_of(unseen)})
    _move_to_disk(files, folder)
    seconds["foreground"] = time.perf_counter() - started - seconds["decode"]


def _move_to_disk(files: dict[str, Buffer], folder: Path) -> None:
    while files:
        name, content = files.popitem()
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.to_bytes())


def foreground_of(
    task: Task, seconds: dict[str, float], advance: Advance, changes: FrameChanges | None = None
) -> Iterator[UInt8[np.ndarray, "working_height working_width"] | None]:
    """Yield the mask of each frame, without what is ignored: 0 to 255, a pixel per `working_reduction` pixels.

    None stands for the mask of a frame that does not show the scene.

    Args:
        task: the video, the settings and the background model.
        seconds: the time of "decode" is added.
        advance: is told of each decoded frame, `Task.num_decoded` in all.
        changes: is given each frame.

    Raises:
        InputError: the video ends early.
        SettingsError: the background model yields masks of a wrong number, type or shape.
    """
    video, settings, background = task.video, task.settings, task.background
    # The package's models keep only reduced frames. One that the user brings may keep what it is given.
    into_one = isinstance(background, OwnBackground) and settings.working_reduction > 1
    frames = _decoded(read_frames(video, into_one=into_one), seconds, advance, changes)
    if isinstance(background, Living) and not settings.first_look:
        masks = background.masks_as_they_come(reduce_frame(frame, settings) for frame in frames)
    elif isinstance(background, OwnBackground):
        masks = background.masks(*look_first(video, frames, settings))
    else:
        learning = read_frames(video, learning_step(video.num_frames, settings))
        masks = background.foreground(_decoded(learning, seconds, advance), frames)
    shape = reduced_shape(video.image_size_wh, settings.working_reduction)
    ignored = None
    if task.ignore is not None:
        size_wh, name = video.image_size_wh, video.path.name
        ignored = ignored_pixels(task.ignore, name, size_wh, settings.working_reduction)
    count = 0
    for count, mask in enumerate(masks, 1):
        kind = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else type(mask).__name__
        if (mask is not None and kind != f"uint8 {shape}") or count > video.num_frames:
            raise _wrong_masks(task, shape, f"{kind} as mask {count - 1}")
        yield mask if ignored is None or mask is None else np.where(ignored, np.uint8(0), mask)
    if count < video.num_frames:
        raise _wrong_masks(task, shape, f"{count} masks")


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


def _wrong_masks(task: Task, shape: tuple[int, int], found: str) -> SettingsError:
    return SettingsError(
        f"background model {type(task.background).__name__}",
        expected=f"{task.video.num_frames} masks of type uint8 and shape {shape}, the frame's height and width "
        f"divided by silhouettes.working_reduction = {task.settings.working_reduction}",
        found=found,
    )


def _decoded(
    frames: Iterator[UInt8[np.ndarray, "height width 3"]],
    seconds: dict[str, float],
    advance: Advance,
    changes: FrameChanges | None = None,
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield frames; adds the time that they take to `seconds`, and advances the progress bar by each frame."""
    while True:
        started = time.perf_counter()
        frame = next(frames, None)
        seconds["decode"] += time.perf_counter() - started
        if frame is None:
            return
        if changes is not None:
            changes.add(frame)
        yield frame
        advance(1)
