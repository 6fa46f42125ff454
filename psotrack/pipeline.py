"""From a sequence to trajectories: silhouettes or detections, a start, a tracker, and a record of the run.

`track_sequence` is what the command line, sweeps and notebooks call.
"""

from __future__ import annotations

import collections.abc
import hashlib
import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np
from jaxtyping import Float

from psotrack.datasets.dpjait import detection_files, read_detections
from psotrack.errors import InputError
from psotrack.finishing import finished
from psotrack.identity import Identities
from psotrack.initialisation import Start
from psotrack.progress import Report, silent
from psotrack.projection_lines import follow, start_of
from psotrack.sequence import Sequence
from psotrack.settings import BLOBS, YOLO, TrackSettings
from psotrack.sightings import from_detections, from_silhouettes
from psotrack.silhouettes import Silhouettes, compute
from psotrack.sizes import SizeState
from psotrack.starts import find_start, known_motion, room_bounds
from psotrack.tracking import Tracked, track_silhouettes
from psotrack.trajectories import Trajectories


@dataclass(frozen=True)
class TrackedSequence:
    """What tracking yields.

    Attributes:
        trajectories: every drone in every frame.
        size_m: (drones, 3), full lengths of each drone along the world's axes, as learned.
        identities: which drones may have been taken for each other, and when.
        record: settings, versions, device, input keys and seconds per stage, fit for JSON.
    """

    trajectories: Trajectories
    size_m: Float[np.ndarray, "drones 3"]
    identities: Identities
    record: Mapping[str, Any]


def track_sequence(
    sequence: Sequence,
    settings: TrackSettings = TrackSettings(),  # noqa: B008  frozen
    *,
    cache: Path,
    jobs: int | None = None,
    report: Report = silent,
) -> TrackedSequence:
    """Track the drones of a sequence from its videos.

    Args:
        sequence: fit for use (see `Sequence.usable`).
        settings: how.
        cache: folder of the stored silhouettes.
        jobs: processes for the silhouettes; None is one per processor.
        report: told of the frames of each stage.

    Raises:
        InputError: a video cannot be used, or the drones cannot be found.
        SettingsError: a setting does not fit the sequence.
        OutputError: the silhouettes cannot be stored.
    """
    began = time.perf_counter()
    silhouettes = None
    if not settings.reads_detections:
        silhouettes = compute(sequence, settings.silhouettes, cache=cache, jobs=jobs, report=report)
    tracked = track_from_silhouettes(sequence, silhouettes, settings, report=report)
    seconds = tracked.record["seconds"] | {"total": round(time.perf_counter() - began, 4)}
    return replace(tracked, record={**tracked.record, "seconds": seconds})


def track_from_silhouettes(
    sequence: Sequence, silhouettes: Silhouettes | None, settings: TrackSettings, *, report: Report = silent
) -> TrackedSequence:
    """Track the drones of a sequence of which there are silhouettes.

    Args:
        sequence: fit for use (see `Sequence.usable`).
        silhouettes: of all of its cameras; None where `settings` needs none.
        settings: how.
        report: told of the frames.

    Raises:
        InputError: the drones cannot be found, or detections cannot be read.
        SettingsError: a setting does not fit the sequence.
    """
    (tracked,) = track_runs(sequence, silhouettes, [settings], report=report)
    if isinstance(tracked, InputError):
        raise tracked
    return tracked


def track_runs(
    sequence: Sequence,
    silhouettes: Silhouettes | None,
    settings: collections.abc.Sequence[TrackSettings],
    *,
    report: Report = silent,
) -> list[TrackedSequence | InputError]:
    """Track a sequence once for each of the settings: each as by itself, many swarms in the time of a few.

    Swarms whose settings differ in seeds and in numbers other than of particles and windows are one batch, which all
    devices share (`jax.devices()`). The seconds of a run are its share of the batch's.

    Args:
        sequence: fit for use (see `Sequence.usable`).
        silhouettes: of all of its cameras; None where no settings need any.
        settings: of each run.
        report: told of the frames, in which all runs of a method go on together.

    Returns:
        For each run what it yields, or why nothing.

    Raises:
        InputError: there is nothing to start from, or detections cannot be read.
        SettingsError: a setting does not fit the sequence.
    """
    swarms = [number for number, each in enumerate(settings) if each.method == "swarm"]
    done: dict[int, TrackedSequence | InputError] = {}
    if swarms:
        assert silhouettes is not None
        of_swarms = _by_swarm(sequence, silhouettes, [settings[number] for number in swarms], report)
        done |= dict(zip(swarms, of_swarms, strict=True))
    for number, each in enumerate(settings):
        if number not in done:
            done[number] = _by_lines(sequence, silhouettes, each, report)
    return [done[number] for number in range(len(settings))]


