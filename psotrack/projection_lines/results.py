"""From the tracks' notes to the arrays that all methods give."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from psotrack.initiation import InitialState
from psotrack.projection_lines.tracks import Track, TrackRow
from psotrack.settings import TrackSettings
from psotrack.tracking import Arrival, ScoreSettings, SizeMeasurements, Tracked, TrackerInfo
from psotrack.tracking import init as init_sizes
from psotrack.trajectories import Status


def tracked_of(tracks: list[Track], num_frames: int, settings: TrackSettings) -> Tracked:
    """The notes on all drones in arrays."""
    num_drones = len({track.drone for track in tracks})
    shape = (num_frames, num_drones)
    info = TrackerInfo(
        position_m=np.full((*shape, 3), np.nan),
        velocity_m_s=np.full((*shape, 3), np.nan),
        covariance_m2=np.full((*shape, 3, 3), np.nan),
        measured_m=np.full((*shape, 3), np.nan),
        measured_covariance_m2=np.full((*shape, 3, 3), np.nan),
        fitness=np.zeros(shape),
        num_cameras=np.zeros(shape, int),
        status=np.full(shape, int(Status.LOST)),
    )
    arrivals: list[Arrival] = []
    size_m: dict[int, Float[np.ndarray, "3"]] = {}
    for track in sorted(tracks, key=lambda track: track.rows[0].frame):
        assert track.drone is not None
        if track.rows[0].frame > 0:
            arrivals.append(Arrival(track.rows[0].frame, track.drone, again=track.drone in size_m))
        size_m[track.drone] = track.size_m
        for row in track.rows:
            _write(info, row, (row.frame, track.drone))
    score = ScoreSettings(windows=settings.windows)
    sizes = np.array([size_m[drone] for drone in range(num_drones)], np.float32).reshape(-1, 3)
    return Tracked(
        info=info,
        sizes=jax.tree.map(np.asarray, init_sizes(sizes, np.zeros(sizes.shape, bool), score)),
        looks=SizeMeasurements(np.full((*shape, 3), np.nan), np.full((*shape, len(score.windows)), np.nan)),
        arrivals=tuple(arrivals),
        compile_s=0.0,
    )


def start_of(tracked: Tracked) -> InitialState:
    """The drones that were there at frame 0, as a start of tracking."""
    there = np.flatnonzero(np.isfinite(tracked.info.position_m[0]).all(axis=-1))
    position_m, velocity_m_s = (
        np.asarray(value[0], np.float64)[there]
        for value in (tracked.info.position_m, tracked.info.velocity_m_s)
    )
    size_m = np.asarray(tracked.sizes.size_m, np.float64)[there]
    return InitialState(
        position_m, velocity_m_s, size_m, np.asarray(tracked.info.num_cameras[0], float)[there]
    )


def _write(info: TrackerInfo, row: TrackRow, of: tuple[int, int]) -> None:
    """Write a row into the arrays."""
    info.position_m[of], info.velocity_m_s[of] = row.position_m, row.velocity_m_s
    info.covariance_m2[of] = row.covariance_m2
    info.status[of] = int(Status.COASTING)
    if row.found is not None:
        info.status[of] = int(Status.TRACKED)
        info.measured_m[of], info.measured_covariance_m2[of] = row.found.position_m, row.found.covariance_m2
        info.num_cameras[of] = row.found.num_cameras
        info.fitness[of] = row.share
