"""The pipeline: from a recording to trajectories and a record, stage by stage.

    recording -> silhouettes or detections -> room bounds -> initial state -> tracking -> fusion
              -> identity and smoothing -> record

`track_recording` is what the command line, sweeps and notebooks call; `track_runs` does the stages for many settings at
once. Only this module knows the whole recording and the whole settings: each stage is given what it needs, and
returns a result.
"""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np
from jaxtyping import Float

from psotrack.camera_errors import TrackErrors
from psotrack.clocks import CameraClocks, clocks_of_tracks
from psotrack.correspondence import from_silhouettes
from psotrack.detection import Detector, stored_detections
from psotrack.errors import InputError, SettingsError
from psotrack.identity import Identities, postprocess
from psotrack.initiation import (
    FlightVolume,
    InitialState,
    MovingPoints,
    StartSource,
    complete_initial_state,
    find_cut_off,
    find_initial_state,
    find_outside,
    flight_volume,
    known_motion,
    moving_blobs,
    moving_detections,
    start_source,
)
from psotrack.methods import (
    DetectionInputs,
    Method,
    MethodInputs,
    MethodResult,
    add_errors_of_both,
    add_errors_of_detections,
    add_errors_of_silhouettes,
    fuse_methods,
    read_sightings,
    track_by_plugin,
    track_by_projection_lines,
    track_by_swarm,
    usable_for,
)
from psotrack.projection_lines import LineSettings
from psotrack.recordings import Recording
from psotrack.settings import BLOBS, YOLO, MotionSettings, TrackSettings
from psotrack.silhouettes import BackgroundModel, Silhouettes, compute
from psotrack.support import Report, check_interface, identify, make_plugin, no_progress
from psotrack.tracking import RunInputs, Score, Search, tracker_settings
from psotrack.trajectories import DroneSizes, Trajectories

logger = logging.getLogger(__name__)

#: Number of instants in which given times of the frames are checked.
CHECKED_INSTANTS = 100
#: Least error of a camera's given times that is worth a warning, as a share of the interval between instants.
CERTAIN_SHARE = 0.3

#: The methods of this package.
BUILT_IN_METHODS = ("swarm", "projection-lines", "fused")


@dataclass(frozen=True)
class Parts:
    """Parts that the caller brings, instead of those that the settings name.

    Attributes:
        search: the search in one frame.
        score: the score of positions in single cameras.
        method: the method of tracking.
        background: the background model that makes the silhouettes; only `track_recording` makes silhouettes.
        detector: makes the detections; only `track_recording` makes detections.

    Raises:
        SettingsError: a part lacks an attribute or a method of its interface.
    """

    search: Search | None = None
    score: Score | None = None
    method: Method | None = None
    background: BackgroundModel | None = None
    detector: Detector | None = None

    def __post_init__(self) -> None:
        for kind, interface in _INTERFACES.items():
            if getattr(self, kind) is not None:
                check_interface(kind, getattr(self, kind), interface)

    @property
    def record(self) -> dict[str, Any]:
        """Identities of the parts that the caller brings, by kind, fit for JSON."""
        brought = {kind: getattr(self, kind) for kind in _INTERFACES}
        return {kind: identify(part) for kind, part in brought.items() if part is not None}


#: Interface of each of `Parts`.
_INTERFACES: dict[str, type] = {
    "search": Search,
    "score": Score,
    "method": Method,
    "background": BackgroundModel,
    "detector": Detector,
}


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


