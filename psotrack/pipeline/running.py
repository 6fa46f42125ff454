"""From a recording to trajectories and a record, and how each method tracks on the way.

    recording -> silhouettes or detections -> room bounds -> tracking by swarm, projection lines, both or a plugin
              -> errors of the cameras -> fusion -> identity and smoothing -> record

`track_recording` is what the command line and notebooks call; `track_runs` does what follows the silhouettes, for the
many settings of a sweep at once.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, Unpack

import msgspec
import numpy as np

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.detection import stored_detections
from psotrack.foreground.silhouettes import (
    Exposures,
    Living,
    Silhouettes,
    compute,
    exposures_of,
    find_background,
    scaled_settings,
)
from psotrack.pipeline.corrections import (
    advise_on_clocks,
    estimate_clocks,
    warn_of_clock_step,
    warn_of_unknown_clocks,
    with_clocks,
    without_knocked,
)
from psotrack.pipeline.inputs import (
    MethodInputs,
    Parts,
    Run,
    check_detector_is_used,
    check_parts,
    find_method,
    prepare,
    usable_for,
)
from psotrack.pipeline.results import (
    MethodResult,
    TrackedRecording,
    finish,
    warn_of_blind_cameras,
    with_real_time,
)
from psotrack.recordings import Recording
from psotrack.settings import BLOBS, TrackSettings
from psotrack.support import Report, measured_compiling, no_progress, processors
from psotrack.tracking.births import (
    MovingPoints,
    first_drones,
    given_state,
    known_motion,
    start_source,
    with_speed_of_tracks,
)
from psotrack.tracking.camera_errors import views_of_places, with_camera_errors, with_nearest_sightings
from psotrack.tracking.fusion import fuse_tracks
from psotrack.tracking.lines import track_detections
from psotrack.tracking.matching import Sightings
from psotrack.tracking.swarm import Places, RunInputs, compile_ahead, track_silhouettes, tracker_settings
from psotrack.trajectories import Status, Tracks

logger = logging.getLogger(__name__)

#: Largest number of times that a recording is tracked again because its drones are faster than was assumed.
_MOST_SPEEDS = 3


def track_recording(
    recording: Recording,
    settings: TrackSettings = TrackSettings(),  # noqa: B008  frozen
    *,
    cache: Path | str,
    jobs: int | None = None,
    report: Report = no_progress,
    **parts: Unpack[Parts],
) -> TrackedRecording:
    """Track the drones of a recording from its videos.

    Args:
        recording: the recording; cameras that the method cannot use are left out with a warning.
        settings: settings of the run.
        cache: folder of the stored silhouettes and detections.
        jobs: number of processes that make silhouettes; None is one per processor.
        report: shows the progress of each stage, in frames.
        **parts: parts that the caller brings (see `Parts`).

    Raises:
        InputError: a video cannot be used, or the drones cannot be found.
        SettingsError: a setting does not fit the recording.
        OutputError: the silhouettes or the detections cannot be stored.
    """
    began = time.perf_counter()
    check_parts(parts)
    detector = parts.get("detector")
    recording = usable_for(recording, settings, videos=detector is not None)
    # Wrong names are refused before silhouettes are computed, which takes minutes.
    method = find_method(settings, parts)
    if method is None and settings.method != "projection-lines":
        tracker_settings(settings, search=parts.get("search"), score=parts.get("score"))
    start_source(recording, settings.init)
    if detector is not None:
        check_detector_is_used(settings, method)
        folder = stored_detections(detector, recording, cache=cache, report=report)
        settings = msgspec.structs.replace(settings, detections=str(folder))
    silhouettes = None
    if settings.needs_silhouettes or "method" in parts:
        with ThreadPoolExecutor(1) as beside:
            # The processes that make silhouettes leave this one nothing to do.
            if method is None and settings.method != "projection-lines":
                beside.submit(_compile_ahead, recording, settings, parts)
            silhouettes = compute(
                recording,
                settings.silhouettes,
                cache=Path(cache),
                jobs=jobs,
                background=parts.get("background"),
                all_videos=settings.needs_each_video,
                report=report,
            )
        if "background" not in parts:
            scaled = scaled_settings(settings.silhouettes, recording)
            model = find_background(settings.silhouettes.background, scaled)
            parts = parts if isinstance(model, Living) else {**parts, "background": model}
    ((run, result),) = _track(recording, silhouettes, [settings], parts, report)
    tracked = finish(run, result)
    if isinstance(tracked, InputError):
        raise tracked
    if run.clocks is None and len(recording.rig) > 2:
        advise_on_clocks(run, result.tracks)
    record = {**tracked.record, "frames_asked": recording.timing.num_instants}
    return replace(tracked, record=with_real_time(record, time.perf_counter() - began))


def track_runs(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    *,
    report: Report = no_progress,
    **parts: Unpack[Parts],
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
        report: shows the progress in frames; the runs of the swarm go through the frames together.
        **parts: parts that the caller brings, for all runs (see `Parts`).

    Returns:
        For each run its result, or the error that explains why the run has none.

    Raises:
        InputError: there is no reference or file for the initial state, or detections cannot be read.
        SettingsError: a setting does not fit the recording.
    """
    check_parts(parts)
    if silhouettes is None and ("method" in parts or any(each.needs_silhouettes for each in settings)):
        raise SettingsError("silhouettes", expected="silhouettes of all cameras", found="none")
    tracked = _track(recording, silhouettes, settings, parts, report)
    return [finish(run, result) for run, result in tracked]


