"""From a sequence to trajectories: silhouettes or detections, a start, a tracker, and a record of the run.

`track_sequence` is what the command line, sweeps and notebooks call.
"""

from __future__ import annotations

import collections.abc
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

from psotrack.errors import InputError
from psotrack.identity import Identities, postprocess
from psotrack.methods import MethodResult, fuse_methods, track_by_projection_lines, track_by_swarm
from psotrack.recordings import Sequence
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes, compute
from psotrack.support import Report, no_progress
from psotrack.tracking import SizeState
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
    report: Report = no_progress,
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
    if settings.needs_silhouettes:
        silhouettes = compute(sequence, settings.silhouettes, cache=cache, jobs=jobs, report=report)
    tracked = track_from_silhouettes(sequence, silhouettes, settings, report=report)
    seconds = tracked.record["seconds"] | {"total": round(time.perf_counter() - began, 4)}
    return replace(tracked, record={**tracked.record, "seconds": seconds})


def track_from_silhouettes(
    sequence: Sequence,
    silhouettes: Silhouettes | None,
    settings: TrackSettings,
    *,
    report: Report = no_progress,
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
    report: Report = no_progress,
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
    ways = {
        number: track_by_projection_lines(sequence, silhouettes, each, report)
        for number, each in enumerate(settings)
        if each.method != "swarm"
    }
    swarms = [number for number, each in enumerate(settings) if each.method != "projection-lines"]
    if swarms:
        assert silhouettes is not None
        of_swarms = [settings[number] for number in swarms]
        detected = [ways[number].start if number in ways else None for number in swarms]
        followed = track_by_swarm(sequence, silhouettes, of_swarms, detected, report)
        for number, each, swarm in zip(swarms, of_swarms, followed, strict=True):
            both = number in ways
            ways[number] = fuse_methods(swarm, ways[number], each, sequence.fps) if both else swarm
    return [_finished(sequence, each, ways[number]) for number, each in enumerate(settings)]


def _finished(sequence: Sequence, settings: TrackSettings, way: MethodResult) -> TrackedSequence | InputError:
    """One run's trajectories and record."""
    tracked = way.tracked
    if not tracked.info.status.shape[1]:
        return InputError(
            sequence.folder,
            expected="drones",
            found="none in any frame",
            remedy="look at what the cameras see with `psotrack silhouettes`, or say where they are with --init FILE",
        )
    followed = time.perf_counter()
    trajectories, identities = postprocess(tracked, settings, fps=sequence.fps)
    finish_s = time.perf_counter() - followed
    own_s = {"track": way.seconds["track"], "compile": way.seconds["compile"], "finish": finish_s}
    all_seconds = {**way.seconds, **own_s, "total": sum(own_s.values())}
    record = {
        "sequence": sequence.name,
        "frames": trajectories.num_frames,
        "cameras": list(sequence.rig.names),
        "settings": msgspec.to_builtins(settings),
        "seed": settings.seed,
        "start": {name: value.tolist() for name, value in vars(way.start).items()},
        "bounds_m": way.bounds_m.tolist(),
        "drones": _as_learned(tracked.sizes),
        "arrivals": [asdict(arrival) for arrival in tracked.arrivals],
        "points": [asdict(point) for point in way.points],
        "encounters": [asdict(encounter) for encounter in identities.encounters],
        "input_keys": dict(way.input_keys),
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
