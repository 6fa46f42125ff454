"""From a recording to trajectories and a record, and how each method tracks on the way.

    recording -> silhouettes or detections -> room bounds -> tracking by swarm, projection lines, both or a plugin
              -> errors of the cameras -> fusion -> identity and smoothing -> record

`track_recording` is what the command line and notebooks call; `track_runs` does what follows the silhouettes, for the
many settings of a sweep at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from psotrack.camera_errors import CameraViews, views_of_middles, views_of_sightings, with_camera_errors
from psotrack.clocks import CameraClocks
from psotrack.detection import stored_detections
from psotrack.errors import InputError, SettingsError
from psotrack.fusion import fuse_tracks, fused_errors
from psotrack.geometry import views_meet
from psotrack.initiation import first_drones, given_state, known_motion, start_source
from psotrack.pipeline.clocks import advise_on_clocks, estimate_clocks, with_clocks
from psotrack.pipeline.inputs import Run, SharedInputs, prepare, usable_for
from psotrack.pipeline.parts import (
    MethodInputs,
    Parts,
    check_detector_is_used,
    find_method,
    with_background,
)
from psotrack.pipeline.results import (
    MethodResult,
    TrackedRecording,
    finish,
    with_real_time,
)
from psotrack.projection_lines import track_detections
from psotrack.recordings import Recording
from psotrack.settings import BLOBS, TrackSettings
from psotrack.silhouettes import Silhouettes, compute
from psotrack.support import Report, load_ahead, no_progress, processors
from psotrack.tracking import Places, RunInputs, track_silhouettes, tracker_settings
from psotrack.trajectories import Status, Tracks


def track_recording(
    recording: Recording,
    settings: TrackSettings = TrackSettings(),  # noqa: B008  frozen
    *,
    cache: Path | str,
    jobs: int | None = None,
    parts: Parts = Parts(),  # noqa: B008  frozen
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
    recording = usable_for(recording, settings, videos=parts.detector is not None)
    if parts.method is not None:
        recording = recording.usable(silhouettes=True)
    _check_cameras(recording)
    # Wrong names are refused before silhouettes are computed, which takes minutes.
    method = find_method(settings, parts)
    if method is None and settings.method != "projection-lines":
        tracker_settings(settings, search=parts.search, score=parts.score)
    start_source(recording, settings.init)
    if parts.detector is not None:
        check_detector_is_used(settings, method)
        folder = stored_detections(parts.detector, recording, cache=cache, report=report)
        settings = msgspec.structs.replace(settings, detections=str(folder))
    silhouettes = None
    if needs_silhouettes:
        parts = with_background(parts, recording, settings.silhouettes)
        silhouettes = compute(
            recording,
            settings.silhouettes,
            cache=Path(cache),
            jobs=jobs,
            background=parts.background,
            all_videos=settings.needs_each_video,
            report=report,
        )
    load_ahead()
    ((run, result, clocks),) = _track(recording, silhouettes, [settings], parts, report)
    tracked = finish(run, parts, result, clocks)
    if isinstance(tracked, InputError):
        raise tracked
    if clocks is None and len(recording.rig) > 2:
        advise_on_clocks(run, result.tracks)
    return replace(tracked, record=with_real_time(tracked.record, time.perf_counter() - began))


def _check_cameras(recording: Recording) -> None:
    if len(recording.rig) < 2:
        raise InputError(
            recording.folder,
            expected="at least two cameras that can be used, because one camera does not show distances",
            found=", ".join(recording.rig.names),
        )
    if not views_meet(recording.rig.cameras):
        raise InputError(
            recording.folder,
            expected="cameras of which two have a place in view together",
            found=f"that no views of {', '.join(recording.rig.names)} meet",
            remedy="check the places and directions of the cameras in the calibration",
        )


def track_runs(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    *,
    parts: Parts = Parts(),  # noqa: B008  frozen
    report: Report = no_progress,
) -> list[TrackedRecording | InputError]:
    """Track a recording once for each of the settings; on a CPU each result has the same bits as from the run alone.

    Runs of the swarm form a batch if they have the same number of drones, and if their settings differ only in the seed
    and in numbers other than `swarm.particles` and `score.windows`. The runs of a batch share one compiled program and
    one copy of the silhouettes; an accelerator computes them side by side. The seconds of a run are its share of the
    seconds of all runs.

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
    tracked = _track(recording, silhouettes, settings, parts, report)
    return [finish(run, parts, result, clocks) for run, result, clocks in tracked]