def track_recording(
    recording: Recording,
    settings: TrackSettings = TrackSettings(),  # noqa: B008  frozen
    *,
    cache: Path | str,
    jobs: int | None = None,
    parts: Parts = Parts(),
    report: Report = no_progress,
) -> TrackedRecording:
    """Track the drones of a recording from its videos.

    Args:
        recording: the recording; cameras that the method cannot use are left out with a warning.
        settings: settings of the run.
        cache: folder of the stored silhouettes and detections.
        jobs: number of processes that make silhouettes; None is one per processor.
        parts: parts that the caller brings.
        report: shows the progress of each stage, in frames.

    Raises:
        InputError: a video cannot be used, or the drones cannot be found.
        SettingsError: a setting does not fit the recording.
        OutputError: the silhouettes or the detections cannot be stored.
    """
    began = time.perf_counter()
    needs_silhouettes = settings.needs_silhouettes or parts.method is not None
    recording = usable_for(recording, settings, videos=needs_silhouettes or parts.detector is not None)
    if parts.detector is not None:
        _check_detector_is_used(settings, parts)
        folder = stored_detections(parts.detector, recording, cache=cache, report=report)
        settings = msgspec.structs.replace(settings, detections=str(folder))
    silhouettes = None
    if needs_silhouettes:
        silhouettes = compute(
            recording,
            settings.silhouettes,
            cache=Path(cache),
            jobs=jobs,
            background=parts.background,
            report=report,
        )
    (tracked,) = track_runs(recording, silhouettes, [settings], parts=parts, report=report)
    if isinstance(tracked, InputError):
        raise tracked
    if settings.clocks == "given" and len(recording.rig) > 2:
        _advise_on_clocks(recording, silhouettes, settings, tracked.trajectories)
    seconds = tracked.record["seconds"] | {"total": round(time.perf_counter() - began, 4)}
    return replace(tracked, record={**tracked.record, "seconds": seconds})


def track_runs(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    *,
    parts: Parts = Parts(),
    report: Report = no_progress,
) -> list[TrackedRecording | InputError]:
    """Track a recording once for each of the settings; on a CPU each result has the same bits as from the run alone.

    Runs of the swarm form a batch if they have the same number of drones, and if their settings differ only in the seed
    and in numbers other than `swarm.particles` and `score.windows`. The runs of a batch share one compiled program and
    one copy of the silhouettes; an accelerator computes them side by side. The runs are spread over all devices
    (`jax.devices()`). The seconds of a run are its share of the seconds of all runs.

    Args:
        recording: a recording that was checked for use (see `Recording.usable`).
        silhouettes: silhouettes of all cameras; None where no run needs them (see `TrackSettings.needs_silhouettes`).
        settings: settings of each run.
        parts: parts that the caller brings, for all runs.
        report: shows the progress in frames; the runs of the swarm go through the frames together.

    Returns:
        For each run its result, or the error that explains why the run has none.

    Raises:
        InputError: there is no reference or file for the initial state, or detections cannot be read.
        SettingsError: a setting does not fit the recording.
    """
    if silhouettes is None and (parts.method is not None or any(each.needs_silhouettes for each in settings)):
        raise SettingsError("silhouettes", expected="silhouettes of all cameras", found="none")
    tracked: dict[int, TrackedRecording | InputError] = {}
    for rate_hz in dict.fromkeys(each.rate_hz for each in settings):
        numbers = [number for number, each in enumerate(settings) if each.rate_hz == rate_hz]
        timed = replace(recording, rate_hz=rate_hz or recording.rate_hz)
        shown = None if silhouettes is None else silhouettes.at_instants(timed.timeline())
        results = _track_at_instants(timed, shown, [settings[number] for number in numbers], parts, report)
        for number, (run, result) in zip(numbers, results, strict=True):
            if run.settings.clocks == "auto" and result.tracks.num_drones:
                clocks = _estimate_clocks(timed, shown, run, result)
                corrected = _with_clocks(timed, clocks)
                again = None if silhouettes is None else silhouettes.at_instants(corrected.timeline())
                ((run, result),) = _track_at_instants(corrected, again, [settings[number]], parts, report)
                tracked[number] = _finish(corrected, again, run, parts, result, clocks)
            else:
                tracked[number] = _finish(timed, shown, run, parts, result)
    return [tracked[number] for number in range(len(settings))]


