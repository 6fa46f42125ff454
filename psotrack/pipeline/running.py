"""The list of stages, from a recording to trajectories and a record.

    recording -> silhouettes or detections -> room bounds -> initial state -> tracking -> fusion
              -> identity and smoothing -> record

`track_recording` is what the command line, sweeps and notebooks call; `track_runs` does the stages for many settings at
once. Only this module knows the whole recording and the whole settings: each stage is given what it needs, and
returns a result.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from psotrack.detection import stored_detections
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import views_meet
from psotrack.initiation import MovingPoints, first_drones, given_state, known_motion, start_source
from psotrack.methods import (
    MethodInputs,
    MethodResult,
    fuse_methods,
    track_by_plugin,
    track_by_projection_lines,
    track_by_swarm,
    usable_for,
)
from psotrack.pipeline.clock_correction import advise_on_clocks, estimate_clocks, with_clocks
from psotrack.pipeline.parts import (
    Parts,
    check_detector_is_used,
    tracks_silhouettes,
    with_background,
)
from psotrack.pipeline.preparation import PreparedRun, prepare
from psotrack.pipeline.results import TrackedRecording, finish, with_real_time
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes, compute
from psotrack.support import Report, load_ahead, no_progress
from psotrack.tracking import RunInputs, tracker_settings


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
    # Wrong names are refused before silhouettes are computed, which takes minutes.
    if tracks_silhouettes(settings, parts.method):
        tracker_settings(settings, search=parts.search, score=parts.score)
    start_source(recording, settings.init)
    if parts.detector is not None:
        check_detector_is_used(settings, parts)
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
    (tracked,) = track_runs(recording, silhouettes, [settings], parts=parts, report=report)
    if isinstance(tracked, InputError):
        raise tracked
    if settings.clocks == "given" and len(recording.rig) > 2:
        advise_on_clocks(recording, silhouettes, settings, tracked.trajectories)
    return replace(tracked, record=with_real_time(tracked.record, time.perf_counter() - began))


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
        timed = recording.at_rate(rate_hz)
        shown = None if silhouettes is None else silhouettes.at_instants(timed.timeline())
        results = _track_at_instants(timed, shown, [settings[number] for number in numbers], parts, report)
        for number, (run, result) in zip(numbers, results, strict=True):
            if run.settings.clocks == "auto" and result.tracks.num_drones:
                clocks = estimate_clocks(timed, shown, run, result)
                corrected = with_clocks(timed, clocks)
                again = None if silhouettes is None else silhouettes.at_instants(corrected.timeline())
                ((run, result),) = _track_at_instants(corrected, again, [settings[number]], parts, report)
                tracked[number] = finish(corrected, again, run, parts, result, clocks)
            else:
                tracked[number] = finish(timed, shown, run, parts, result)
    return [tracked[number] for number in range(len(settings))]


def _track_at_instants(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: Sequence[TrackSettings],
    parts: Parts,
    report: Report,
) -> list[tuple[PreparedRun, MethodResult]]:
    """Each run and the result of its method; the silhouettes are those at the recording's instants."""
    points: dict[str, MovingPoints] = {}
    runs = [prepare(recording, silhouettes, each, parts, points, report) for each in settings]
    in_silhouettes = [run for run in runs if tracks_silhouettes(run.settings, run.plugin)]
    by_swarm = iter(_track_silhouettes(recording, silhouettes, in_silhouettes, parts, report))
    results = []
    for run in runs:
        if run.plugin is not None:
            results.append((run, _track_by_plugin(recording, silhouettes, run, report)))
            continue
        swarm = next(by_swarm) if tracks_silhouettes(run.settings, run.plugin) else None
        result = swarm
        if run.detections is not None:
            lines = track_by_projection_lines(
                recording.rig,
                run.detections,
                run.settings,
                fps=recording.fps,
                bounds_m=run.volume.bounds_m,
                known=known_motion(run.source, run.settings.drones, recording.fps),
                report=report,
            )
            result = lines if swarm is None else fuse_methods(swarm, lines, run.settings, recording.fps)
        assert result is not None, "each method of the package uses the swarm, projection lines, or both"
        results.append((run, result))
    return results


def _track_silhouettes(
    recording: Recording,
    silhouettes: Silhouettes | None,
    runs: Sequence[PreparedRun],
    parts: Parts,
    report: Report,
) -> list[MethodResult]:
    """The results of the swarm, for all its runs together."""
    if not runs:
        return []
    assert silhouettes is not None
    inputs = [
        RunInputs(
            run.volume.bounds_m,
            tracker_settings(run.settings, search=parts.search, score=parts.score),
            given_state(recording.rig, silhouettes, run.source, run.settings.drones, recording.fps),
        )
        for run in runs
    ]
    settings = [run.settings for run in runs]
    return track_by_swarm(recording.rig, silhouettes, inputs, settings, recording.fps, report)


def _track_by_plugin(
    recording: Recording, silhouettes: Silhouettes | None, run: PreparedRun, report: Report
) -> MethodResult:
    """The result of the method that is plugged in, which is given the drones of the first frames."""
    assert run.plugin is not None
    sightings = None if run.detections is None else run.detections.sightings
    initial = None
    if silhouettes is not None:
        initial = given_state(recording.rig, silhouettes, run.source, run.settings.drones, recording.fps)
    if initial is None:
        shown = sightings if silhouettes is None else silhouettes
        assert shown is not None
        initial = first_drones(
            recording.rig,
            shown,
            fps=recording.fps,
            bounds_m=run.volume.bounds_m,
            max_speed_m_s=run.settings.motion.speed_limit_m_s,
            drones=run.settings.drones,
        )
    inputs = MethodInputs(
        recording.rig, silhouettes, sightings, initial, run.volume.bounds_m, recording.fps, run.settings
    )
    return track_by_plugin(run.plugin, inputs, report)
