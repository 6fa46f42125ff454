"""Drones that are lost and come back: who a newcomer is, and where the tracker begins it.

A newcomer is one of the lost drones where time, motion and size allow it, and else is born. A drone that stood still
when it vanished is most probably still there: it has landed, or the background model has swallowed it. When such a
drone flies off, the place where it stood becomes foreground, a hole in the background that does not move; what flew off
from there is the drone, even if the hole is taken for it by then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.initiation.new_tracks import TrackCandidate
from psotrack.initiation.ornstein_uhlenbeck import POSITION_STD_M, log_normal, log_wandered

#: In an assignment: a drone that was not there before.
NEW = -1
#: In an assignment: no drone, as far as one can tell.
NOBODY = -2

#: The standard deviation of a drone's velocity along each axis, as a share of its largest speed.
SPEED_SHARE = 1 / 3
#: How well spans are measured (of their logarithm), and what spans there are.
SPAN_STD, SPANS_M = 0.2, (0.1, 1.5)
#: A drone that was slower when it vanished stood still, and as likely as this it stays until it is seen to fly off: it
#: vanished in front of the cameras, and flown off it would be foreground.
STILL_M_S, STAYED_PROBABILITY = 0.2, 0.99
#: Its speed is that over its last so many seconds, or so many: half swallowed, it seems to creep away.
STILL_S = (1.0, 0.5)
#: What was so many spans from there, or had been within the last seconds, stayed or flew off from there.
STAYED_SPANS, FLOWN_OFF_S = 0.6, 0.6
#: How much likelier a newcomer is a new drone than one that may be anywhere by now; if it does not move, no drone.
NEW_ODDS, NO_DRONE_ODDS = 0.1, 10.0
#: Two drones whose middles are nearer than so much of their size, along every axis, are in the same place.
SAME_PLACE = 0.5
#: A drone that was tracked for so long while the newcomer was there is another one; less, and its track was failing.
MAX_OVERLAP_S = 0.4
#: Beyond reach is farther than a drone can fly, and so many standard deviations of the place.
REACH_SIGMAS = 5.0

#: Logarithms for an assignment: beyond reach, less than that, ruled out.
_UNREACHABLE, _UNKNOWN_BUT_PINNED, _NEVER = -1e6, -1e7, -1e9


@dataclass(frozen=True)
class LostTracks:
    """Drones that may come back, as they were when last seen before the end of a chunk.

    Attributes:
        drone: (lost,), which of all drones.
        position_m, velocity_m_s: (lost, 3), when last seen; of a drone that stood still, where it stood, and 0.
        seconds: (lost,), from then to the first frame of the chunk; below 0 if that was within the chunk.
        size_m: (lost, 3), full lengths along the world's axes.
        doubtful: (lost,), whether it is tracked again, but only where it had vanished, and has not moved since: that
            may be the hole that it left. Such a drone comes back only as what flew off from there.
        left_m: (places, 3), where any drone ever stood when it vanished: where it is no more there may be a hole.
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
    """Where in a chunk the tracker begins drones; those that are born come after the known ones.

    Attributes:
        begin_frame: (drones,), of the chunk; -1 where a drone goes on as it was.
        begin_position_m, begin_velocity_m_s: (drones, 3), in that frame; 0 where a drone goes on.
        born_size_m: (born, 3), full lengths of those that are born.
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
    """Tracks that are of no drone: they never moved, and a drone that did was where they stand.

    A drone that lands and stays for most of a video is background from the first frame on: until it lands, and when it
    has taken off, its place is foreground that looks like a drone.

    Args:
        position_m: (frames, drones, 3), from the first frame of the video.
        tracked: (frames, drones), whether a drone was found, not only predicted.
        size_m: (drones, 3), full lengths along the world's axes.
    """
    found_m = np.where(tracked[..., None], position_m, np.nan)
    never_moved, taken = np.zeros((2, len(size_m)), bool)
    for drone in np.flatnonzero(tracked.any(axis=0)).tolist():
        never_moved[drone] = _within_its_place(found_m[tracked[:, drone], drone], size_m[drone])
    for drone in np.flatnonzero(never_moved).tolist():
        reach_m = SAME_PLACE * (size_m + size_m[drone]) / 2
        apart = np.linalg.norm((found_m - np.nanmedian(found_m[:, drone], axis=0)) / reach_m, axis=-1)
        taken[drone] = bool((apart[:, ~never_moved] < 1).any())
    return taken


def _within_its_place(position_m: Float[np.ndarray, "frames 3"], size_m: Float[np.ndarray, "3"]) -> bool:
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
    """The drones that may come back at the end of a chunk. Holes do not.

    Args:
        position_m, velocity_m_s: (frames, drones, 3), from the first frame of the video to the last of the chunk.
        tracked: (frames, drones), whether a drone was found, not only predicted.
        size_m: (drones, 3), full lengths along the world's axes.
        chunk_frames: so many of the frames are the chunk's.
        fps: frames per second.
    """
    drones, last, places, velocities, doubtful, left = [], [], [], [], [], []
    for drone in np.flatnonzero(
        tracked.any(axis=0) & ~find_false_tracks(position_m, tracked, size_m)
    ).tolist():
        seen = np.flatnonzero(tracked[:, drone])
        vanished = seen[np.flatnonzero(np.diff(seen, append=len(tracked)) > 1)]
        if not len(vanished):
            continue
        stood = [_stood(position_m[:, drone], seen[seen <= end], fps) for end in vanished.tolist()]
        left += [place for place in stood if place is not None]
        still = _within_its_place(position_m[seen[seen >= vanished[-1]], drone], size_m[drone])
        there_now = bool(tracked[-1, drone])
        if still or not there_now:
            drones.append(drone)
            last.append(vanished[-1])
            places.append(position_m[vanished[-1], drone] if stood[-1] is None else stood[-1])
            velocities.append(velocity_m_s[vanished[-1], drone] if stood[-1] is None else np.zeros(3))
            doubtful.append(there_now)
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


def _stood(
    position_m: Float[np.ndarray, "frames 3"], seen: Int[np.ndarray, "seen"], fps: float
) -> Float[np.ndarray, "3"] | None:
    """Where a drone stood when it was last seen; None if it moved."""
    for seconds in STILL_S:
        recent = seen[seen >= seen[-1] - seconds * fps]
        moved_m = float(np.linalg.norm(np.ptp(position_m[recent], axis=0)))
        if moved_m < STILL_M_S * np.ptp(recent) / fps:
            return np.median(position_m[recent], axis=0)
    return None


def reidentify(
    newcomers: tuple[TrackCandidate, ...],
    lost: LostTracks,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
    max_births: int | None = None,
) -> Int[np.ndarray, "newcomers"]:
    """Which newcomer is which lost drone: the assignment of the largest likelihood.

    A drone's velocity wanders (see `wandering`): over a short gap it is expected where it was heading, over a long one
    anywhere within reach. If it stood, it most probably stayed there. The alternative is a drone that nobody knows,
    anywhere in the room.

    Args:
        newcomers: of a chunk.
        lost: drones that may come back, seen from the same chunk.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room.
        max_speed_m_s: of a drone.
        max_births: so many drones may be new; None is any number. If it is 0, a newcomer that moves is a lost drone
            even where that is unlikely.

    Returns:
        (newcomers,), a row of `lost`, or `NEW`, or `NOBODY`. What does not move is never new; nor is what hardly does
        where a drone has stood.
    """
    count = len(lost.drone)
    log_volume = float(np.log(np.prod(bounds_m[1] - bounds_m[0])))
    holes = [any(_flew_off(other, one) for other in newcomers) for one in newcomers]
    new = [
        one.moves and not hole and not _left(one, lost) for one, hole in zip(newcomers, holes, strict=True)
    ]
    scores = np.full((len(newcomers), count + len(newcomers)), _NEVER)
    for row, newcomer in enumerate(newcomers):
        log_anywhere = log_normal(newcomer.velocity_m_s, (SPEED_SHARE * max_speed_m_s) ** 2) - log_volume
        odds = NEW_ODDS if newcomer.moves else NO_DRONE_ODDS
        unknown = log_anywhere + np.log(odds / np.log(SPANS_M[1] / SPANS_M[0]))
        scores[row, count + row] = _UNKNOWN_BUT_PINNED if newcomer.moves and max_births == 0 else unknown
        for column in range(0 if holes[row] else count):
            scores[row, column] = _log_likelihood(
                newcomer, lost, column, fps, log_anywhere, max_speed_m_s, bounds_m
            )
    chosen = np.full(len(newcomers), NOBODY)
    births = 0
    for row, column in zip(
        *(each.tolist() for each in linear_sum_assignment(scores, maximize=True)), strict=True
    ):
        if column < count:
            chosen[row] = column
        elif new[row] and (max_births is None or births < max_births):
            chosen[row] = NEW
            births += 1
    return chosen


def plan_starts(
    newcomers: tuple[TrackCandidate, ...],
    assignment: Int[np.ndarray, "newcomers"],
    lost: LostTracks,
    num_drones: int,
) -> PlannedStarts:
    """Where the tracker begins the newcomers of a chunk.

    Args:
        newcomers: of the chunk.
        assignment: (newcomers,), from `reidentify`.
        lost: what it refers to.
        num_drones: that the tracker has so far.
    """
    again, born = np.flatnonzero(assignment >= 0), np.flatnonzero(assignment == NEW)
    drones = np.concatenate([lost.drone[assignment[again]], num_drones + np.arange(len(born))])
    begin_frame = np.full(num_drones + len(born), -1)
    position, velocity = np.zeros((2, num_drones + len(born), 3))
    for drone, row in zip(drones.tolist(), [*again.tolist(), *born.tolist()], strict=True):
        begin_frame[drone] = newcomers[row].frame
        position[drone], velocity[drone] = newcomers[row].position_m, newcomers[row].velocity_m_s
    sizes = np.array([newcomers[row].size_m for row in born.tolist()]).reshape(-1, 3)
    return PlannedStarts(begin_frame, position, velocity, sizes)


def _log_likelihood(
    newcomer: TrackCandidate,
    lost: LostTracks,
    row: int,
    fps: float,
    log_anywhere: float,
    max_speed_m_s: float,
    bounds_m: Float[np.ndarray, "2 3"],
) -> float:
    """Logarithm of how likely a lost drone is seen again as the newcomer: a density over place, velocity and span."""
    place, velocity, span = lost.position_m[row], lost.velocity_m_s[row], float(lost.size_m[row].max())
    log_span = log_normal(np.log(newcomer.size_m.max(keepdims=True) / span), SPAN_STD**2)
    variance = (SPEED_SHARE * max_speed_m_s) ** 2
    log_stayed = -np.inf
    near_m = STAYED_SPANS * span
    still = float(np.linalg.norm(velocity)) < STILL_M_S
    if still and _distance_on_the_way(newcomer, place) < near_m:
        log_stayed = np.log(STAYED_PROBABILITY / (4 / 3 * np.pi * near_m**3))
        log_stayed += log_normal(newcomer.velocity_m_s, variance)
    if lost.doubtful[row]:
        return log_stayed + log_span if newcomer.moves and log_stayed > -np.inf else _NEVER
    gap_s = newcomer.frame / fps + float(lost.seconds[row])
    if gap_s < -MAX_OVERLAP_S:
        return _NEVER
    gap_s = max(gap_s, 0.0)
    distance = float(np.linalg.norm(newcomer.position_m - place))
    if distance > max_speed_m_s * gap_s + REACH_SIGMAS * POSITION_STD_M:
        return _UNREACHABLE - distance
    was, seen = np.stack([place, velocity]), np.stack([newcomer.position_m, newcomer.velocity_m_s])
    log_flown = max(log_wandered(was, seen, gap_s, variance, bounds_m), log_anywhere)
    log_flown += np.log(1 - STAYED_PROBABILITY) if still else 0.0
    return max(log_stayed, log_flown) + log_span


def _flew_off(newcomer: TrackCandidate, hole: TrackCandidate) -> bool:
    """Whether a newcomer flew off from the place of one that does not move; or hardly, while the drone is over it."""
    near_m = STAYED_SPANS * float(hole.size_m.max())
    speed, creep = (float(np.linalg.norm(one.velocity_m_s)) for one in (newcomer, hole))
    faster = newcomer.moves and (not hole.moves or creep < min(speed, STILL_M_S))
    return faster and _distance_on_the_way(newcomer, hole.position_m) < near_m


def _left(newcomer: TrackCandidate, lost: LostTracks) -> bool:
    """Whether a newcomer is where a drone stood when it vanished, and seems to creep at most, as dying holes do."""
    near_m = STAYED_SPANS * float(newcomer.size_m.max())
    creeps = float(np.linalg.norm(newcomer.velocity_m_s)) < STILL_M_S
    return creeps and bool((np.linalg.norm(lost.left_m - newcomer.position_m, axis=-1) < near_m).any())


def _distance_on_the_way(newcomer: TrackCandidate, place_m: Float[np.ndarray, "3"]) -> float:
    """How near it was to a place when it was first seen, or on a straight way to there."""
    speed2 = float(newcomer.velocity_m_s @ newcomer.velocity_m_s)
    off = newcomer.position_m - place_m
    ago_s = np.clip(off @ newcomer.velocity_m_s / max(speed2, 1e-9), 0.0, FLOWN_OFF_S)
    return float(np.linalg.norm(off - ago_s * newcomer.velocity_m_s))
