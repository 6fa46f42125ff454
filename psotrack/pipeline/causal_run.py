"""Tracking without the future: what live cameras and `track --causal` have in common.

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
from jaxtyping import UInt8

from psotrack.errors import SettingsError
from psotrack.geometry import Rig
from psotrack.initiation import flight_volume
from psotrack.pipeline.results import environment, warn_of_missing_drones
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Exposures, compute, exposures_of
from psotrack.support import Report, no_progress
from psotrack.tracking import DroneRow, StepwiseTracker, tracker_settings
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


class CausalRun:
    """A run without the future, frame by frame.

    Args:
        rig: calibrated cameras.
        settings: settings of the run, from `causal_settings`.
        fps: frames per second.
        bounds_m: bounds of the room (x0, x1, y0, y1, z0, z1), metres; None: those of the settings or of the cameras.
        reduction: image pixels per silhouette pixel, along each side.
        shape: height and width of the silhouettes.
        most_drones: largest number of drones at one time.

    Attributes:
        volume: bounds of the room and largest speed, fit for JSON.
    """

    def __init__(
        self,
        rig: Rig,
        settings: TrackSettings,
        *,
        fps: float,
        bounds_m: tuple[float, ...] | None,
        reduction: int,
        shape: tuple[int, int],
        most_drones: int,
    ) -> None:
        volume = flight_volume(
            rig,
            None,
            bounds_m=settings.bounds_m or bounds_m,
            max_speed_m_s=settings.motion.max_speed_m_s,
        )
        settings = settings.changed({"motion.max_speed_m_s": volume.max_speed_m_s})
        self.volume = volume.record
        self._offset_m = np.asarray(settings.drones.body_offset_m)
        self._tracker = StepwiseTracker(
            rig,
            tracker_settings(settings),
            fps=fps,
            bounds_m=volume.bounds_m,
            reduction=reduction,
            shape=shape,
            most_drones=most_drones,
        )

    def compile(self) -> None:
        """Compile what no frame should wait for."""
        self._tracker.compile()

    def step(
        self,
        frame: int,
        time_s: float,
        coverage: UInt8[np.ndarray, "cameras height width"],
        exposures: Exposures,
        *,
        num_frames: int = 1,
    ) -> Trajectories:
        """The drones that are known in the next frame, as the rows of this frame.

        Args:
            frame, time_s: number and time of the frame.
            coverage: (cameras, height, width), silhouettes of the frame.
            exposures: when the cameras' frames were exposed, and which cameras have one.
            num_frames: number of frames since the last one.
        """
        return self._as_trajectories(
            frame, time_s, self._tracker.step(coverage, exposures, num_frames=num_frames)
        )

    def look_ahead(self) -> None:
        """What need not be done before the rows of a frame are passed on; to be called after each `step`."""
        self._tracker.look_ahead()

    def _as_trajectories(self, frame: int, time_s: float, rows: list[DroneRow]) -> Trajectories:
        def stacked(name: str, shape: tuple[int, ...]) -> np.ndarray:
            return np.array([getattr(row, name) for row in rows], np.float32).reshape(1, len(rows), *shape)

        return Trajectories(
            frame=np.array([frame]),
            time_s=np.array([time_s]),
            drones=tuple(f"{row.drone}" for row in rows),
            position_m=stacked("position_m", (3,)) - self._offset_m.astype(np.float32),
            velocity_m_s=stacked("velocity_m_s", (3,)),
            fitness=stacked("fitness", ()),
            num_cameras=np.array([[row.num_cameras for row in rows]], int).reshape(1, len(rows)),
            status=np.array([[int(row.status) for row in rows]], int).reshape(1, len(rows)),
            covariance_m2=stacked("covariance_m2", (3, 3)),
        )


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
        settings = causal_settings(settings)
        self._settings = settings
        self._report = report
        self._timed = recording.at_rate(settings.rate_hz)
        timeline = self._timed.timeline()
        made = compute(
            recording, settings.silhouettes, cache=cache, jobs=jobs, all_videos=False, report=report
        )
        self._silhouettes = made.at_instants(timeline)
        self._time_s = timeline.time_s
        shown = self._silhouettes.exposures
        self._exposures = exposures_of(timeline) if shown is None else shown
        self._run = CausalRun(
            recording.rig,
            settings,
            fps=timeline.rate_hz,
            bounds_m=recording.bounds_m,
            reduction=made.reduction,
            shape=made.shape,
            most_drones=most_drones,
        )
        began = time.perf_counter()
        self._run.compile()
        self._seconds = {**made.seconds, "compile": time.perf_counter() - began, "track": 0.0}
        self.record: dict[str, Any] = {
            "sequence": recording.name,
            "causal": True,
            "most_drones": most_drones,
            "frames": len(self._time_s),
            "cameras": list(recording.rig.names),
            "rate_hz": timeline.rate_hz,
            "settings": msgspec.to_builtins(settings),
            "seed": settings.seed,
            "volume": self._run.volume,
            "input_keys": dict(made.keys),
            **environment(),
        }

    def __iter__(self) -> Iterator[Trajectories]:
        num_frames = len(self._time_s)
        drones: set[str] = set()
        seen = 0
        with self._report("track", num_frames) as advance:
            for first in range(0, num_frames, _READ_FRAMES):
                stop = min(first + _READ_FRAMES, num_frames)
                for frame, coverage in enumerate(self._silhouettes.read(first, stop), first):
                    began = time.perf_counter()
                    rows = self._run.step(frame, float(self._time_s[frame]), coverage, self._exposures[frame])
                    self._run.look_ahead()
                    self._seconds["track"] += time.perf_counter() - began
                    drones.update(rows.drones)
                    assert rows.status is not None
                    seen += int((rows.status == Status.TRACKED).sum())
                    yield rows
                advance(stop - first)
        warn_of_missing_drones(self._settings, len(drones))
        self.record |= {
            "drones": len(drones),
            "tracked_rows": seen,
            "seconds": {stage: round(value, 4) for stage, value in self._seconds.items()},
        }