def _track(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    parts: Parts,
    report: Report,
) -> list[tuple[Run, MethodResult, CameraClocks | None]]:
    """Each run, the result of its method, and the clocks where they were estimated, before a second pass."""
    rates_hz = dict.fromkeys(each.rate_hz for each in settings)
    shared = {rate_hz: SharedInputs.of(recording.at_rate(rate_hz), silhouettes) for rate_hz in rates_hz}
    runs = [prepare(shared[each.rate_hz], each, parts, report) for each in settings]
    by_swarm: dict[Run, MethodResult] = {}
    for one in shared.values():
        together = [run for run in runs if run.by_swarm and run.recording is one.recording]
        by_swarm |= _track_by_swarm(together, parts, report)
    results = []
    for run, given in zip(runs, settings, strict=True):
        result, clocks = _result_of(run, by_swarm.get(run), report), None
        if given.clocks == "auto" and result.tracks.num_drones:
            clocks = estimate_clocks(run, result.tracks)
            once = msgspec.structs.replace(given, clocks="given")
            corrected = with_clocks(run.recording, clocks)
            ((again, result, _),) = _track(corrected, silhouettes, [once], parts, report)
            run = replace(again, settings=msgspec.structs.replace(again.settings, clocks="auto"))
        results.append((run, result, clocks))
    return results


def _result_of(run: Run, swarm: MethodResult | None, report: Report) -> MethodResult:
    """The result of the run's method; `swarm` is that of the swarm, where the method uses it."""
    if run.plugin is not None:
        return _track_by_plugin(run, report)
    if run.sightings is None:
        assert swarm is not None, "each method of the package uses the swarm, projection lines, or both"
        return swarm
    lines = _track_by_lines(run, report)
    return lines if swarm is None else _fused(run, swarm, lines)


def _track_by_swarm(runs: Sequence[Run], parts: Parts, report: Report) -> dict[Run, MethodResult]:
    """The results of the swarm, for all its runs together; the seconds of a run are its share of all."""
    if not runs:
        return {}
    recording, silhouettes = runs[0].recording, runs[0].silhouettes
    assert silhouettes is not None
    inputs = [
        RunInputs(
            run.volume.bounds_m,
            tracker_settings(run.settings, search=parts.search, score=parts.score),
            given_state(recording.rig, silhouettes, run.source, run.settings.drones, recording.fps),
        )
        for run in runs
    ]
    began = time.perf_counter()
    tracked, compile_s = track_silhouettes(
        recording.rig, silhouettes, inputs, fps=recording.fps, report=report
    )
    track_s = time.perf_counter() - began - compile_s
    shares = {"compile": compile_s / len(runs), "track": track_s / len(runs)}

    def with_errors(run: Run, found: tuple[Tracks, Places]) -> MethodResult:
        tracks, places = found
        views = partial(views_of_middles, recording.rig.cameras, silhouettes.exposures, places)
        seconds = {**silhouettes.seconds, **shares}
        result = MethodResult(tracks, _points(tracks, "silhouette"), silhouettes.keys, seconds)
        return _with_camera_errors(run, result, views)

    # NumPy computes most of it without Python's lock.
    with ThreadPoolExecutor(processors()) as threads:
        return dict(zip(runs, threads.map(with_errors, runs, tracked), strict=True))


def _track_by_lines(run: Run, report: Report) -> MethodResult:
    """The result of the projection lines."""
    assert run.sightings is not None
    rig, settings = run.recording.rig, run.settings
    began = time.perf_counter()
    tracks = track_detections(
        rig.cameras,
        run.sightings,
        settings,
        fps=run.recording.fps,
        bounds_m=run.volume.bounds_m,
        known=known_motion(run.source, settings.drones, run.recording.fps),
        report=report,
    )
    seconds = {"compile": 0.0, "track": run.read_s + time.perf_counter() - began}
    result = MethodResult(tracks, _points(tracks, "box"), run.detection_keys, seconds)
    return _with_camera_errors(run, result, partial(views_of_sightings, rig.cameras, run.sightings))


