"""Silhouettes of all cameras: computed once, in parallel, and then read from the store in pieces."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
import zarr
from jaxtyping import Int, UInt8

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import Rig, looking_depths_m
from psotrack.recordings import Recording, StoredSilhouettes, Timeline, TruncatedVideoError
from psotrack.silhouettes.background_models import find_background
from psotrack.silhouettes.exposures import Exposures
from psotrack.silhouettes.foreground import BackgroundModel
from psotrack.silhouettes.seals import SEAL_FILE
from psotrack.silhouettes.settings import MOG2, ScaledSettings, SilhouetteSettings, check_whole
from psotrack.silhouettes.store import (
    Task,
    frames_to_decode,
    left_out,
    made_of,
    open_stored,
    open_whole,
    reduced_shape,
    remove_stale,
    store,
)
from psotrack.silhouettes.usable_frames import Interval, in_words
from psotrack.support import Report, identify, map_in_processes, no_progress, short_repr

__all__ = ["SilhouetteSettings", "Silhouettes", "compute"]

logger = logging.getLogger(__name__)

#: Settings that follow from the size of the images where they are left open.
_OPEN = ("reduction", "working_reduction", "min_blob_px")

#: Width of a usual drone, metres: most are wider; smaller ones have fewer pixels in the reduced images.
_USUAL_DRONE_M = 0.3


@dataclass(frozen=True, repr=False)
class Silhouettes:
    """Stored silhouettes of all cameras of a sequence.

    Attributes:
        cameras: names of the cameras, in the order of the rig.
        keys: key of each camera's silhouettes, by camera name; a camera without silhouettes has none.
        reduction: r; cell (i, j) covers the pixels [r * i, r * i + r) x [r * j, r * j + r). Pixels beyond the image's
            border count as background.
        num_frames: number of frames of the longest camera.
        shape: height and width of the largest silhouette, cells.
        seconds: time spent on "decode" and "foreground", summed over workers; 0 for silhouettes from the store.
        arrays: one array (frames, height, width) per camera, stored or in memory; cameras may differ in frames, height
            and width. A camera without silhouettes has no frames.
        exposures: when the frames were exposed; None where frame i of every camera is instant i.
        left_out: frames of a camera's video in which foreground is everywhere, as intervals (first frame, frame after
            the last), by camera name; these frames show no foreground in `arrays`, and `at_instants` says that the
            camera sees nothing.
    """

    cameras: tuple[str, ...]
    keys: Mapping[str, str]
    reduction: int
    num_frames: int
    shape: tuple[int, int]
    seconds: Mapping[str, float]
    arrays: tuple[zarr.Array | FramesOfInstants | UInt8[np.ndarray, "frames height width"], ...]
    exposures: Exposures | None = None
    left_out: Mapping[str, list[Interval]] = field(default_factory=dict)

    __repr__ = short_repr

    @property
    def borders(self) -> Int[np.ndarray, "cameras 2"]:
        """(cameras, 2), width and height of each camera's silhouettes, cells."""
        return np.array([array.shape[:0:-1] for array in self.arrays], int)

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "frames cameras height width"]:
        """Read the coverage of the frames [start, stop), 0 to 255: (frames, cameras, height, width).

        Smaller silhouettes, and those of a camera that has fewer frames, are filled up with 0.

        Raises:
            SettingsError: the frames do not exist.
            InputError: the store was damaged after it was opened.
        """
        if not 0 <= start <= stop <= self.num_frames:
            raise SettingsError(
                "frames", expected=f"a part of 0 to {self.num_frames}", found=f"{start} to {stop}"
            )
        frames = np.zeros((stop - start, len(self.cameras), *self.shape), np.uint8)
        for index, array in enumerate(self.arrays):
            try:
                read = np.asarray(array[start:stop])
                count, height, width = read.shape
                frames[:count, index, :height, :width] = read
            # A damaged size asks for any amount of memory.
            except (OSError, ValueError, RuntimeError, MemoryError) as error:
                reason = f"{error}" or "more than the memory"
                raise InputError(
                    _folder_of(array),
                    expected="readable silhouettes",
                    found=f"damage after they were opened ({reason})",
                    remedy="the same command, run again, makes the silhouettes of a cache anew",
                ) from error
        return frames

    def part(self, start: int, stop: int) -> Silhouettes:
        """The frames [start, stop), in memory.

        Raises:
            SettingsError: the frames do not exist.
            InputError: the store was damaged after it was opened.
        """
        frames = self.read(start, stop)
        exposures = None if self.exposures is None else self.exposures[start:stop]
        arrays = tuple(frames[:, camera] for camera in range(len(self.cameras)))
        left_out = self.left_out
        if self.exposures is None:
            within = {name: _within(intervals, start, stop) for name, intervals in left_out.items()}
            left_out = {name: intervals for name, intervals in within.items() if intervals}
        return replace(self, num_frames=stop - start, arrays=arrays, exposures=exposures, left_out=left_out)

    def at_instants(self, timeline: Timeline) -> Silhouettes:
        """These silhouettes with instants instead of frames: each camera shows its frame nearest to the instant.

        A camera without a frame at an instant, or without video, shows no foreground, and `exposures` says so. Where
        frame i of every camera is instant i, the silhouettes stay as they are.

        Raises:
            SettingsError: the timeline is of other cameras.
        """
        if timeline.cameras != self.cameras:
            raise SettingsError(
                "timeline", expected=f"cameras {self.cameras}", found=f"cameras {timeline.cameras}"
            )
        assert self.exposures is None, "instants of instants have no meaning"
        filmed = np.array([array.shape[0] > 0 for array in self.arrays])
        whole = filmed.all() and not self.left_out
        if timeline.is_synchronous and timeline.num_instants == self.num_frames and whole:
            return self
        usable = filmed & (timeline.frame >= 0)
        for name, intervals in self.left_out.items():
            camera = self.cameras.index(name)
            for start, stop in intervals:
                usable[:, camera] &= (timeline.frame[:, camera] < start) | (timeline.frame[:, camera] >= stop)
        timeline = replace(
            timeline,
            frame=np.where(usable, timeline.frame, -1),
            offset_s=np.where(usable, timeline.offset_s, 0.0),
        )
        arrays = tuple(
            FramesOfInstants(array, frame) for array, frame in zip(self.arrays, timeline.frame.T, strict=True)
        )
        return replace(
            self, num_frames=timeline.num_instants, arrays=arrays, exposures=exposures_of(timeline)
        )