def _track_at_instants(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    parts: Parts,
    report: Report,
) -> list[tuple[_Run, MethodResult]]:
    """Each run and the result of its method; the silhouettes are those at the recording's instants."""
    points: dict[str, MovingPoints] = {}
    runs = [_prepare(recording, silhouettes, each, parts, points, report) for each in settings]
    by_lines = [_track_detections(recording, run, report) for run in runs]
    initial = _initial_states(recording, silhouettes, runs, by_lines)
    by_swarm = _track_silhouettes(recording, silhouettes, runs, initial, parts, report)
    by_plugin = [
        _track_with_plugin(recording, silhouettes, run, state, report)
        for run, state in zip(runs, initial, strict=True)
    ]
    return [
        (run, plugin or _with_camera_errors(recording, silhouettes, run, swarm, lines))
        for run, lines, swarm, plugin in zip(runs, by_lines, by_swarm, by_plugin, strict=True)
    ]


def _estimate_clocks(
    recording: Recording, silhouettes: Silhouettes | None, run: _Run, result: MethodResult
) -> CameraClocks:
    """Clocks of the cameras, from the tracks of a run and what the cameras show at them."""
    shown = silhouettes
    if run.detections is not None and run.settings.detections != BLOBS:
        sightings, shown = run.detections.sightings, None
    elif silhouettes is not None:
        sightings = from_silhouettes(silhouettes)
    return clocks_of_tracks(recording.rig, sightings, recording.timeline(), result.tracks, shown)


def _advise_on_clocks(
    recording: Recording, silhouettes: Silhouettes | None, settings: TrackSettings, tracked: Trajectories
) -> None:
    """Warn if some instants in the middle show for certain that a camera's given times are wrong."""
    recording = replace(recording, rate_hz=settings.rate_hz or recording.rate_hz)
    timeline = recording.timeline()
    first = max(0, (timeline.num_instants - CHECKED_INSTANTS) // 2)
    rows = np.arange(first, min(first + CHECKED_INSTANTS, timeline.num_instants))
    part = None
    if settings.reads_detections or silhouettes is None:
        sightings = read_sightings(recording, None, settings.detections).sightings.in_frames(rows)
    else:
        part = silhouettes.at_instants(timeline).part(int(rows[0]), int(rows[-1]) + 1)
        sightings = from_silhouettes(part)
    tracked = tracked.at_frames(rows)
    shown = replace(tracked, position_m=tracked.position_m + np.array(settings.drones.body_offset_m))
    clocks = clocks_of_tracks(recording.rig, sightings, timeline.part(rows), shown, part)
    certain = clocks.is_certain(CERTAIN_SHARE / timeline.rate_hz)
    if certain.any():
        worst = int(np.where(certain, np.abs(clocks.offset_s), 0.0).argmax())
        logger.warning(
            "camera %s is %s by %.0f ± %.0f ms against the other cameras; --clocks auto takes the clocks from the data",
            recording.rig.names[worst],
            "late" if clocks.offset_s[worst] < 0 else "early",
            1e3 * abs(clocks.offset_s[worst]),
            1e3 * clocks.offset_std_s[worst],
        )


def _with_clocks(recording: Recording, clocks: CameraClocks) -> Recording:
    """The recording with corrected times of the frames, and with as many instants as before."""
    times = clocks.corrected(recording.frame_times, recording.rig.names)
    return replace(recording, frame_times=times, rate_hz=recording.fps, num_instants=recording.num_frames)


def environment() -> dict[str, Any]:
    """Versions and device on which a result depends, fit for JSON."""
    packages = ("psotrack", "jax", "jaxlib", "numpy", "opencv-python-headless", "zarr")
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        "device": {"platform": device.platform, "kind": device.device_kind, "machine": platform.machine()},
    }


@dataclass(frozen=True)
class _Run:
    """What is known of a run before tracking.

    Attributes:
        settings: settings of the run, with the speed limit that was found.
        source: source of the initial state.
        volume: bounds of the room, and where they come from.
        plugin: the method that the caller brings or that an entry point names; None for the methods of this package.
        detections: detections of all cameras; None where the method reads none.
    """

    settings: TrackSettings
    source: StartSource
    volume: FlightVolume
    plugin: Method | None
    detections: DetectionInputs | None

    @property
    def bounds_m(self) -> Float[np.ndarray, "2 3"]:
        """(2, 3), lowest and highest corner of the room, metres."""
        return self.volume.bounds_m


