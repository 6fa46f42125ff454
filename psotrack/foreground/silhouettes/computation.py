"""Silhouettes of all cameras: computed once, in parallel, and then read from the store in pieces."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zarr

from psotrack.errors import InputError, SettingsError, errors_name
from psotrack.foreground.network.names import NETWORK, model_path
from psotrack.foreground.silhouettes.foreground import BackgroundModel, Mog2
from psotrack.foreground.silhouettes.frames import FramesOfInstants, Silhouettes
from psotrack.foreground.silhouettes.living_background import Living
from psotrack.foreground.silhouettes.settings import (
    LIVING,
    MOG2,
    ForegroundSettings,
    SilhouetteSettings,
    check_whole,
)
from psotrack.foreground.silhouettes.store import (
    LEFT_OUT,
    REPEATED,
    UNSEEN,
    Task,
    open_stored,
    reduced_shape,
    store,
    task_of,
)
from psotrack.foreground.silhouettes.usable_frames import Interval, in_words, intervals_of
from psotrack.geometry import Rig, looking_depths_m
from psotrack.recordings import FrameTimes, Recording, StoredSilhouettes
from psotrack.support import Report, identify, lasting_name, make_plugin, map_in_processes, no_progress

logger = logging.getLogger(__name__)

#: Settings that follow from the size of the images where they are left open.
_OPEN = ("reduction", "working_reduction", "min_blob_px")

#: Width of a usual drone, metres: most are wider; smaller ones have fewer pixels in the reduced images.
_USUAL_DRONE_M = 0.3

#: Attributes of frames that are left out, why they are, and what the user may look at.
_WHY_LEFT_OUT = (
    (
        LEFT_OUT,
        "foreground is everywhere in the image",
        "a camera that moved, or light that the background model does not follow?",
    ),
    (
        REPEATED,
        "they repeat the picture before",
        "a stream that froze, frames that were lost or are damaged, or a video converted to a higher rate?",
    ),
    (
        UNSEEN,
        "they do not show the scene",
        "too dark, too bright, of one colour, or another picture?",
    ),
)


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
    jobs = num_processes(jobs)
    recording = recording.usable(recording.rig.names, videos=all_videos, silhouettes=True)
    if not any(each.video or each.silhouettes for each in recording.cameras):
        raise InputError(recording.folder, expected="at least one video", found="none")
    scaled = scaled_settings(settings, recording)
    model = find_background(settings.background, scaled) if background is None else background
    tasks = _tasks(recording, scaled, model, Path(cache))
    places = _places(recording, tasks)
    for name, place in places.items():
        if name not in tasks:
            # A long value is cut, and the path behind it.
            with errors_name(place.path):
                _check_made_with(name, place, scaled, model)
    opened = {name: _opened(name, place, tasks, recording.rig, scaled) for name, place in places.items()}
    missing = {name: tasks[name] for name, array in opened.items() if array is None and name in tasks}
    for path in dict.fromkeys(places[name].path for name in missing):
        if path.exists():
            logger.warning("%s: damaged silhouettes; they are made anew", path)
    seconds = _make(list(missing.values()), jobs, report)
    places |= {name: task.stored for name, task in missing.items()}
    opened |= {name: _opened(name, places[name], tasks, recording.rig, scaled) for name in missing}
    arrays: dict[str, zarr.Array | FramesOfInstants] = {}
    left_out: dict[str, list[Interval]] = {}
    for name, array in opened.items():
        if array is None:
            num_frames = places[name].made_of["num_frames"]
            raise InputError(
                places[name].path,
                expected=f"silhouettes of camera {name}: {num_frames} frames of the camera's size",
                found="none, damaged ones, or those of another camera",
            )
        arrays[name] = array
        # Without the future, whoever reads a frame decides about this frame.
        times = recording.by_name[name].times
        if times and (intervals := _left_out(name, array, times, with_future=scaled.first_look)):
            arrays[name], left_out[name] = _without(array, intervals), intervals
    shape = tuple(np.max([array.shape[1:] for array in arrays.values()], axis=0).tolist())
    nothing = np.zeros((0, *shape), np.uint8)
    return Silhouettes(
        cameras=recording.rig.names,
        keys={name: place.key for name, place in places.items()},
        reduction=scaled.reduction,
        num_frames=recording.num_frames,
        shape=shape,
        seconds=seconds,
        arrays=tuple(arrays.get(name, nothing) for name in recording.rig.names),
        left_out=left_out,
    )


def num_processes(jobs: int | None) -> int:
    """The number of processes that the caller allows; None is one per processor.

    Raises:
        SettingsError: the number is below 1.
    """
    jobs = jobs if jobs is not None else os.cpu_count() or 1
    check_whole("jobs", jobs, lowest=1)
    return jobs


def tasks_of(recording: Recording, settings: SilhouetteSettings, cache: Path) -> dict[str, Task]:
    """The task of each camera that has a video, by name; nothing is computed.

    Args:
        recording, settings, cache: as for `compute`.

    Raises:
        InputError: a video cannot be read.
        SettingsError: there is no background model of the settings' name.
    """
    if not recording.videos:
        return {}
    scaled = scaled_settings(settings, recording)
    return _tasks(recording, scaled, find_background(settings.background, scaled), cache)


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
    return _places(recording, tasks_of(recording, settings, cache))


def find_background(name: str, settings: ForegroundSettings) -> BackgroundModel:
    """The background model of a name: "mog2", "living", "network", a file of `psotrack train`, or a plugin.

    Raises:
        InputError: the file cannot be read, or is no network of this version.
        SettingsError: there is no background model of this name.
    """
    if path := model_path(name):
        from psotrack.foreground.network import model_at
        from psotrack.foreground.silhouettes.network_background import NetworkBackground

        model_at(path)
        return NetworkBackground(settings, path)
    built_in: dict[str, type[Mog2 | Living]] = {MOG2: Mog2, LIVING: Living}
    if name in built_in:
        return built_in[name](settings)
    return make_plugin(
        "background",
        name,
        settings,
        interface=BackgroundModel,
        setting="background",
        built_in=[*built_in, NETWORK],
    )


def scaled_settings(settings: SilhouetteSettings, recording: Recording) -> ForegroundSettings:
    """The settings of silhouettes for the images and the rig of a recording with videos or stored silhouettes.

    Where the settings leave a value open, cameras that have stored silhouettes and no video decide.

    Raises:
        InputError: this version does not know the settings with which these silhouettes were made.
    """
    rig = recording.rig
    stored = {each.name: each.silhouettes for each in recording.cameras if each.silhouettes}
    alone = [name for name in stored if name not in recording.videos]
    sizes_wh = [_size_wh(rig, name) for name in [*recording.videos, *alone]]
    if alone and settings.drone_px is None:
        made_with = _made_with(stored[alone[0]])
        still_open = {name: getattr(made_with, name) for name in _OPEN if getattr(settings, name) is None}
        settings = msgspec.structs.replace(settings, **still_open)
    return settings.scaled(sizes_wh, usual_drone_px(rig))


def usual_drone_px(rig: Rig) -> float | None:
    """Width of a drone of 0.3 m at the place at which all cameras look, pixels, in the camera that shows it smallest.

    None where the cameras are at one place, so that the rig does not say how far drones are.
    """
    depth_m = looking_depths_m(rig.cameras)
    if not (depth_m > 0).all():
        return None
    return float((_USUAL_DRONE_M * rig.cameras.K[:, 0, 0] / depth_m).min())


def _tasks(
    recording: Recording, scaled: ForegroundSettings, model: BackgroundModel, cache: Path
) -> dict[str, Task]:
    def task(name: str) -> Task:
        return task_of(recording.videos[name], scaled, model, recording.by_name[name].ignore, cache)

    with ThreadPoolExecutor() as threads:  # digests of files
        return dict(zip(recording.videos, threads.map(task, recording.videos), strict=True))


def _places(recording: Recording, tasks: Mapping[str, Task]) -> dict[str, StoredSilhouettes]:
    """Where each camera's silhouettes are: the recording's own are used where they are those that the task makes."""
    places = {}
    for each in recording.cameras:
        made, brought = tasks.get(each.name), each.silhouettes
        if brought is not None and (made is None or brought.key == made.stored.key):
            places[each.name] = brought
        elif made is not None:
            places[each.name] = made.stored
    return places


def _check_made_with(
    name: str, stored: StoredSilhouettes, scaled: ForegroundSettings, model: BackgroundModel
) -> None:
    """Raise `SettingsError` for silhouettes without a video that were made with other settings."""
    asked = _made_how(scaled, identify(model))
    made = _made_how(_made_with(stored), stored.made_of["background"])
    for setting in asked:
        if asked[setting] != made[setting]:
            raise SettingsError(
                f"silhouettes.{setting}",
                expected=f"{made[setting]}, as in {stored.path}",
                found=f"{asked[setting]}",
                remedy=f"other silhouettes need the video of camera {name}",
            )


def _made_how(settings: ForegroundSettings, background: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by name, with the class and the key of the background model."""
    model = {"background": lasting_name(background["class"]), "background.key": background["key"]}
    return msgspec.to_builtins(settings) | model


