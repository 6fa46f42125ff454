"""Assignment of outside tracks to the drones that carry cameras, by distance, piece by piece.

Names of tracks are arbitrary, and two tracks that met may have swapped identities, while a camera stays on its drone.
Each path is therefore assigned the sequence of tracks with the least cost: a frame costs the squared distance up to a
limit, and a change of tracks costs as much as several frames that are all wrong (A. Viterbi, Error bounds for
convolutional codes, IEEE Transactions on Information Theory 13 (2), 1967).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.trajectories import GATE_M, UNASSIGNED

#: Cost of a frame without the track, as a share of the cost of a frame in which the track is elsewhere.
_MISSING = 0.25
#: Cost of a change of tracks, in frames in which the track is elsewhere.
_CHANGE_FRAMES = 5.0


@dataclass(frozen=True)
class TrackChange:
    """A frame from which on another track belongs to a drone.

    Attributes:
        drone: index of the camera's path.
        frame: number of the first frame.
        before, after: indices of the tracks.
    """

    drone: int
    frame: int
    before: int
    after: int


@dataclass(frozen=True)
class Pairing:
    """Assignment of tracks to paths.

    Attributes:
        track: (frames, paths), index of the track of each path's drone, or `UNASSIGNED`.
        rest: (frames, tracks); column k is for the drone without a camera that is named like track k: the index of its
            track in each frame, or `UNASSIGNED`.
        changes: changes of tracks, in the order of frames.
    """

    track: Int[np.ndarray, "frames paths"]
    rest: Int[np.ndarray, "frames tracks"]
    changes: tuple[TrackChange, ...]


def pair_tracks(
    frame: Int[np.ndarray, "frames"],
    expected_m: Float[np.ndarray, "frames paths 3"],
    reach_m: Float[np.ndarray, "paths"],
    middle_m: Float[np.ndarray, "frames tracks 3"],
) -> Pairing:
    """Assign tracks to paths.

    A path gets no track if its best track is more than half a metre away in most frames that have both.

    Args:
        frame: (frames,), numbers.
        expected_m: (frames, paths, 3), expected position of the middle of each path's drone; NaN where unknown.
        reach_m: (paths,), distance from the expected position beyond which a track counts as elsewhere, metres.
        middle_m: (frames, tracks, 3), positions of the tracks; NaN where a track has none.
    """
    num_frames, num_paths, num_tracks = len(frame), expected_m.shape[1], middle_m.shape[1]
    distance_m = np.linalg.norm(expected_m[:, :, None] - middle_m[:, None], axis=-1)
    track = np.full((num_frames, num_paths), UNASSIGNED)
    for path in range(num_paths if num_tracks else 0):
        there = np.isfinite(distance_m[:, path])
        cost = np.minimum((distance_m[:, path] / reach_m[path]) ** 2, 1.0)
        cost = np.where(there, cost, _MISSING)
        cost[~there.any(axis=1)] = 0.0
        best = _cheapest_sequence(cost, _CHANGE_FRAMES)
        to_best_m = distance_m[np.arange(num_frames), path, best]
        both = np.isfinite(to_best_m)
        if both.any() and np.mean(to_best_m[both] <= GATE_M) > 0.5:
            track[:, path] = best
    _release_shared(track, distance_m)
    return Pairing(track, _remaining_tracks(track, num_tracks), _find_changes(frame, track))


def _cheapest_sequence(cost: Float[np.ndarray, "frames states"], change: float) -> Int[np.ndarray, "frames"]:
    """(frames,), the sequence of states with the least sum of costs and changes (Viterbi)."""
    total = np.zeros(cost.shape[1])
    came_from = np.empty(cost.shape, int)
    for here, origin in zip(cost, came_from, strict=True):
        best = int(np.argmin(total))
        stayed = total <= total[best] + change
        origin[:] = np.where(stayed, np.arange(len(total)), best)
        total = np.where(stayed, total, total[best] + change) + here
    states = np.empty(len(cost), int)
    state = int(np.argmin(total))
    for k in range(len(cost) - 1, -1, -1):
        states[k] = state
        state = came_from[k, state]
    return states


def _release_shared(
    track: Int[np.ndarray, "frames paths"], distance_m: Float[np.ndarray, "frames paths tracks"]
) -> None:
    """In place: of two paths with the same track, only the nearer one keeps it; an unknown position is not near."""
    if not distance_m.size:
        return
    own_m = np.take_along_axis(distance_m, np.maximum(track, 0)[..., None], axis=2)[..., 0]
    own_m = np.where(np.isfinite(own_m), own_m, np.inf)
    original = track.copy()
    for path in range(track.shape[1]):
        for other in range(path):
            shared = (original[:, path] == original[:, other]) & (original[:, path] != UNASSIGNED)
            first = own_m[:, path] < own_m[:, other]
            track[shared & first, other] = UNASSIGNED
            track[shared & ~first, path] = UNASSIGNED


def _find_changes(
    frame: Int[np.ndarray, "frames"], track: Int[np.ndarray, "frames paths"]
) -> tuple[TrackChange, ...]:
    found = []
    for path in range(track.shape[1]):
        rows = np.flatnonzero(track[:, path] != UNASSIGNED)
        before, after = track[rows[:-1], path], track[rows[1:], path]
        found += [
            TrackChange(path, int(frame[rows[row + 1]]), int(before[row]), int(after[row]))
            for row in np.flatnonzero(before != after)
        ]
    return tuple(sorted(found, key=lambda change: (change.frame, change.drone)))


def _remaining_tracks(
    track: Int[np.ndarray, "frames paths"], num_tracks: int
) -> Int[np.ndarray, "frames tracks"]:
    """Tracks of drones without a camera.

    A path that takes the track of such a drone leaves its former track to this drone.
    """
    held = np.arange(num_tracks)
    current = np.full(track.shape[1], UNASSIGNED)
    rest = np.empty((len(track), num_tracks), int)
    for row, now in enumerate(track):
        for path in np.flatnonzero((now != current) & (now != UNASSIGNED)):
            held = np.where(
                held == now[path], current[path] if current[path] not in now else UNASSIGNED, held
            )
            current[path] = now[path]
        rest[row] = held
    return rest
