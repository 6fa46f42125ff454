"""Assignment of outside tracks to the drones that carry cameras.

Names of tracks are arbitrary, two tracks that met may have exchanged their drones, and a track may end and go on under
another name, while a camera stays on its drone. Tracks are therefore assigned by the distances in a window of frames,
and then reordered, so that each drone has one track for the whole recording.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter1d
from scipy.optimize import linear_sum_assignment

from psotrack.inside_out.fusing.sources import nearest_index
from psotrack.trajectories import GATE_M, UNASSIGNED

#: Number of frames whose distances decide together which track is a drone's.
_WINDOW = 11
#: Least mean gain in a window, 1 for a distance of 0: less is rounding.
_LEAST_GAIN = 1e-9


def pair_tracks(
    camera_m: Float[np.ndarray, "frames paths 3"],
    middle_m: Float[np.ndarray, "frames tracks 3"],
) -> Int[np.ndarray, "frames paths"]:
    """Assign tracks to paths: (frames, paths), the index of the track of each path's drone, or `UNASSIGNED`.

    A path gets no track if its track is more than half a metre away in most frames that have both.

    Args:
        camera_m: (frames, paths, 3), positions of the paths' cameras; NaN where unknown.
        middle_m: (frames, tracks, 3), positions of the tracks; NaN where a track has none.
    """
    distance_m = np.linalg.norm(camera_m[:, :, None] - middle_m[:, None], axis=-1)
    gain = np.nan_to_num(1 - np.minimum(distance_m / GATE_M, 1) ** 2)
    gain = uniform_filter1d(gain, _WINDOW, axis=0, mode="constant")
    near = np.full(camera_m.shape[:2], UNASSIGNED)
    for row in np.flatnonzero((gain > _LEAST_GAIN).any(axis=(1, 2))):
        paths, tracks = linear_sum_assignment(gain[row], maximize=True)
        near[row, paths] = np.where(gain[row, paths, tracks] > _LEAST_GAIN, tracks, UNASSIGNED)
    frames, found = np.arange(len(near)), near.copy()
    for path in np.flatnonzero((near != UNASSIGNED).any(axis=0)):
        # Where no distance tells, the drone keeps its track, unless another drone has this track.
        rows = np.flatnonzero(near[:, path] != UNASSIGNED)
        own = near[rows[nearest_index(rows, frames)], path]
        is_free = (np.delete(near, path, axis=1) != own[:, None]).all(axis=1)
        both_m = distance_m[frames, path, own]
        both_m = both_m[np.isfinite(both_m)]
        of_drone = np.mean(both_m <= GATE_M) > 0.5
        found[:, path] = np.where(is_free & of_drone, own, UNASSIGNED)
    return found


def reorder_tracks(
    pairing: Int[np.ndarray, "frames paths"], num_tracks: int
) -> tuple[Int[np.ndarray, "frames tracks"], dict[int, int]]:
    """Undo exchanges of tracks.

    Returns:
        (frames, tracks), the index of the track that is in each column; and for each path with a track the column that
        has its track in all frames. Another drone keeps its column when a path takes its track and leaves it its own.
    """
    order = np.tile(np.arange(num_tracks), (len(pairing), 1))
    column: dict[int, int] = {}
    changed = np.diff(pairing, axis=0, prepend=UNASSIGNED) != 0
    for row, path in np.argwhere(changed & (pairing != UNASSIGNED)).tolist():
        now = int(np.flatnonzero(order[row] == pairing[row, path])[0])
        own = column.setdefault(path, now)
        order[row:, [own, now]] = order[row:, [now, own]]
    return order, column
