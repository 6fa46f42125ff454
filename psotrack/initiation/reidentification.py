"""Re-identification: assign track candidates to lost drones, and plan where the tracker starts their tracks.

A candidate is a lost drone if time, motion and size agree, and else a new drone. A drone that stood still when it was
lost is most probably still there: it has landed, or the background model has learned it. When such a drone departs, its
place becomes foreground that does not move, a ghost. The candidate that departs from this place is the drone, even if
the drone's track follows the ghost by then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.initiation.new_tracks import TrackCandidate
from psotrack.initiation.ornstein_uhlenbeck import POSITION_STD_M, log_normal, log_transition

#: Value of an assignment: the candidate is a new drone.
NEW = -1
#: Value of an assignment: the candidate is no drone, or nothing shows that it is one.
NO_DRONE = -2

#: Standard deviation of a drone's velocity along each axis, as a share of the largest speed.
SPEED_SHARE = 1 / 3
#: Standard deviation of the logarithm of a measured span, and smallest and largest span of a drone.
SPAN_STD, SPANS_M = 0.2, (0.1, 1.5)
#: A drone that was slower than this when it was lost stood still. It stayed there with this probability, because a
#: drone that departs in front of the cameras would be foreground.
STILL_M_S, STAYED_PROBABILITY = 0.2, 0.99
#: Durations before the loss over which the speed is measured, seconds. A drone that the background model is learning
#: seems to creep, so it stood still if it was slow over one of them.
STILL_S = (1.0, 0.5)
#: A candidate stayed at a place, or departed from it, if it is nearer to the place than this number of spans, or was so
#: within the last `DEPARTURE_S` seconds.
STAYED_SPANS, DEPARTURE_S = 0.6, 0.6
#: Odds of a new drone against a lost drone that may be anywhere, and of no drone if the candidate does not move.
NEW_ODDS, NO_DRONE_ODDS = 0.1, 10.0
#: Two drones are at the same place if their distance, divided along each axis by this share of their mean size, is
#: below 1.
SAME_PLACE = 0.5
#: Longest time for which a lost drone may be tracked while the candidate is there, seconds; after a longer time they
#: are two drones, after a shorter time the track was failing.
MAX_OVERLAP_S = 0.4
#: A candidate is out of reach if it is farther than a drone can fly plus this number of standard deviations.
REACH_SIGMAS = 5.0

#: Log likelihoods of the assignment: out of reach; new drone while no new drone is allowed; impossible.
_UNREACHABLE, _NEW_NOT_ALLOWED, _IMPOSSIBLE = -1e6, -1e7, -1e9


@dataclass(frozen=True)
class LostTracks:
    """Drones that may be found again, in their last state before the end of a chunk.

    Attributes:
        drone: (lost,), index of the drone.
        position_m, velocity_m_s: (lost, 3), state when last seen; for a drone that stood still, its place and 0.
        seconds: (lost,), time from then to the chunk's first frame; negative if the drone was lost within the chunk.
        size_m: (lost, 3), full lengths along the world's axes.
        doubtful: (lost,), whether the drone is tracked again, but only at the place where it was lost, without moving
            since. This track may follow a ghost. Such a drone is only assigned to a candidate that departs from there.
        left_m: (places, 3), all places where drones stood still when they were lost. Ghosts may be at these places.
    """

    drone: Int[np.ndarray, "lost"]
    position_m: Float[np.ndarray, "lost 3"]
    velocity_m_s: Float[np.ndarray, "lost 3"]
    seconds: Float[np.ndarray, "lost"]
    size_m: Float[np.ndarray, "lost 3"]
    doubtful: Bool[np.ndarray, "lost"]
    left_m: Float[np.ndarray, "places 3"]


@dataclass(frozen=True)
class PlannedStarts:
    """Initial states of tracks that start in a chunk; new drones come after the known drones.

    Attributes:
        begin_frame: (drones,), frame of the chunk in which the track starts; -1 where a track continues.
        begin_position_m, begin_velocity_m_s: (drones, 3), state in this frame; 0 where a track continues.
        born_size_m: (born, 3), full lengths of the new drones.
    """

    begin_frame: Int[np.ndarray, "drones"]
    begin_position_m: Float[np.ndarray, "drones 3"]
    begin_velocity_m_s: Float[np.ndarray, "drones 3"]
    born_size_m: Float[np.ndarray, "born 3"]


def find_false_tracks(
    position_m: Float[np.ndarray, "frames drones 3"],
    tracked: Bool[np.ndarray, "frames drones"],
    size_m: Float[np.ndarray, "drones 3"],
) -> Bool[np.ndarray, "drones"]:
    """Find false tracks, which follow ghosts: tracks that never moved, at a place where a moving drone was.

    If a drone lands and stays for most of a video, the background model learns it. Before it lands and after it
    departs, its place is foreground that looks like a drone.

    Args:
        position_m: (frames, drones, 3), positions from the first frame of the video.
        tracked: (frames, drones), whether the drone was found, and not only predicted.
        size_m: (drones, 3), full lengths along the world's axes.
    """
    found_m = np.where(tracked[..., None], position_m, np.nan)
    never_moved, is_false = np.zeros((2, len(size_m)), bool)
    for drone in np.flatnonzero(tracked.any(axis=0)).tolist():
        never_moved[drone] = _stayed(found_m[tracked[:, drone], drone], size_m[drone])
    for drone in np.flatnonzero(never_moved).tolist():
        reach_m = SAME_PLACE * (size_m + size_m[drone]) / 2
        distance = np.linalg.norm((found_m - np.nanmedian(found_m[:, drone], axis=0)) / reach_m, axis=-1)
        is_false[drone] = bool((distance[:, ~never_moved] < 1).any())
    return is_false


def _stayed(position_m: Float[np.ndarray, "frames 3"], size_m: Float[np.ndarray, "3"]) -> bool:
    return float(np.linalg.norm(np.ptp(position_m, axis=0))) < STAYED_SPANS * float(size_m.max())


def find_lost_tracks(
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
    tracked: Bool[np.ndarray, "frames drones"],
    size_m: Float[np.ndarray, "drones 3"],
    *,
    chunk_frames: int,
    fps: float,
) -> LostTracks:
    """Find the drones that are lost at the end of a chunk and may be found again; false tracks are left out.

    Args:
        position_m, velocity_m_s: (frames, drones, 3), states from the video's first frame to the chunk's last.
        tracked: (frames, drones), whether the drone was found, and not only predicted.
        size_m: (drones, 3), full lengths along the world's axes.
        chunk_frames: number of frames of the chunk, which are the last of the frames.
        fps: frames per second.
    """
    drones, last, places, velocities, doubtful, left = [], [], [], [], [], []
    for drone in np.flatnonzero(
        tracked.any(axis=0) & ~find_false_tracks(position_m, tracked, size_m)
    ).tolist():
        seen = np.flatnonzero(tracked[:, drone])
        losses = seen[np.flatnonzero(np.diff(seen, append=len(tracked)) > 1)]
        if not len(losses):
            continue
        standing = [_standing_place(position_m[:, drone], seen[seen <= end], fps) for end in losses.tolist()]
        left += [place for place in standing if place is not None]
        stayed = _stayed(position_m[seen[seen >= losses[-1]], drone], size_m[drone])
        tracked_now = bool(tracked[-1, drone])
        if stayed or not tracked_now:
            drones.append(drone)
            last.append(losses[-1])
            places.append(position_m[losses[-1], drone] if standing[-1] is None else standing[-1])
            velocities.append(velocity_m_s[losses[-1], drone] if standing[-1] is None else np.zeros(3))
            doubtful.append(tracked_now)
    columns = np.array(drones, int)
    return LostTracks(
        drone=columns,
        position_m=np.array(places).reshape(-1, 3),
        velocity_m_s=np.array(velocities).reshape(-1, 3),
        seconds=(len(tracked) - chunk_frames - np.array(last, int)) / fps,
        size_m=size_m[columns],
        doubtful=np.array(doubtful, bool),
        left_m=np.array(left).reshape(-1, 3),
    )


def _standing_place(
    position_m: Float[np.ndarray, "frames 3"], seen: Int[np.ndarray, "seen"], fps: float
) -> Float[np.ndarray, "3"] | None:
    """Place of a drone that stood still when it was last seen; None if it moved."""
    for seconds in STILL_S:
        recent = seen[seen >= seen[-1] - seconds * fps]
        moved_m = float(np.linalg.norm(np.ptp(position_m[recent], axis=0)))
        if moved_m < STILL_M_S * np.ptp(recent) / fps:
            return np.median(position_m[recent], axis=0)
    return None


def reidentify(
    candidates: tuple[TrackCandidate, ...],
    lost: LostTracks,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
    max_births: int | None = None,
) -> Int[np.ndarray, "candidates"]:
    """Assign candidates to lost drones with the largest total likelihood.

    A drone's velocity is an Ornstein-Uhlenbeck process (see `ornstein_uhlenbeck`): after a short gap a drone is
    expected on its course, after a long gap anywhere within reach. A drone that stood still most probably stayed. The
    alternative is a new drone anywhere in the room.

    Args:
        candidates: candidates of a chunk.
        lost: drones that may be found again, from the same chunk.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room.
        max_speed_m_s: largest speed of a drone.
        max_births: largest number of new drones; None for any number. If it is 0, a candidate that moves is assigned to
            a lost drone even if that is unlikely.

    Returns:
        (candidates,), a row of `lost`, or `NEW`, or `NO_DRONE`. A candidate that does not move is never new; neither is
        a slow candidate at a place where a drone stood still.
    """
    count = len(lost.drone)
    log_volume = float(np.log(np.prod(bounds_m[1] - bounds_m[0])))
    is_ghost = [any(_departs_from(other, one) for other in candidates) for one in candidates]
    may_be_new = [
        one.moves and not ghost and not _is_dying_ghost(one, lost)
        for one, ghost in zip(candidates, is_ghost, strict=True)
    ]
    scores = np.full((len(candidates), count + len(candidates)), _IMPOSSIBLE)
    for row, candidate in enumerate(candidates):
        log_anywhere = log_normal(candidate.velocity_m_s, (SPEED_SHARE * max_speed_m_s) ** 2) - log_volume
        odds = NEW_ODDS if candidate.moves else NO_DRONE_ODDS
        log_new = log_anywhere + np.log(odds / np.log(SPANS_M[1] / SPANS_M[0]))
        scores[row, count + row] = _NEW_NOT_ALLOWED if candidate.moves and max_births == 0 else log_new
        for column in range(0 if is_ghost[row] else count):
            scores[row, column] = _log_likelihood(
                candidate, lost, column, fps, log_anywhere, max_speed_m_s, bounds_m
            )
    chosen = np.full(len(candidates), NO_DRONE)
    births = 0
    for row, column in zip(
        *(each.tolist() for each in linear_sum_assignment(scores, maximize=True)), strict=True
    ):
        if column < count:
            chosen[row] = column
        elif may_be_new[row] and (max_births is None or births < max_births):
            chosen[row] = NEW
            births += 1
    return chosen


def plan_starts(
    candidates: tuple[TrackCandidate, ...],
    assignment: Int[np.ndarray, "candidates"],
    lost: LostTracks,
    num_drones: int,
) -> PlannedStarts:
    """Plan where the tracker starts the tracks of a chunk's candidates.

    Args:
        candidates: candidates of the chunk.
        assignment: (candidates,), from `reidentify`.
        lost: the lost drones to which the assignment refers.
        num_drones: number of drones that the tracker has so far.
    """
    again, born = np.flatnonzero(assignment >= 0), np.flatnonzero(assignment == NEW)
    drones = np.concatenate([lost.drone[assignment[again]], num_drones + np.arange(len(born))])
    begin_frame = np.full(num_drones + len(born), -1)
    position, velocity = np.zeros((2, num_drones + len(born), 3))
    for drone, row in zip(drones.tolist(), [*again.tolist(), *born.tolist()], strict=True):
        begin_frame[drone] = candidates[row].frame
        position[drone], velocity[drone] = candidates[row].position_m, candidates[row].velocity_m_s
    sizes = np.array([candidates[row].size_m for row in born.tolist()]).reshape(-1, 3)
    return PlannedStarts(begin_frame, position, velocity, sizes)


def _log_likelihood(
    candidate: TrackCandidate,
    lost: LostTracks,
    row: int,
    fps: float,
    log_anywhere: float,
    max_speed_m_s: float,
    bounds_m: Float[np.ndarray, "2 3"],
) -> float:
    """Log likelihood of a lost drone being the candidate: a density over position, velocity and span."""
    place, velocity, span = lost.position_m[row], lost.velocity_m_s[row], float(lost.size_m[row].max())
    log_span = log_normal(np.log(candidate.size_m.max(keepdims=True) / span), SPAN_STD**2)
    variance = (SPEED_SHARE * max_speed_m_s) ** 2
    log_stayed = -np.inf
    near_m = STAYED_SPANS * span
    still = float(np.linalg.norm(velocity)) < STILL_M_S
    if still and _smallest_distance(candidate, place) < near_m:
        log_stayed = np.log(STAYED_PROBABILITY / (4 / 3 * np.pi * near_m**3))
        log_stayed += log_normal(candidate.velocity_m_s, variance)
    if lost.doubtful[row]:
        return log_stayed + log_span if candidate.moves and log_stayed > -np.inf else _IMPOSSIBLE
    gap_s = candidate.frame / fps + float(lost.seconds[row])
    if gap_s < -MAX_OVERLAP_S:
        return _IMPOSSIBLE
    gap_s = max(gap_s, 0.0)
    distance = float(np.linalg.norm(candidate.position_m - place))
    if distance > max_speed_m_s * gap_s + REACH_SIGMAS * POSITION_STD_M:
        return _UNREACHABLE - distance
    before = np.stack([place, velocity])
    after = np.stack([candidate.position_m, candidate.velocity_m_s])
    log_flown = max(log_transition(before, after, gap_s, variance, bounds_m), log_anywhere)
    log_flown += np.log(1 - STAYED_PROBABILITY) if still else 0.0
    return max(log_stayed, log_flown) + log_span


def _departs_from(candidate: TrackCandidate, ghost: TrackCandidate) -> bool:
    """Whether a candidate departs from another candidate that stands still, or creeps while the drone overlaps it."""
    near_m = STAYED_SPANS * float(ghost.size_m.max())
    speed, creep = (float(np.linalg.norm(one.velocity_m_s)) for one in (candidate, ghost))
    faster = candidate.moves and (not ghost.moves or creep < min(speed, STILL_M_S))
    return faster and _smallest_distance(candidate, ghost.position_m) < near_m


def _is_dying_ghost(candidate: TrackCandidate, lost: LostTracks) -> bool:
    """Whether a candidate is slow and at a place where a drone stood still, as a ghost that the background absorbs."""
    near_m = STAYED_SPANS * float(candidate.size_m.max())
    creeps = float(np.linalg.norm(candidate.velocity_m_s)) < STILL_M_S
    return creeps and bool((np.linalg.norm(lost.left_m - candidate.position_m, axis=-1) < near_m).any())


def _smallest_distance(candidate: TrackCandidate, place_m: Float[np.ndarray, "3"]) -> float:
    """Smallest distance of a candidate from a place, when it was first seen or within `DEPARTURE_S` before."""
    speed2 = float(candidate.velocity_m_s @ candidate.velocity_m_s)
    offset = candidate.position_m - place_m
    ago_s = np.clip(offset @ candidate.velocity_m_s / max(speed2, 1e-9), 0.0, DEPARTURE_S)
    return float(np.linalg.norm(offset - ago_s * candidate.velocity_m_s))
