"""The stages of tracking, each for one run or for all runs together."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from psotrack.initiation import InitialState, complete_initial_state, find_initial_state, known_motion
from psotrack.methods import (
    MethodInputs,
    MethodResult,
    add_errors_of_detections,
    add_errors_of_silhouettes,
    fuse_methods,
    track_by_plugin,
    track_by_projection_lines,
    track_by_swarm,
)
from psotrack.pipeline.parts import Parts, tracks_detections, tracks_silhouettes
from psotrack.pipeline.preparation import PreparedRun
from psotrack.projection_lines import LineSettings
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.support import Report
from psotrack.tracking import RunInputs, tracker_settings


def track_detections(recording: Recording, run: PreparedRun, report: Report) -> MethodResult | None:
    """The result of the projection lines; None where the run's method does not use them."""
    if run.detections is None or not tracks_detections(run.settings, run.plugin):
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


def initial_states(
    recording: Recording,
    silhouettes: Silhouettes | None,
    runs: Sequence[PreparedRun],
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


def track_silhouettes(
    recording: Recording,
    silhouettes: Silhouettes | None,
    runs: Sequence[PreparedRun],
    initial: Sequence[InitialState],
    parts: Parts,
    report: Report,
) -> list[MethodResult | None]:
    """The results of the swarm, for all runs together; None for runs whose method does not use the swarm."""
    by_swarm = [number for number, run in enumerate(runs) if tracks_silhouettes(run.settings, run.plugin)]
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


def track_with_plugin(
    recording: Recording,
    silhouettes: Silhouettes | None,
    run: PreparedRun,
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


def with_errors_of_silhouettes(
    recording: Recording,
    silhouettes: Silhouettes | None,
    runs: Sequence[PreparedRun],
    by_swarm: Sequence[MethodResult | None],
) -> list[MethodResult | None]:
    """The results of the swarm with the cameras' errors in the covariances, for all runs together."""
    corrected = list(by_swarm)
    found = {number: result for number, result in enumerate(by_swarm) if result and result.tracks.num_drones}
    if not found:
        return corrected
    assert silhouettes is not None
    settings = [runs[number].settings for number in found]
    results = add_errors_of_silhouettes(
        list(found.values()), recording.rig, silhouettes, settings, recording.fps
    )
    for number, result in zip(found, results, strict=True):
        corrected[number] = result
    return corrected


def with_errors_of_detections(
    recording: Recording,
    run: PreparedRun,
    swarm: MethodResult | None,
    lines: MethodResult | None,
) -> MethodResult:
    """The result of swarm or projection lines, or of both fused, with the cameras' errors in the covariances.

    Args:
        recording: the recording.
        run: the run.
        swarm: result of the swarm, with the errors of the cameras.
        lines: result of the projection lines.
    """
    settings, fps = run.settings, recording.fps
    if lines is not None and lines.tracks.num_drones:
        assert run.detections is not None
        lines = add_errors_of_detections(lines, recording.rig, run.detections, settings, fps)
    if swarm is not None and lines is not None:
        return fuse_methods(swarm, lines, settings, fps)
    result = swarm or lines
    assert result is not None, "each method of the package uses the swarm, projection lines, or both"
    return result