def _prepare(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: TrackSettings,
    parts: Parts,
    points: dict[str, MovingPoints],
    report: Report,
) -> _Run:
    """Read the detections that the method needs, and find the volume and the speed limit.

    Args:
        recording, silhouettes, settings, parts, report: as in `track_runs`.
        points: moving points that earlier runs found, by the source of the detections; new ones are added.
    """
    plugin = _plugin(settings, parts)
    reads_detections = _tracks_detections(settings, plugin) if plugin is None else plugin.reads_detections
    detections = (
        read_sightings(recording, silhouettes, settings.detections, report) if reads_detections else None
    )
    source = BLOBS if detections is None else settings.detections
    bounds_m = settings.bounds_m or recording.bounds_m
    if source not in points and (bounds_m is None or settings.motion.max_speed_m_s is None):
        if detections is not None:
            points[source] = moving_detections(recording.rig, detections.sightings, recording.fps)
        elif silhouettes is not None:
            points[source] = moving_blobs(recording.rig, silhouettes, recording.fps)
    volume = flight_volume(
        recording.rig,
        points.get(source),
        bounds_m=bounds_m,
        max_speed_m_s=settings.motion.max_speed_m_s,
    )
    settings = settings.changed({"motion.max_speed_m_s": volume.max_speed_m_s})
    return _Run(settings, start_source(recording, settings.init), volume, plugin, detections)


def _plugin(settings: TrackSettings, parts: Parts) -> Method | None:
    """The method that the caller brings, or that an entry point names; None for the methods of this package."""
    if parts.method is not None:
        return parts.method
    if settings.method in BUILT_IN_METHODS:
        return None
    method: Method = make_plugin(
        "method", settings.method, settings, interface=Method, setting="method", built_in=BUILT_IN_METHODS
    )
    return method


def _tracks_silhouettes(settings: TrackSettings, plugin: Method | None) -> bool:
    return plugin is None and settings.method in ("swarm", "fused")


def _tracks_detections(settings: TrackSettings, plugin: Method | None) -> bool:
    return plugin is None and settings.method in ("projection-lines", "fused")


def _check_detector_is_used(settings: TrackSettings, parts: Parts) -> None:
    """Raise `SettingsError` if a detector is brought, but the method reads no detections or others are named."""
    method = _plugin(settings, parts)
    if not (_tracks_detections(settings, method) if method is None else method.reads_detections):
        name = settings.method if method is None else type(method).__name__
        expected = "a method that reads detections, such as projection-lines or fused"
        raise SettingsError("detector", expected=expected, found=f"method {name}")
    if settings.detections != YOLO:
        found = f"detections {settings.detections} as well"
        raise SettingsError("detector", expected="detections from one source", found=found)


def _track_detections(recording: Recording, run: _Run, report: Report) -> MethodResult | None:
    """The result of the projection lines; None where the run's method does not use them."""
    if run.detections is None or not _tracks_detections(run.settings, run.plugin):
        return None
    settings = run.settings
    return track_by_projection_lines(
        recording.rig,
        run.detections,
        LineSettings(settings.motion, settings.drones, settings.status, settings.swarm.spread_m),
        fps=recording.fps,
        bounds_m=run.bounds_m,
        known=known_motion(run.source, settings.drones, recording.fps),
        report=report,
    )


def _initial_states(
    recording: Recording,
    silhouettes: Silhouettes | None,
    runs: Sequence[_Run],
    by_lines: Sequence[MethodResult | None],
) -> list[InitialState]:
    """The initial state of each run; runs that differ only in their seeds have the same one.

    A run of the projection lines alone starts from the first frame of its own tracks.
    """
    states: dict[TrackSettings, InitialState] = {}
    of_runs = []
    for run, lines in zip(runs, by_lines, strict=True):
        if run.settings.method == "projection-lines" and lines is not None:
            of_runs.append(lines.initial)
            continue
        without_seed = msgspec.structs.replace(run.settings, seed=0)
        if without_seed not in states:
            assert silhouettes is not None
            drones = run.settings.drones
            found = find_initial_state(
                recording.rig,
                silhouettes,
                run.source,
                drones,
                fps=recording.fps,
                bounds_m=run.bounds_m,
                max_speed_m_s=run.settings.motion.speed_limit_m_s,
            )
            detected = None if lines is None else lines.initial
            states[without_seed] = complete_initial_state(found, detected, drones, run.source)
        of_runs.append(states[without_seed])
    return of_runs


