"""The methods of tracking, from what they read to tracks: the swarm, the projection lines, and both together."""

from __future__ import annotations

import collections.abc
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float

from psotrack.correspondence import from_detections, from_silhouettes
from psotrack.datasets.dpjait import detection_files, read_detections
from psotrack.errors import InputError
from psotrack.fusion import fuse_tracks
from psotrack.initiation import InitialState, find_initial_state, known_motion, room_bounds
from psotrack.projection_lines import follow, start_of
from psotrack.recordings import Sequence
from psotrack.settings import BLOBS, YOLO, TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.support import Report, digest_file
from psotrack.tracking import Tracked, track_silhouettes


@dataclass(frozen=True)
class Point:
    """Which point of a drone a track is of. Where the body's origin is from there no image shows.

    Attributes:
        drone: its number.
        middle_of: "silhouette" or "box".
        box_off_m, box_off_std_m: (3,), from the middle of its silhouette to that of its boxes along the world's axes,
            and the standard error of that; None where nothing tells.
    """

    drone: int
    middle_of: Literal["silhouette", "box"]
    box_off_m: list[float] | None = None
    box_off_std_m: list[float] | None = None


@dataclass(frozen=True)
class MethodResult:
    """How a run went.

    Attributes:
        tracked: what it yielded.
        points: of each drone, what its track is of.
        start: from where.
        bounds_m: (2, 3), lowest and highest corner of the room.
        input_keys: digests of what was read, by camera.
        seconds: by stage.
    """

    tracked: Tracked
    points: tuple[Point, ...]
    start: InitialState
    bounds_m: Float[np.ndarray, "2 3"]
    input_keys: Mapping[str, str]
    seconds: Mapping[str, float]


def track_by_swarm(
    sequence: Sequence,
    silhouettes: Silhouettes,
    settings: collections.abc.Sequence[TrackSettings],
    detected: collections.abc.Sequence[InitialState | None],
    report: Report,
) -> list[MethodResult]:
    """Runs of the swarm, together.

    Args:
        sequence: fit for use.
        silhouettes: of all of its cameras.
        settings: of each run.
        detected: for each run what detections say of frame 0, where they are read.
        report: told of the frames.

    Raises:
        InputError: there is nothing to start from.
        SettingsError: a setting does not fit the sequence.
    """
    began = time.perf_counter()
    bounds_m = [room_bounds(sequence.rig, each) for each in settings]
    starts = _starts(sequence, silhouettes, settings, bounds_m, detected)
    followed = track_silhouettes(
        sequence.rig, silhouettes, starts, settings, fps=sequence.fps, bounds_m=bounds_m, report=report
    )
    compile_s = sum(tracked.compile_s for tracked in followed)
    seconds = {
        **silhouettes.seconds,
        "compile": compile_s / len(settings),
        "track": (time.perf_counter() - began - compile_s) / len(settings),
    }
    return [
        MethodResult(tracked, _middles_of("silhouette", tracked), start, bounds, silhouettes.keys, seconds)
        for tracked, start, bounds in zip(followed, starts, bounds_m, strict=True)
    ]


def track_by_projection_lines(
    sequence: Sequence, silhouettes: Silhouettes | None, settings: TrackSettings, report: Report
) -> MethodResult:
    """A run of the projection lines.

    Raises:
        InputError: detections cannot be read.
    """
    began = time.perf_counter()
    bounds_m = room_bounds(sequence.rig, settings)
    if settings.detections == BLOBS:
        assert silhouettes is not None
        sightings, keys = from_silhouettes(silhouettes, report), dict(silhouettes.keys)
    else:
        files = detection_files_of(sequence, settings.detections)
        detections = {name: read_detections(path) for name, path in files.items()}
        sightings = from_detections(detections, sequence.rig, sequence.num_frames)
        keys = {name: digest_file(path, algorithm="sha256")[:16] for name, path in files.items()}
    tracked = follow(
        sequence.rig.cameras,
        sightings,
        settings,
        fps=sequence.fps,
        bounds_m=bounds_m,
        known=known_motion(sequence, settings),
        report=report,
    )
    before = {"decode": 0.0, "foreground": 0.0} if silhouettes is None else silhouettes.seconds
    seconds = {**before, "compile": tracked.compile_s, "track": time.perf_counter() - began}
    return MethodResult(tracked, _middles_of("box", tracked), start_of(tracked), bounds_m, keys, seconds)


def fuse_methods(
    swarm: MethodResult, lines: MethodResult, settings: TrackSettings, fps: float
) -> MethodResult:
    """What the two say together."""
    began = time.perf_counter()
    tracked, middles = fuse_tracks(
        swarm.tracked, lines.tracked, settings, fps=fps, same_foreground=settings.detections == BLOBS
    )
    seconds = {
        **swarm.seconds,
        "compile": swarm.seconds["compile"] + lines.seconds["compile"],
        "track": swarm.seconds["track"] + lines.seconds["track"] + time.perf_counter() - began,
    }
    keys = {**swarm.input_keys, **{f"detections of {name}": key for name, key in lines.input_keys.items()}}
    known = len(swarm.points)
    points = tuple(
        Point(drone, "silhouette" if drone < known else "box", *told)
        for drone, told in enumerate(zip(_told(middles.off_m), _told(middles.std_m), strict=True))
    )
    return MethodResult(tracked, points, swarm.start, swarm.bounds_m, keys, seconds)


def detection_files_of(sequence: Sequence, detections: str) -> Mapping[str, Path]:
    """The file of each camera, as `TrackSettings.detections` says.

    Raises:
        InputError: there is none.
    """
    if detections != YOLO:
        return detection_files(Path(detections), sequence.rig.names)
    if sequence.detections is None:
        raise InputError(
            sequence.folder,
            expected="detections in dl_data for --detections yolo",
            found="none",
            remedy="use --detections blobs",
        )
    return {name: path for name, path in sequence.detections.items() if name in sequence.rig.names}


def _middles_of(what: Literal["silhouette", "box"], tracked: Tracked) -> tuple[Point, ...]:
    return tuple(Point(drone, what) for drone in range(tracked.info.status.shape[1]))


def _told(values: Float[np.ndarray, "drones 3"]) -> list[list[float] | None]:
    """What is known of each drone, fit for JSON."""
    return [None if np.isnan(value).any() else value.tolist() for value in values]


def _starts(
    sequence: Sequence,
    silhouettes: Silhouettes,
    settings: collections.abc.Sequence[TrackSettings],
    bounds_m: list[Float[np.ndarray, "2 3"]],
    detected: collections.abc.Sequence[InitialState | None],
) -> list[InitialState]:
    """The start of each run; runs that differ in nothing but their seeds have the same."""
    starts: dict[TrackSettings, InitialState] = {}
    alike = [msgspec.structs.replace(each, seed=0) for each in settings]
    for each, bounds, also in zip(alike, bounds_m, detected, strict=True):
        if each not in starts:
            starts[each] = find_initial_state(sequence, silhouettes, each, bounds, also)
    return [starts[each] for each in alike]
