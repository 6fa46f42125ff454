"""From the rows of single tracks to the arrays that all methods yield."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.projection_lines.tracks import Track, TrackRow
from psotrack.trajectories import Arrival, DroneSizes, Status, Tracks


def as_tracks(tracks: list[Track], num_frames: int, max_coasting_std_m: float) -> Tracks:
    """All tracks of drones in arrays; several tracks may be of one drone.

    Sizes are the sizes of the boxes. Their standard errors are unknown: NaN. Positions of drones that are not found
    are left out where they are too uncertain (`StatusSettings.max_coasting_std_m`).
    """
    num_drones = len({track.drone for track in tracks})
    shape = (num_frames, num_drones)
    size_m: dict[int, Float[np.ndarray, "3"]] = {}
    arrivals: list[Arrival] = []
    by_start = sorted(tracks, key=lambda track: track.rows[0].frame)
    for track in by_start:
        if track.rows[0].frame > 0:
            arrivals.append(Arrival(track.rows[0].frame, track.drone, again=track.drone in size_m))
        size_m[track.drone] = track.size_m
    sizes_m = np.array([size_m[drone] for drone in range(num_drones)], np.float32).reshape(-1, 3)
    arrays = Tracks(
        position_m=np.full((*shape, 3), np.nan),
        velocity_m_s=np.full((*shape, 3), np.nan),
        covariance_m2=np.full((*shape, 3, 3), np.nan),
        measured_m=np.full((*shape, 3), np.nan),
        measured_covariance_m2=np.full((*shape, 3, 3), np.nan),
        fitness=np.zeros(shape),
        num_cameras=np.zeros(shape, int),
        status=np.full(shape, int(Status.LOST)),
        measured_size_m=np.full((*shape, 3), np.nan),
        sizes=DroneSizes(
            size_m=sizes_m,
            std_m=np.full_like(sizes_m, np.nan),
            num_frames=np.zeros(sizes_m.shape, int),
            fill=np.empty((num_drones, 0)),
        ),
        arrivals=tuple(arrivals),
    )
    for track in by_start:
        for row in track.rows:
            if row.is_vague(max_coasting_std_m):
                continue
            _write(arrays, row, (row.frame, track.drone))
    return arrays


def _write(tracks: Tracks, row: TrackRow, at: tuple[int, int]) -> None:
    """Write a row into the arrays, at frame and drone."""
    tracks.position_m[at], tracks.velocity_m_s[at] = row.position_m, row.velocity_m_s
    tracks.covariance_m2[at] = row.covariance_m2
    tracks.status[at] = int(Status.COASTING)
    if row.measured is not None:
        tracks.status[at] = int(Status.TRACKED)
        tracks.measured_m[at] = row.measured.position_m
        tracks.measured_covariance_m2[at] = row.measured.covariance_m2
        tracks.num_cameras[at] = row.measured.num_cameras
        tracks.fitness[at] = row.share