def _track_silhouettes(
    recording: Recording,
    silhouettes: Silhouettes | None,
    runs: Sequence[_Run],
    initial: Sequence[InitialState],
    parts: Parts,
    report: Report,
) -> list[MethodResult | None]:
    """The results of the swarm, for all runs together; None for runs whose method does not use the swarm."""
    by_swarm = [number for number, run in enumerate(runs) if _tracks_silhouettes(run.settings, run.plugin)]
    results: list[MethodResult | None] = [None] * len(runs)
    if not by_swarm:
        return results
    assert silhouettes is not None
    inputs = [
        RunInputs(
            initial[number],
            runs[number].bounds_m,
            tracker_settings(runs[number].settings, search=parts.search, score=parts.score),
        )
        for number in by_swarm
    ]
    tracked = track_by_swarm(recording.rig, silhouettes, inputs, recording.fps, report)
    for number, result in zip(by_swarm, tracked, strict=True):
        results[number] = result
    return results


def _track_with_plugin(
    recording: Recording,
    silhouettes: Silhouettes | None,
    run: _Run,
    initial: InitialState,
    report: Report,
) -> MethodResult | None:
    """The result of the method that is plugged in; None where there is none."""
    if run.plugin is None:
        return None
    sightings = None if run.detections is None else run.detections.sightings
    inputs = MethodInputs(
        recording.rig, silhouettes, sightings, initial, run.bounds_m, recording.fps, run.settings
    )
    return track_by_plugin(run.plugin, inputs, report)


def _with_camera_errors(
    recording: Recording,
    silhouettes: Silhouettes | None,
    run: _Run,
    swarm: MethodResult | None,
    lines: MethodResult | None,
) -> MethodResult:
    """The result of swarm or projection lines, or of both fused, with the cameras' errors in the covariances."""
    rig, settings, fps = recording.rig, run.settings, recording.fps
    if swarm is not None and swarm.tracks.num_drones:
        assert silhouettes is not None
        swarm = add_errors_of_silhouettes(swarm, rig, silhouettes, settings, fps)
    if lines is not None and lines.tracks.num_drones:
        assert run.detections is not None
        lines = add_errors_of_detections(lines, rig, run.detections, settings, fps)
    if swarm is not None and lines is not None:
        fused = fuse_methods(swarm, lines, settings, fps)
        return (
            add_errors_of_both(fused, swarm, lines, rig, settings, fps) if fused.tracks.num_drones else fused
        )
    result = swarm or lines
    assert result is not None, "each method of the package uses the swarm, projection lines, or both"
    return result


def _finish(
    recording: Recording,
    silhouettes: Silhouettes | None,
    run: _Run,
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
        return InputError(
            recording.folder,
            expected="drones",
            found="none in any frame",
            remedy="look at what the cameras see (`psotrack silhouettes`), or give the drones' first positions (init)",
        )
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
        "start": {name: value.tolist() for name, value in vars(result.initial).items()},
        "bounds_m": run.bounds_m.tolist(),
        "volume": run.volume.record,
        "drones": _sizes_record(tracks.sizes),
        "arrivals": [asdict(arrival) for arrival in tracks.arrivals],
        "points": [asdict(point) for point in result.points],
        "camera_errors": {} if errors is None else errors.record(recording.rig.names),
        "encounters": [asdict(encounter) for encounter in identities.encounters],
        "input_keys": dict(result.input_keys),
        "seconds": {stage: round(value, 4) for stage, value in (seconds | {"total": own_s}).items()},
        **environment(),
    }
    return TrackedRecording(trajectories, tracks.sizes.size_m, identities, record)


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
            "fill": or_none(sizes.fill[drone]),
        }
        for drone in range(len(sizes.size_m))
    ]