def _compile_ahead(recording: Recording, settings: TrackSettings, parts: Parts) -> None:
    """Compile the swarm's program for silhouettes that are being made."""
    part = recording.at_rate(settings.rate_hz)
    timeline = part.timeline()
    compile_ahead(
        part.rig,
        tracker_settings(settings, search=parts.get("search"), score=parts.get("score")),
        fps=part.fps,
        reduction=scaled_settings(settings.silhouettes, recording).reduction,
        exposures=None if timeline.is_synchronous else exposures_of(timeline),
        num_frames=timeline.num_instants,
    )


def _track(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    parts: Parts,
    report: Report,
) -> list[tuple[Run, MethodResult]]:
    """Each run and the result of its method; of a second pass where one is needed: with estimated clocks, or without
    a camera from its knock on."""

    @cache
    def at_rate(rate_hz: float | None) -> tuple[Recording, Silhouettes | None, dict[Any, MovingPoints]]:
        part = recording.at_rate(rate_hz)
        return part, None if silhouettes is None else silhouettes.at_instants(part.timeline()), {}

    runs = [prepare(*at_rate(each.rate_hz), each, parts, report) for each in settings]
    by_swarm: dict[Run, MethodResult] = {}
    for rate_hz in dict.fromkeys(each.rate_hz for each in settings):
        together = [run for run in runs if run.by_swarm and run.settings.rate_hz == rate_hz]
        by_swarm |= _track_by_swarm(together, report)
    results = []
    for run, given in zip(runs, settings, strict=True):
        run, result = _at_speed_of_tracks(run, _result_of(run, by_swarm.get(run), report), report)
        errors = result.errors
        knock, clock_step = (None, None) if errors is None else (errors.knock, errors.clock_step)
        rest = None if knock is None else without_knocked(run, knock)
        if clock_step is not None and given.clocks == "given":
            warn_of_clock_step(run, clock_step)
        if knock is not None and rest is not None:
            ((again, result),) = _track(rest, silhouettes, [given], parts, report)
            run = replace(again, knocks=(knock, *again.knocks))
        elif given.clocks == "auto" and result.tracks.num_drones:
            clocks = estimate_clocks(run, result.tracks)
            warn_of_unknown_clocks(clocks, run.recording)
            once = msgspec.structs.replace(given, clocks="given")
            corrected = with_clocks(run.given, clocks)
            ((again, result),) = _track(corrected, silhouettes, [once], parts, report)
            run = replace(
                again, settings=msgspec.structs.replace(again.settings, clocks="auto"), clocks=clocks
            )
        results.append((run, result))
    return results


