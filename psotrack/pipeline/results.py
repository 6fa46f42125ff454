"""The result of a run: trajectories with names that last, and the record."""

from __future__ import annotations

import logging
import platform
import shlex
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any

import jax
import msgspec
import numpy as np
from jaxtyping import Float

from psotrack.camera_errors import TrackErrors
from psotrack.clocks import CameraClocks
from psotrack.errors import InputError
from psotrack.identity import Identities, postprocess
from psotrack.initiation import count_common, find_cut_off, find_outside, state_at_first_frame
from psotrack.methods import MethodResult
from psotrack.pipeline.parts import Parts
from psotrack.pipeline.preparation import PreparedRun
from psotrack.recordings import Recording
from psotrack.settings import MotionSettings, TrackSettings, setting_names
from psotrack.silhouettes import Silhouettes
from psotrack.support import html_block, html_lines
from psotrack.trajectories import DroneSizes, Trajectories, drones_html

logger = logging.getLogger(__name__)

#: Where detections of different cameras meet in a smaller share of the frames, something is wrong with the cameras:
#: rays of false detections meet by chance.
_FEW_MET = 0.2
#: Settings that the data give where nobody does, and the key of the record's `volume` that says which.
_FOUND = {"motion.max_speed_m_s": "speed_from", "bounds_m": "bounds_from"}
_MISSING = object()


@dataclass(frozen=True)
class TrackedRecording:
    """The result of tracking a recording.

    Attributes:
        trajectories: positions and covariances of every drone in every frame.
        size_m: (drones, 3), full lengths of each drone along the world's axes, as learned, metres.
        identities: which drones may have been taken for each other, and when.
        record: settings, versions, device, input keys and seconds per stage, fit for JSON.
    """

    trajectories: Trajectories
    size_m: Float[np.ndarray, "drones 3"]
    identities: Identities
    record: Mapping[str, Any]

    def __repr__(self) -> str:
        frames, drones = self.trajectories.num_frames, self.trajectories.num_drones
        return (
            f"TrackedRecording({self.record['sequence']}: {drones} drones, {frames} frames, "
            f"{self.trajectories.seen.mean():.1%} seen, {self.record['seconds']['total']:.1f} s)"
        )

    def _repr_html_(self) -> str:
        """What a notebook shows: the drones, their paths from above, other settings than the defaults, and seconds."""
        drones, frames = self.trajectories.num_drones, self.trajectories.num_frames
        return html_block(
            f"{self.record['sequence']}: {drones} drones, {frames} frames, {self.trajectories.seen.mean():.1%} seen",
            drones_html(self.trajectories, self.size_m),
            html_lines(
                {
                    "settings": ", ".join(
                        f"{name} = {value}" for name, value in changed_settings(self.record).items()
                    ),
                    "seconds": ", ".join(
                        f"{stage} {spent:.1f}" for stage, spent in self.record["seconds"].items()
                    ),
                }
            ),
        )