def _folder_of(array: object) -> object:
    """The folder of an array that is stored, for messages."""
    while isinstance(array, FramesOfInstants):
        array = array.array
    return array.store.root if isinstance(array, zarr.Array) else "silhouettes"  # type: ignore[attr-defined]


def _within(intervals: list[Interval], start: int, stop: int) -> list[Interval]:
    """The parts of intervals in the frames [start, stop), counted from `start`."""
    cut = [(max(first, start) - start, min(last, stop) - start) for first, last in intervals]
    return [(first, last) for first, last in cut if first < last]


def _brought(recording: Recording, tasks: Mapping[str, Task]) -> dict[str, StoredSilhouettes]:
    """The stored silhouettes that a recording brings and that can be used, by camera name."""
    return {
        name: stored
        for name, stored in recording.silhouettes.items()
        if name not in tasks or stored.key == tasks[name].key
    }


def _check_made_with(
    name: str, stored: StoredSilhouettes, scaled: ScaledSettings, model: BackgroundModel | None
) -> None:
    """Raise `SettingsError` for silhouettes without a video that were made with other settings."""
    made_with = _made_with(stored)
    for setting in ScaledSettings.__struct_fields__:
        asked, made = getattr(scaled, setting), getattr(made_with, setting)
        if asked != made:
            raise _made_otherwise(setting, name, stored, made, asked)
    asked, made = None if model is None else identify(model), stored.made_of.get("background")
    if asked != made:
        kinds = [MOG2 if each is None else each["class"].rpartition(".")[2] for each in (made, asked)]
        # Two models of one kind differ in their keys.
        words = kinds if kinds[0] != kinds[1] else [f"{made}", f"{asked}"]
        raise _made_otherwise("background", name, stored, *words)


def _made_otherwise(
    setting: str, name: str, stored: StoredSilhouettes, made: object, asked: object
) -> SettingsError:
    return SettingsError(
        f"silhouettes.{setting}",
        expected=f"{made}, with which the stored silhouettes of camera {name} were made",
        found=f"{asked}",
        remedy=f"other silhouettes than {stored.path} need the camera's video",
    )