def _at_speed_of_tracks(run: Run, result: MethodResult, report: Report) -> tuple[Run, MethodResult]:
    """The run and its result; again with a higher speed limit where tracks reach a limit that nobody gave."""
    for _ in range(_MOST_SPEEDS if run.plugin is None else 0):
        volume = with_speed_of_tracks(run.volume, result.tracks, run.recording.fps)
        if volume is run.volume:
            break
        logger.warning(
            "up to %.1f m/s are flown: the assumed limit of %g m/s may cut off %d sightings; tracked again with %g m/s "
            "(or pass --max-speed)",
            *(volume.seen_speed_m_s, run.volume.max_speed_m_s, volume.num_faster, volume.max_speed_m_s),
        )
        settings = run.settings.changed({"motion.max_speed_m_s": volume.max_speed_m_s})
        run = replace(run, settings=settings, volume=volume)
        result = _result_of(run, _track_by_swarm([run], report).get(run) if run.by_swarm else None, report)
    return run, result


def _result_of(run: Run, swarm: MethodResult | None, report: Report) -> MethodResult:
    """The result of the run's method; `swarm` is that of the swarm, where the method uses it."""
    if run.plugin is not None:
        return _track_by_plugin(run, report)
    if run.sightings is None:
        assert swarm is not None, "each method of the package uses the swarm, projection lines, or both"
        return swarm
    lines = _track_by_lines(run, report)
    return lines if swarm is None else _fused(run, swarm, lines)


def _track_by_swarm(runs: Sequence[Run], report: Report) -> dict[Run, MethodResult]:
    """The results of the swarm, for all its runs together; the seconds of a run are its share of all."""
    if not runs:
        return {}
    recording, silhouettes = runs[0].recording, runs[0].silhouettes
    assert silhouettes is not None
    inputs = [
        RunInputs(
            run.volume.bounds_m,
            tracker_settings(run.settings, search=run.parts.get("search"), score=run.parts.get("score")),
            given_state(recording.rig, silhouettes, run.source, run.settings.drones, recording.fps),
        )
        for run in runs
    ]
    with _timed() as seconds:
        tracked = track_silhouettes(recording.rig, silhouettes, inputs, fps=recording.fps, report=report)
    shares = {stage: value / len(runs) for stage, value in seconds.items()}

    def with_errors(run: Run, found: tuple[Tracks, Places]) -> MethodResult:
        tracks, places = found
        warn_of_blind_cameras(run, tracks, np.isfinite(places.middle_px).all(axis=-1))
        result = MethodResult(tracks, _points(tracks, "silhouette"), silhouettes.keys, shares)
        return _with_camera_errors(run, result, places, silhouettes.exposures)

    # NumPy computes most of it without Python's lock.
    with ThreadPoolExecutor(processors()) as threads:
        return dict(zip(runs, threads.map(with_errors, runs, tracked), strict=True))


def _track_by_lines(run: Run, report: Report) -> MethodResult:
    """The result of the projection lines."""
    assert run.sightings is not None
    rig, settings = run.recording.rig, run.settings
    with _timed() as seconds:
        tracks, places = track_detections(
            rig.cameras,
            run.sightings,
            settings,
            fps=run.recording.fps,
            bounds_m=run.volume.bounds_m,
            known=known_motion(run.source, settings.drones, run.recording.fps),
            report=report,
        )
    seconds["track"] += run.read_s
    # Where there are silhouettes, they tell what the cameras see.
    if run.silhouettes is None:
        warn_of_blind_cameras(run, tracks, np.isfinite(places.middle_px).all(axis=-1))
    result = MethodResult(tracks, _points(tracks, "box"), run.detection_keys, seconds)
    return _with_camera_errors(run, result, places, sightings=run.sightings)