def changed_settings(record: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run that somebody chose and that are not today's defaults, by their dotted names.

    Args:
        record: record of the run; settings that it lacks, because a later version brought them, are left out.
    """
    # Through JSON, because a record that was read from a file has lists where settings have tuples.
    usual, used = (
        msgspec.json.decode(msgspec.json.encode(settings))
        for settings in (TrackSettings(), record["settings"])
    )
    changed = {}
    for name in setting_names():
        part, dot, field = name.partition(".")
        value, default = (
            each.get(part, {}).get(field, _MISSING) if dot else each.get(part, _MISSING)
            for each in (used, usual)
        )
        # The record has the values that were used, also where the data gave them.
        found = name in _FOUND and record.get("volume", {}).get(_FOUND[name]) != "given"
        if value is not _MISSING and value != default and not found:
            changed[name] = value
    return changed


def finish(
    recording: Recording,
    silhouettes: Silhouettes | None,
    run: PreparedRun,
    parts: Parts,
    result: MethodResult,
    clocks: CameraClocks | None = None,
) -> TrackedRecording | InputError:
    """Resolve identities, smooth, move to the body's origin, and write the record of one run."""
    settings, tracks = run.settings, result.tracks
    limited = find_outside(run.volume) or find_cut_off(tracks, run.volume, recording.fps)
    if limited is not None:
        logger.warning("%s", limited)
    if not tracks.num_drones:
        return _no_drones(recording, silhouettes, run)
    warn_of_missing_drones(settings, tracks.num_drones)
    began = time.perf_counter()
    errors = result.errors
    trajectories, identities = postprocess(
        tracks,
        settings.motion,
        settings.identity,
        fps=recording.fps,
        smoothing=None if not settings.smooth else _smoothing(settings.motion, errors),
    )
    if errors is not None:
        trajectories = errors.added_to(
            trajectories, identities.order if settings.identity.resolve_swaps else None
        )
    body_m = trajectories.position_m - settings.drones.body_offset_m
    timeline = recording.timeline()
    trajectories = replace(trajectories, position_m=body_m, time_s=timeline.time_s)
    of_silhouettes = {"decode": 0.0, "foreground": 0.0} if silhouettes is None else silhouettes.seconds
    seconds = {**of_silhouettes, **result.seconds, "finish": _finish_s(result, began)}
    own_s = sum(seconds[stage] for stage in ("track", "compile", "finish"))
    record = {
        "sequence": recording.name,
        "frames": trajectories.num_frames,
        "cameras": list(recording.rig.names),
        "rate_hz": timeline.rate_hz,
        "camera_times": _times_record(recording),
        **({} if clocks is None else {"camera_clocks": clocks.record(recording.rig.names)}),
        "settings": msgspec.to_builtins(settings),
        **({"parts": parts.record} if parts.record else {}),
        "seed": settings.seed,
        "start": {name: value.tolist() for name, value in vars(state_at_first_frame(tracks)).items()},
        "bounds_m": run.volume.bounds_m.tolist(),
        "volume": run.volume.record,
        "drones": _sizes_record(tracks.sizes),
        "arrivals": [asdict(arrival) for arrival in tracks.arrivals],
        "points": [asdict(point) for point in result.points],
        "camera_errors": {} if errors is None else errors.record(recording.rig.names),
        "encounters": [asdict(encounter) for encounter in identities.encounters],
        "input_keys": dict(result.input_keys),
        "left_out": {} if silhouettes is None else dict(silhouettes.left_out),
        "seconds": {stage: round(value, 4) for stage, value in (seconds | {"total": own_s}).items()},
        **environment(),
    }
    return TrackedRecording(trajectories, tracks.sizes.size_m, identities, record)


def warn_of_missing_drones(settings: TrackSettings, num_drones: int) -> None:
    """Say how many drones were seen, where the settings ask for more."""
    count = settings.drones.count
    if count is not None and num_drones < count:
        logger.warning("--drones %d: only %d drones were seen; the tracks have no others", count, num_drones)


def _no_drones(recording: Recording, silhouettes: Silhouettes | None, run: PreparedRun) -> InputError:
    """The error that says why no drone was found, as far as that is known."""
    found = "none in any frame"
    remedy = (
        "look at what the cameras see (`psotrack silhouettes`), or give the drones' first positions (init)"
    )
    detected = run.detections.sightings if run.detections is not None else silhouettes
    if detected is not None:
        common = count_common(recording.rig, detected)
        if common.met < _FEW_MET * common.seen:
            share = f"{common.met} of {common.seen} frames"
            found += f", and detections of different cameras that meet in a place in {share}"
            remedy = f"check the rig, its unit and the clocks: `psotrack doctor {shlex.quote(f'{recording.folder}')}`"
    return InputError(recording.folder, expected="drones", found=found, remedy=remedy)


def environment() -> dict[str, Any]:
    """Versions and device on which a result depends, fit for JSON."""
    packages = ("psotrack", "jax", "jaxlib", "numpy", "opencv-python-headless", "zarr")
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        "device": {"platform": device.platform, "kind": device.device_kind, "machine": platform.machine()},
    }


def with_real_time(record: Mapping[str, Any], wall_s: float, *, start_s: float = 0.0) -> dict[str, Any]:
    """The record with its real-time factors: seconds of video over seconds of wall clock.

    Args:
        record: record of a run.
        wall_s: time from the first byte that was read to the last row, seconds.
        start_s: part of it that the program took to start.
    """
    not_running_s = start_s + record["seconds"]["compile"]
    return {
        **record,
        "seconds": {**record["seconds"], "total": round(wall_s, 4)},
        **real_time_factors(record, wall_s, not_running_s),
    }


def real_time_factors(record: Mapping[str, Any], wall_s: float, not_running_s: float) -> dict[str, float]:
    """Seconds of video per second of wall clock, and the same without the start of the program and compilation.

    Args:
        record: record of a run.
        wall_s: seconds of wall clock that the run took.
        not_running_s: part of these seconds in which the program started and compiled.
    """
    video_s = record["frames"] / record["rate_hz"]
    return {
        "real_time_factor": round(video_s / wall_s, 3),
        "real_time_factor_running": round(video_s / max(wall_s - not_running_s, 1e-3), 3),
    }


def _times_record(recording: Recording) -> dict[str, dict[str, Any]]:
    """When each camera's frames were exposed, as the tracker used it, fit for JSON."""
    return {
        name: {"fps": times.fps, "time_offset_s": times.time_offset_s, "frames": times.num_frames}
        for name, times in recording.frame_times.items()
        if name in recording.rig.names
    }


def _smoothing(motion: MotionSettings, errors: TrackErrors | None) -> MotionSettings:
    """The motion model of the smoother: how errors fade is known once the whole recording was seen."""
    return motion if errors is None else errors.smoothing(motion)


def _finish_s(result: MethodResult, began: float) -> float:
    return result.seconds.get("finish", 0.0) + time.perf_counter() - began


def _sizes_record(sizes: DroneSizes) -> list[dict[str, Any]]:
    """What was learned of each drone's size, fit for JSON: null for what is not known."""

    def or_none(values: np.ndarray) -> list[float | None]:
        return [None if np.isnan(value) else float(value) for value in values]

    return [
        {
            "drone": drone,
            "size_m": sizes.size_m[drone].tolist(),
            "size_std_m": or_none(sizes.std_m[drone]),
            "size_frames": sizes.num_frames[drone].tolist(),
            "fill": or_none(sizes.fill[drone]) or None,
        }
        for drone in range(len(sizes.size_m))
    ]