def _with_camera_errors(
    run: Run, result: MethodResult, views_at: Callable[[np.ndarray, np.ndarray], CameraViews]
) -> MethodResult:
    """The result with covariances that hold for the errors that the cameras show at the drones' places."""
    tracks, settings = result.tracks, run.settings
    if not tracks.num_drones:
        return result
    began = time.perf_counter()
    found = (np.asarray(tracks.status) == Status.TRACKED)[..., None]
    states = (np.asarray(value, np.float64) for value in (tracks.position_m, tracks.velocity_m_s))
    views = views_at(*(np.where(found, state, np.nan) for state in states))
    tracks, errors = with_camera_errors(tracks, views, settings.motion, settings.errors, run.recording.fps)
    seconds = {**result.seconds, "finish": time.perf_counter() - began}
    return replace(result, tracks=tracks, errors=errors, seconds=seconds)


def _fused(run: Run, swarm: MethodResult, lines: MethodResult) -> MethodResult:
    """The results of both methods in one, and the errors of the cameras that they contain."""
    began = time.perf_counter()
    settings, fps = run.settings, run.recording.fps
    fusion = fuse_tracks(
        swarm.tracks,
        lines.tracks,
        settings.motion,
        fps=fps,
        max_coasting_s=settings.status.max_coasting_s,
        same_foreground=settings.detections == BLOBS,
    )
    tracks, errors = fusion.tracks, None
    if swarm.errors is not None or lines.errors is not None:
        tracks, errors = fused_errors(fusion, swarm.errors, lines.errors, settings.motion, fps)
    both = ("finish", "compile", "track")
    seconds = {
        **swarm.seconds,
        **{stage: swarm.seconds.get(stage, 0.0) + lines.seconds.get(stage, 0.0) for stage in both},
    }
    seconds["track"] += time.perf_counter() - began
    keys = {**swarm.input_keys, **{f"detections of {name}": key for name, key in lines.input_keys.items()}}
    points = _points(tracks, "box")
    for point, offset_m, std_m in zip(points, fusion.offset.offset_m, fusion.offset.std_m, strict=True):
        if point["drone"] < swarm.tracks.num_drones:
            point["middle_of"] = "silhouette"
        if np.isfinite(offset_m).all():
            point |= {"box_off_m": offset_m.tolist(), "box_off_std_m": std_m.tolist()}
    return MethodResult(tracks, points, keys, seconds, errors)


def _track_by_plugin(run: Run, report: Report) -> MethodResult:
    """The result of the method that is plugged in, which is given the drones of the first frames."""
    assert run.plugin is not None
    recording, silhouettes, settings = run.recording, run.silhouettes, run.settings
    initial, keys = None, {}
    if silhouettes is not None:
        initial = given_state(recording.rig, silhouettes, run.source, settings.drones, recording.fps)
        keys = dict(silhouettes.keys)
    if initial is None:
        shown = run.sightings if silhouettes is None else silhouettes
        assert shown is not None
        initial = first_drones(
            recording.rig,
            shown,
            fps=recording.fps,
            bounds_m=run.volume.bounds_m,
            max_speed_m_s=settings.motion.speed_limit_m_s,
            drones=settings.drones,
        )
    began = time.perf_counter()
    tracks = run.plugin(
        MethodInputs(
            recording.rig, silhouettes, run.sightings, initial, run.volume.bounds_m, recording.fps, settings
        ),
        report,
    )
    seconds = {"compile": 0.0, "track": time.perf_counter() - began}
    return MethodResult(tracks, _points(tracks, "silhouette"), keys, seconds)


def _points(tracks: Tracks, middle_of: Literal["silhouette", "box"]) -> list[dict[str, Any]]:
    """For each drone the point that its track follows; where its box is beside it, fusion alone finds out."""
    known = {"middle_of": middle_of, "box_off_m": None, "box_off_std_m": None}
    return [{"drone": drone, **known} for drone in range(tracks.num_drones)]