def _by_swarm(
    sequence: Sequence,
    silhouettes: Silhouettes,
    settings: collections.abc.Sequence[TrackSettings],
    report: Report,
) -> list[TrackedSequence | InputError]:
    """What runs of the swarm yield."""
    began = time.perf_counter()
    bounds_m = [room_bounds(sequence.rig, each) for each in settings]
    starts = _starts(sequence, silhouettes, settings, bounds_m)
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
        _finished(sequence, dict(silhouettes.keys), *of, seconds)
        for of in zip(settings, starts, bounds_m, followed, strict=True)
    ]


def _by_lines(
    sequence: Sequence, silhouettes: Silhouettes | None, settings: TrackSettings, report: Report
) -> TrackedSequence | InputError:
    """What the projection lines yield."""
    began = time.perf_counter()
    bounds_m = room_bounds(sequence.rig, settings)
    if settings.detections == BLOBS:
        assert silhouettes is not None
        sightings, keys = from_silhouettes(silhouettes, report), dict(silhouettes.keys)
    else:
        files = detection_files_of(sequence, settings.detections)
        detections = {name: read_detections(path) for name, path in files.items()}
        sightings = from_detections(detections, sequence.rig, sequence.num_frames)
        keys = {name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for name, path in files.items()}
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
    return _finished(sequence, keys, settings, start_of(tracked), bounds_m, tracked, seconds)


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


def _starts(
    sequence: Sequence,
    silhouettes: Silhouettes,
    settings: collections.abc.Sequence[TrackSettings],
    bounds_m: list[Float[np.ndarray, "2 3"]],
) -> list[Start]:
    """The start of each run; runs that differ in nothing but their seeds have the same."""
    starts: dict[TrackSettings, Start] = {}
    alike = [msgspec.structs.replace(each, seed=0) for each in settings]
    for each, bounds in zip(alike, bounds_m, strict=True):
        if each not in starts:
            starts[each] = find_start(sequence, silhouettes, each, bounds)
    return [starts[each] for each in alike]


def _finished(
    sequence: Sequence,
    input_keys: Mapping[str, str],
    settings: TrackSettings,
    start: Start,
    bounds_m: Float[np.ndarray, "2 3"],
    tracked: Tracked,
    seconds: Mapping[str, float],
) -> TrackedSequence | InputError:
    """One run's trajectories and record."""
    if not tracked.info.status.shape[1]:
        return InputError(
            sequence.folder,
            expected="drones",
            found="none in any frame",
            remedy="look at what the cameras see with `psotrack silhouettes`, or say where they are with --init FILE",
        )
    followed = time.perf_counter()
    trajectories, identities = finished(tracked, settings, fps=sequence.fps)
    finish_s = time.perf_counter() - followed
    own_s = {"track": seconds["track"], "compile": seconds["compile"], "finish": finish_s}
    all_seconds = {**seconds, **own_s, "total": sum(own_s.values())}
    record = {
        "sequence": sequence.name,
        "frames": trajectories.num_frames,
        "cameras": list(sequence.rig.names),
        "settings": msgspec.to_builtins(settings),
        "seed": settings.seed,
        "start": {name: value.tolist() for name, value in vars(start).items()},
        "bounds_m": bounds_m.tolist(),
        "drones": _as_learned(tracked.sizes),
        "arrivals": [asdict(arrival) for arrival in tracked.arrivals],
        "encounters": [asdict(encounter) for encounter in identities.encounters],
        "input_keys": dict(input_keys),
        "seconds": {stage: round(value, 4) for stage, value in all_seconds.items()},
        **environment(),
    }
    return TrackedSequence(trajectories, np.asarray(tracked.sizes.size_m), identities, record)


def environment() -> dict[str, Any]:
    """Versions and device: what else a result depends on."""
    packages = ("psotrack", "jax", "jaxlib", "numpy", "opencv-python-headless", "zarr")
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        "device": {"platform": device.platform, "kind": device.device_kind, "machine": platform.machine()},
    }


def _as_learned(sizes: SizeState) -> list[dict[str, Any]]:
    """What was learned of each drone, fit for JSON: null for what is not known."""
    return [
        {
            "drone": drone,
            "size_m": sizes.size_m[drone].tolist(),
            "size_std_m": sizes.std_m[drone].tolist(),
            "size_frames": sizes.num_frames[drone].tolist(),
            "fill": [None if np.isnan(share) else float(share) for share in sizes.fill[drone]],
        }
        for drone in range(len(sizes.size_m))
    ]
