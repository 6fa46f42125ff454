"""Tracking without the future: what `track --causal` and live cameras have in common, and a recording as if live.

The background is learned as the frames come, a drone's rows begin when the drone is found, labels are settled at once,
and nothing is smoothed: the rows of a frame depend on no later frame.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import compute, exposures_of
from psotrack.geometry import Rig
from psotrack.pipeline.results import centre_of_ellipsoids, environment, warn_of_missing_drones
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.support import Report, measured_compiling, no_progress
from psotrack.tracking.births import flight_volume
from psotrack.tracking.swarm import StepwiseTracker, tracker_settings
from psotrack.trajectories import Status, Trajectories

#: Number of frames whose silhouettes are read together.
_READ_FRAMES = 25


def causal_settings(settings: TrackSettings) -> TrackSettings:
    """The settings of a run without the future.

    Raises:
        SettingsError: a setting needs the future, or another method than the swarm.
    """
    allowed = {"method": "swarm", "smooth": False, "init": "auto", "clocks": "given"}
    for name, value in allowed.items():
        if getattr(settings, name) != value:
            raise SettingsError(
                name, expected=f"{value} without the future", found=f"{getattr(settings, name)}"
            )
    return settings.changed({"silhouettes.first_look": False})


def causal_tracker(
    rig: Rig,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: tuple[float, ...] | None,
    reduction: int,
    shape: tuple[int, int],
    most_drones: int,
) -> tuple[StepwiseTracker, dict[str, Any]]:
    """The tracker of a run without the future, and the part of the run's record that is known before the first frame.

    Args:
        rig: calibrated cameras.
        settings: settings of the run, from `causal_settings`.
        fps: instants per second.
        bounds_m: bounds of the room (x0, x1, y0, y1, z0, z1), metres; None: those of the settings or of the cameras.
        reduction: image pixels per silhouette pixel, along each side.
        shape: height and width of the silhouettes.
        most_drones: largest number of drones at one time.
    """
    speed_m_s = settings.motion.max_speed_m_s
    volume = flight_volume(rig, None, bounds_m=settings.bounds_m or bounds_m, max_speed_m_s=speed_m_s)
    tracker = StepwiseTracker(
        rig,
        tracker_settings(settings.changed({"motion.max_speed_m_s": volume.max_speed_m_s})),
        fps=fps,
        bounds_m=volume.bounds_m,
        reduction=reduction,
        shape=shape,
        most_drones=most_drones,
    )
    return tracker, {
        "causal": True,
        "most_drones": most_drones,
        "cameras": list(rig.names),
        "rate_hz": fps,
        "settings": msgspec.to_builtins(settings),
        "seed": settings.seed,
        "volume": volume.record,
        "ellipsoid": centre_of_ellipsoids(["silhouette"], settings.drones),
        **environment(),
    }


def track_causally(
    recording: Recording,
    settings: TrackSettings,
    *,
    cache: Path | str,
    jobs: int | None = None,
    most_drones: int = 16,
    report: Report = no_progress,
) -> tuple[Iterator[Trajectories], dict[str, Any]]:
    """Track a recording as if its cameras were live.

    Args:
        recording: the recording; each camera with a video is used.
        settings: settings of the run.
        cache: folder of the stored silhouettes.
        jobs: number of processes that make silhouettes; None is one per processor.
        most_drones: largest number of drones at one time.
        report: shows the progress of each stage, in frames.

    Returns:
        The rows of each frame, which are tracked one after the other; and settings, versions, device and seconds per
        stage, fit for JSON, which are complete after the last frame.
    """
    settings = causal_settings(settings)
    made = compute(recording, settings.silhouettes, cache=cache, jobs=jobs, all_videos=False, report=report)
    timeline = recording.at_rate(settings.rate_hz).timeline()
    silhouettes = made.at_instants(timeline)
    tracker, record = causal_tracker(
        recording.rig,
        settings,
        fps=timeline.rate_hz,
        bounds_m=recording.bounds_m,
        reduction=made.reduction,
        shape=made.shape,
        most_drones=most_drones,
    )
    record |= {
        "sequence": recording.name,
        "frames": timeline.num_instants,
        "frames_asked": recording.timing.num_instants,
        "input_keys": dict(made.keys),
    }

    def rows_of_frames() -> Iterator[Trajectories]:
        exposures = exposures_of(timeline) if silhouettes.exposures is None else silhouettes.exposures
        drones: set[str] = set()
        seen, began = 0, time.perf_counter()
        with measured_compiling() as compiling_s, report("track", timeline.num_instants) as advance:
            for first in range(0, timeline.num_instants, _READ_FRAMES):
                stop = min(first + _READ_FRAMES, timeline.num_instants)
                for frame, coverage in enumerate(silhouettes.read(first, stop), first):
                    rows = tracker.step(frame, float(timeline.time_s[frame]), coverage, exposures[frame])
                    drones.update(rows.drones)
                    seen += int(np.sum(rows.status == Status.TRACKED))
                    yield rows
                    tracker.look_ahead()
                advance(stop - first)
            compile_s = compiling_s()
        warn_of_missing_drones(settings, len(drones))
        track_s = time.perf_counter() - began - compile_s
        seconds = {**made.seconds, "compile": compile_s, "track": track_s}
        record.update(
            drones=len(drones),
            tracked_rows=seen,
            seconds={stage: round(value, 4) for stage, value in seconds.items()},
        )

    return rows_of_frames(), record