def _made_with(stored: StoredSilhouettes) -> ScaledSettings:
    """The settings with which stored silhouettes were made.

    Raises:
        InputError: this version does not know these settings.
    """
    try:
        return msgspec.convert(stored.made_of["settings"], ScaledSettings)
    except (msgspec.ValidationError, SettingsError) as error:
        expected = "silhouettes that were made with settings of this version"
        raise InputError(stored.path, expected=expected, found=f"{error}") from error


def _open_brought(stored: StoredSilhouettes, rig: Rig, name: str) -> zarr.Array:
    """Open the silhouettes that a recording brings."""
    width, height = _size_wh(rig, name)
    reduction, num_frames = _made_with(stored).reduction, stored.made_of["num_frames"]
    shape = (-(-height // reduction), -(-width // reduction))
    array = open_stored(stored.path, num_frames, shape)
    if array is None:
        raise InputError(
            stored.path,
            expected=f"silhouettes of camera {name}: {num_frames} frames of {shape[1]} x {shape[0]} values",
            found="none, damaged ones, or those of another camera",
        )
    return array


def exposures_of(timeline: Timeline) -> Exposures:
    """When the frames that a timeline's instants show were exposed, in float32."""
    of_cameras = np.zeros(len(timeline.cameras)) if timeline.line_time_s is None else timeline.line_time_s
    line_time_s = np.broadcast_to(of_cameras, timeline.frame.shape).astype(np.float32)
    offset_s, share = (value.astype(np.float32) for value in (timeline.offset_s, timeline.share))
    return Exposures(offset_s, timeline.is_there, share, line_time_s)


@dataclass(frozen=True)
class FramesOfInstants:
    """The frames of one camera by instants instead of their numbers.

    Attributes:
        array: the camera's frames.
        frame: (instants,), number of the frame of each instant; -1 for none, which reads as 0.
    """

    array: zarr.Array | FramesOfInstants | UInt8[np.ndarray, "frames height width"]
    frame: Int[np.ndarray, "instants"]

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of instants, rows and columns."""
        return (len(self.frame), *self.array.shape[1:])

    def __getitem__(self, instants: slice) -> UInt8[np.ndarray, "instants height width"]:
        frame = self.frame[instants]
        frames = np.zeros((len(frame), *self.array.shape[1:]), np.uint8)
        there = frame >= 0
        if there.any():
            first, last = int(frame[there].min()), int(frame[there].max())
            frames[there] = np.asarray(self.array[first : last + 1])[frame[there] - first]
        return frames


def compute(
    recording: Recording,
    settings: SilhouetteSettings = SilhouetteSettings(),  # noqa: B008  frozen
    *,
    cache: Path | str,
    jobs: int | None = None,
    background: BackgroundModel | None = None,
    all_videos: bool = True,
    report: Report = no_progress,
) -> Silhouettes:
    """Silhouettes of a sequence, read from the store; missing silhouettes are computed and stored.

    Stored silhouettes that the recording brings are used where a camera has no video, or where they are made of the
    same video in the same way.

    Each camera's silhouettes are stored when they are finished, under a key made of the video's content, the number of
    frames and all settings. After an interruption, the next call computes only the missing cameras.

    Args:
        recording: a recording with a video or stored silhouettes for each camera.
        settings: settings of the silhouettes; a value that is left open (None) is that of the silhouettes which the
            recording brings instead of videos.
        cache: folder of the store; made if it does not exist.
        jobs: largest number of processes; None is one per processor.
        background: a background model of the caller's instead of the one that the settings name.
        all_videos: whether each camera needs a video or stored silhouettes; if not, a camera without both has no
            silhouettes, and `Silhouettes.at_instants` says that it sees nothing.
        report: progress bar for the frames of all cameras, including the frames from which the background is learned.

    Raises:
        InputError: a video is missing, unreadable, ends early, or has another size than its camera.
        SettingsError: `jobs` is below 1, there is no background model of the settings' name, the background model
            yields masks of a wrong number, type or shape, or silhouettes without a video were made with other settings.
        OutputError: the store cannot be written; the cameras that were finished stay in the store.
    """
    cache = Path(cache)
    jobs = jobs if jobs is not None else os.cpu_count() or 1
    check_whole("jobs", jobs, lowest=1)
    recording = recording.usable(recording.rig.names, videos=all_videos, silhouettes=True)
    if not recording.videos and not recording.silhouettes:
        raise InputError(recording.folder, expected="at least one video", found="none")
    scaled = scaled_settings(settings, recording)
    model = find_background(settings.background, scaled) if background is None else background
    tasks = _tasks(recording, scaled, cache, model)
    brought = _brought(recording, tasks)
    for name, stored in brought.items():
        if name not in tasks:
            _check_made_with(name, stored, scaled, model)
    own = {name: task for name, task in tasks.items() if name not in brought}
    opened = {name: array for name, task in own.items() if (array := _stored(task)) is not None}
    missing = {name: task for name, task in own.items() if name not in opened}
    try:
        seconds = _make_missing(list(missing.values()), jobs, report)
    except TruncatedVideoError as error:
        raise _counted_in_instants(error, recording) from None
    opened |= {name: _open(task) for name, task in missing.items()}
    opened |= {name: _open_brought(each, recording.rig, name) for name, each in brought.items()}
    whole = {name: opened[name] for name in recording.rig.names if name in opened}
    shape = (max(array.shape[1] for array in whole.values()), max(array.shape[2] for array in whole.values()))
    # Without the future, whoever reads a frame decides about this frame.
    unusable = {
        name: intervals
        for name, array in whole.items()
        if scaled.first_look
        and (intervals := _within(left_out(array), 0, recording.frame_times[name].num_frames))
    }
    arrays = {name: _without(array, unusable.get(name, [])) for name, array in whole.items()}
    for name, intervals in unusable.items():
        _say_left_out(recording, name, intervals)
    nothing = np.zeros((0, *shape), np.uint8)
    return Silhouettes(
        cameras=recording.rig.names,
        keys={name: brought[name].key if name in brought else tasks[name].key for name in whole},
        reduction=scaled.reduction,
        num_frames=recording.num_frames,
        shape=shape,
        seconds=seconds,
        arrays=tuple(arrays.get(name, nothing) for name in recording.rig.names),
        left_out=unusable,
    )


def _without(array: zarr.Array, intervals: list[Interval]) -> zarr.Array | FramesOfInstants:
    """Stored silhouettes of which some frames show no foreground."""
    if not intervals:
        return array
    frame = np.arange(array.shape[0])
    for start, stop in intervals:
        frame[start:stop] = -1
    return FramesOfInstants(array, frame)


def _say_left_out(recording: Recording, name: str, intervals: list[Interval]) -> None:
    """Warn that frames of a camera are left out."""
    count = sum(stop - start for start, stop in intervals)
    times = recording.frame_times[name]
    second = max(1, round(times.fps))
    logger.warning(
        "camera %s: %d of %d frames are left out, because foreground is everywhere in the image: frames %s; "
        "a camera that moved, or light that the background model does not follow?",
        name,
        count,
        times.num_frames,
        in_words(intervals, gap_frames=second),
    )


def tasks_of(
    recording: Recording,
    settings: SilhouetteSettings,
    cache: Path,
    background: BackgroundModel | None = None,
) -> dict[str, Task]:
    """The task of each camera that has a video, by name; nothing is computed.

    Args:
        recording, settings, cache, background: as for `compute`.

    Raises:
        InputError: a video cannot be read.
        SettingsError: there is no background model of the settings' name.
    """
    if not recording.videos:
        return {}
    scaled = scaled_settings(settings, recording)
    model = find_background(settings.background, scaled) if background is None else background
    return _tasks(recording, scaled, cache, model)


def _tasks(
    recording: Recording, scaled: ScaledSettings, cache: Path, model: BackgroundModel | None
) -> dict[str, Task]:
    videos = {name: recording.videos[name] for name in recording.rig.names if name in recording.videos}
    ignored = {name: recording.ignore.get(name) for name in videos}
    with ThreadPoolExecutor() as threads:
        parts = threads.map(lambda name: made_of(videos[name], scaled, model, ignored[name]), videos)
    return {
        name: Task(video, scaled, cache, of_video, model, ignored[name])
        for (name, video), of_video in zip(videos.items(), parts, strict=True)
    }


def scaled_settings(settings: SilhouetteSettings, recording: Recording) -> ScaledSettings:
    """The settings of silhouettes for the images and the rig of a recording with videos or stored silhouettes.

    Where the settings leave a value open, cameras that have stored silhouettes and no video decide.

    Raises:
        SettingsError: a value differs from the one with which these silhouettes were made.
    """
    sizes_wh = [video.image_size_wh for video in recording.videos.values()]
    alone = [name for name in recording.rig.names if name in recording.silhouettes.keys() - recording.videos]
    if alone:
        sizes_wh += [_size_wh(recording.rig, name) for name in alone]
        settings = _with_open_values(settings, alone[0], recording.silhouettes[alone[0]])
    return settings.scaled(sizes_wh, usual_drone_px(recording.rig))


def _with_open_values(
    settings: SilhouetteSettings, name: str, stored: StoredSilhouettes
) -> SilhouetteSettings:
    """The settings with the values of stored silhouettes, where they are left open."""
    if settings.drone_px is not None:
        return settings
    made_with = _made_with(stored)
    given = {setting: getattr(settings, setting) for setting in _OPEN}
    for setting, value in given.items():
        if value is not None and value != getattr(made_with, setting):
            raise _made_otherwise(setting, name, stored, getattr(made_with, setting), value)
    return msgspec.structs.replace(settings, **{setting: getattr(made_with, setting) for setting in _OPEN})


def _size_wh(rig: Rig, name: str) -> tuple[int, int]:
    width, height = rig.cameras.image_size_wh[rig.names.index(name)].astype(int).tolist()
    return width, height


def usual_drone_px(rig: Rig) -> float | None:
    """Width of a drone of 0.3 m at the place at which all cameras look, pixels, in the camera that shows it smallest.

    None where the cameras are at one place, so that the rig does not say how far drones are.
    """
    depth_m = looking_depths_m(rig.cameras)
    if not (depth_m > 0).all():
        return None
    return float((_USUAL_DRONE_M * rig.cameras.K[:, 0, 0] / depth_m).min())


def stored_silhouettes(
    recording: Recording, settings: SilhouetteSettings, cache: Path
) -> dict[str, StoredSilhouettes]:
    """Place and key of the silhouettes of each camera that `compute` reads, by name; nothing is computed.

    Args:
        recording, settings, cache: as for `compute`.

    Raises:
        InputError: a video cannot be read.
        SettingsError: there is no background model of the settings' name.
    """
    tasks = tasks_of(recording, settings, cache)
    places = {
        name: StoredSilhouettes(cache / task.key, task.video.num_frames, task.made_of)
        for name, task in tasks.items()
    } | _brought(recording, tasks)
    return {name: places[name] for name in recording.rig.names if name in places}


def silhouette_keys(recording: Recording, settings: SilhouetteSettings) -> dict[str, str]:
    """Key of the silhouettes of each camera that has a video or stored silhouettes, by name (`stored_silhouettes`)."""
    return {name: each.key for name, each in stored_silhouettes(recording, settings, Path()).items()}


def _counted_in_instants(error: TruncatedVideoError, recording: Recording) -> TruncatedVideoError:
    """The same error with the number of instants before the missing frame: `--frames` counts instants."""
    timeline = recording.timeline()
    frame = timeline.frame[:, [recording.videos.get(name) == error.video for name in timeline.cameras]]
    missing = (frame >= error.num_readable).any(axis=-1)
    num_instants = int(missing.argmax()) if missing.any() else timeline.num_instants
    return TruncatedVideoError(error.video, error.num_readable, num_instants)


def _make_missing(tasks: list[Task], jobs: int, report: Report) -> dict[str, float]:
    """Make and store silhouettes; returns the seconds of each stage, summed over the workers."""
    # Two cameras with the same content have the same key, so their silhouettes are made once.
    missing = list({task.key: task for task in tasks}.values())
    for task in missing:
        _say_damaged(task)
    seconds = {"decode": 0.0, "foreground": 0.0}
    if not missing:
        return seconds
    logger.info("silhouettes: computing those of %d videos", len(missing))
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


def _stored(task: Task) -> zarr.Array | None:
    shape = reduced_shape(task.video, task.settings.reduction)
    return open_whole(task.cache / task.key, task.video.num_frames, shape)


def _say_damaged(task: Task) -> None:
    """Warn that silhouettes in the cache are made anew; those of an older version, which wrote no seal, log a line."""
    path = task.cache / task.key
    if (path / SEAL_FILE).exists():
        logger.warning("%s: damaged silhouettes in the cache; they are made anew", path)
    elif path.exists():
        logger.info("%s: silhouettes without a digest, of an older version; they are made anew", path)


def _open(task: Task) -> zarr.Array:
    array = _stored(task)
    if array is None:
        raise InputError(task.cache / task.key, expected="the silhouettes just stored", found="none")
    return array
