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
from psotrack.geometry import Rig
from psotrack.initiation import flight_volume
from psotrack.pipeline.results import environment, warn_of_missing_drones
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import compute, exposures_of
from psotrack.support import Report, no_progress
from psotrack.tracking import StepwiseTracker, tracker_settings
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
        **environment(),
    }


class CausalRecording:
    """A recording that is tracked as if its cameras were live: iterate over it for the rows of each frame.

    Args:
        recording: the recording; each camera with a video is used.
        settings: settings of the run.
        cache: folder of the stored silhouettes.
        jobs: number of processes that make silhouettes; None is one per processor.
        most_drones: largest number of drones at one time.
        report: shows the progress of each stage, in frames.

    Attributes:
        record: settings, versions, device and seconds per stage, fit for JSON; complete after the last frame.
    """

    def __init__(
        self,
        recording: Recording,
        settings: TrackSettings,
        *,
        cache: Path | str,
        jobs: int | None = None,
        most_drones: int = 16,
        report: Report = no_progress,
    ) -> None:
        self._settings, self._report = causal_settings(settings), report
        made = compute(
            recording, self._settings.silhouettes, cache=cache, jobs=jobs, all_videos=False, report=report
        )
        self._timeline = recording.at_rate(settings.rate_hz).timeline()
        self._silhouettes = made.at_instants(self._timeline)
        self._tracker, record = causal_tracker(
            recording.rig,
            self._settings,
            fps=self._timeline.rate_hz,
            bounds_m=recording.bounds_m,
            reduction=made.reduction,
            shape=made.shape,
            most_drones=most_drones,
        )
        began = time.perf_counter()
        self._tracker.compile()
        self.record = record | {
            "sequence": recording.name,
            "frames": self._timeline.num_instants,
            "input_keys": dict(made.keys),
            "seconds": {**made.seconds, "compile": time.perf_counter() - began},
        }

    def __iter__(self) -> Iterator[Trajectories]:
        time_s, exposures = self._timeline.time_s.tolist(), self._silhouettes.exposures
        exposures = exposures_of(self._timeline) if exposures is None else exposures
        drones: set[str] = set()
        seen, began = 0, time.perf_counter()
        with self._report("track", len(time_s)) as advance:
            for first in range(0, len(time_s), _READ_FRAMES):
                stop = min(first + _READ_FRAMES, len(time_s))
                for frame, coverage in enumerate(self._silhouettes.read(first, stop), first):
                    rows = self._tracker.step(frame, time_s[frame], coverage, exposures[frame])
                    drones.update(rows.drones)
                    seen += int(np.sum(rows.status == Status.TRACKED))
                    yield rows
                    self._tracker.look_ahead()
                advance(stop - first)
        warn_of_missing_drones(self._settings, len(drones))
        seconds = self.record["seconds"] | {"track": time.perf_counter() - began}
        self.record |= {
            "drones": len(drones),
            "tracked_rows": seen,
            "seconds": {stage: round(value, 4) for stage, value in seconds.items()},
        }