def _made_with(stored: StoredSilhouettes) -> ForegroundSettings:
    """The settings with which stored silhouettes were made.

    Raises:
        InputError: this version does not know these settings.
    """
    try:
        return msgspec.convert(stored.made_of["settings"], ForegroundSettings)
    except (msgspec.ValidationError, SettingsError) as error:
        expected = "silhouettes that were made with settings of this version"
        raise InputError(stored.path, expected=expected, found=f"{error}") from error


def _opened(
    name: str, place: StoredSilhouettes, tasks: Mapping[str, Task], rig: Rig, scaled: ForegroundSettings
) -> zarr.Array | None:
    """The stored silhouettes of a camera; None if there are none, or they are damaged."""
    shape = place.made_of["num_frames"], *reduced_shape(_size_wh(rig, name), scaled.reduction)
    return open_stored(place.path, shape, is_sealed=name in tasks and place is tasks[name].stored)


def _size_wh(rig: Rig, name: str) -> tuple[int, int]:
    width, height = rig.cameras.image_size_wh[rig.names.index(name)].astype(int).tolist()
    return width, height


def _make(tasks: list[Task], jobs: int, report: Report) -> dict[str, float]:
    """Make and store silhouettes; returns the seconds of "decode" and "foreground", summed over the workers, and those
    of the whole."""
    # Two cameras with the same content have the same key, so their silhouettes are made once.
    missing = list({task.stored.path: task for task in tasks}.values())
    taken: list[dict[str, float]] = []
    began = time.perf_counter()
    if missing:
        logger.info("silhouettes: computing those of %d videos", len(missing))
        with report("silhouettes", sum(task.num_decoded for task in missing)) as advance:
            taken = map_in_processes(store, missing, jobs=jobs, advance=advance)
    seconds = {stage: sum((each[stage] for each in taken), 0.0) for stage in ("decode", "foreground")}
    return {**seconds, "silhouettes": time.perf_counter() - began if missing else 0.0}


def _left_out(name: str, array: zarr.Array, times: FrameTimes, *, with_future: bool) -> list[Interval]:
    """Intervals of a camera's frames that are left out, said in warnings.

    Without the future, only frames that do not show the scene are: a frame alone says so.
    """
    left_out = np.zeros(times.num_frames, bool)
    for attribute, why, remedy in _WHY_LEFT_OUT[0 if with_future else -1 :]:
        stored: Any = array.attrs.get(attribute, [])  # as JSON keeps them
        chosen = np.zeros_like(left_out)
        for start, stop in stored:
            chosen[start:stop] = True
        if chosen.any():
            logger.warning(
                "camera %s: %d of %d frames are left out, because %s: frames %s; %s",
                name,
                np.count_nonzero(chosen),
                times.num_frames,
                why,
                in_words(intervals_of(chosen), gap_frames=max(1, round(times.fps))),
                remedy,
            )
        left_out |= chosen
    return intervals_of(left_out)


def _without(array: zarr.Array, intervals: list[Interval]) -> FramesOfInstants:
    """Stored silhouettes of which some frames show no foreground."""
    frame = np.arange(array.shape[0])
    for start, stop in intervals:
        frame[start:stop] = -1
    return FramesOfInstants(array, frame)