def _with_camera_errors(
    run: Run,
    result: MethodResult,
    places: Places,
    exposures: Exposures | None = None,
    sightings: Sightings | None = None,
) -> MethodResult:
    """The result with covariances that hold for the errors that the cameras show at the drones' places.

    Args:
        run: the run.
        result: its result.
        places: the drones' places in the images.
        exposures: exposures of the frames that show the places; None where they were all exposed at the instant.
        sightings: what the cameras see, where tracks follow from it.
    """
    tracks, settings = result.tracks, run.settings
    if not tracks.num_drones:
        return result
    began = time.perf_counter()
    found = (np.asarray(tracks.status) == Status.TRACKED)[..., None]
    position_m, velocity_m_s = (
        np.where(found, np.asarray(value, np.float64), np.nan)
        for value in (tracks.position_m, tracks.velocity_m_s)
    )
    cameras = run.recording.rig.cameras
    middle_px, weight = places.middle_px, places.weight
    views = views_of_places(cameras, middle_px, weight, position_m, velocity_m_s, exposures)
    all_views = None
    if sightings is not None:
        states = position_m, velocity_m_s
        all_px = with_nearest_sightings(cameras, middle_px, sightings, *states)
        all_views = views_of_places(cameras, all_px, np.ones(all_px.shape), *states)
    tracks, errors = with_camera_errors(
        tracks, views, settings.motion, settings.errors, run.recording.fps, all_views
    )
    seconds = {**result.seconds, "finish": time.perf_counter() - began}
    return replace(result, tracks=tracks, errors=errors, seconds=seconds)


def _fused(run: Run, swarm: MethodResult, lines: MethodResult) -> MethodResult:
    """The results of both methods in one, and the errors of the cameras that they contain."""
    began = time.perf_counter()
    fusion = fuse_tracks(
        swarm.tracks,
        lines.tracks,
        run.settings.motion,
        fps=run.recording.fps,
        max_coasting_s=run.settings.status.max_coasting_s,
        same_foreground=run.settings.detections == BLOBS,
        errors=(swarm.errors, lines.errors),
    )
    stages = ("compile", "track", "finish")
    seconds = {stage: swarm.seconds.get(stage, 0.0) + lines.seconds.get(stage, 0.0) for stage in stages}
    seconds["track"] += time.perf_counter() - began
    keys = {**swarm.input_keys, **{f"detections of {name}": key for name, key in lines.input_keys.items()}}
    points = _points(fusion.tracks, "box")
    for point, offset_m, std_m in zip(points, fusion.offset_m, fusion.offset_std_m, strict=True):
        if point["drone"] < swarm.tracks.num_drones:
            point["middle_of"] = "silhouette"
        if np.isfinite(offset_m).all():
            point |= {"box_off_m": offset_m.tolist(), "box_off_std_m": std_m.tolist()}
    return MethodResult(fusion.tracks, points, keys, seconds, fusion.errors)


def _track_by_plugin(run: Run, report: Report) -> MethodResult:
    """The result of the method that is plugged in, which is given the drones of the first frames."""
    recording, silhouettes, settings = run.recording, run.silhouettes, run.settings
    assert run.plugin is not None
    assert silhouettes is not None
    initial = given_state(recording.rig, silhouettes, run.source, settings.drones, recording.fps)
    if initial is None:
        initial = first_drones(
            recording.rig,
            silhouettes,
            fps=recording.fps,
            bounds_m=run.volume.bounds_m,
            max_speed_m_s=settings.motion.speed_limit_m_s,
            drones=settings.drones,
        )
    inputs = MethodInputs(
        recording.rig, silhouettes, run.sightings, initial, run.volume.bounds_m, recording.fps, settings
    )
    with _timed() as seconds:
        tracks = run.plugin(inputs, report)
    return MethodResult(tracks, _points(tracks, "silhouette"), silhouettes.keys, seconds)


@contextlib.contextmanager
def _timed() -> Iterator[dict[str, float]]:
    """The seconds of "compile" and "track" of the block, which are there after the block."""
    seconds: dict[str, float] = {}
    began = time.perf_counter()
    with measured_compiling() as compiling_s:
        yield seconds
        seconds["compile"] = compiling_s()
    seconds["track"] = time.perf_counter() - began - seconds["compile"]


def _points(tracks: Tracks, middle_of: Literal["silhouette", "box"]) -> list[dict[str, Any]]:
    """For each drone the point that its track follows; where its box is beside it, fusion alone finds out."""
    known = {"middle_of": middle_of, "box_off_m": None, "box_off_std_m": None}
    return [{"drone": drone, **known} for drone in range(tracks.num_drones)]
