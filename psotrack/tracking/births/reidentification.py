"""Re-identification: assign track candidates to lost drones.

A candidate is a lost drone if time, motion and size agree better than with a new drone: where new drones come often, a
track soon ends, because its prediction tells the drone from none of the next ones. A drone that stood still when it was
lost, or that was at the floor, is most probably still there: it has landed, or the background model has learned it.
When such a drone departs, its place becomes foreground that does not move, a ghost. The candidate that departs from
this place is the drone, even if the drone's track follows the ghost by then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp

from psotrack.tracking.births.births import (
    RETURNED_FOUND,
    SPANS_M,
    SPEED_SHARE,
    WINDOW_FRAMES,
    FlightLimits,
    TrackCandidate,
)

#: Value of an assignment: the candidate is a new drone.
NEW = -1
#: Value of an assignment: the candidate is no drone, or nothing shows that it is one.
NO_DRONE = -2

#: Standard deviation of the logarithm of a measured span.
SPAN_STD = 0.2
#: A drone that was slower than this when it was lost stood still. It stayed there with this probability, because a
#: drone that departs in front of the cameras would be foreground.
STILL_M_S, STAYED_PROBABILITY = 0.2, 0.99
#: Durations before the loss over which the speed is measured, seconds. A drone that the background model is learning
#: seems to creep, so it stood still if it was slow over one of them.
STILL_S = (1.0, 0.5)
#: A candidate stayed at a place, or departed from it, if it is nearer to the place than this number of spans, or was so
#: within the last `DEPARTURE_S` seconds.
STAYED_SPANS, DEPARTURE_S = 0.6, 0.6
#: Probability that a drone stops or turns at once while it is out of sight, with any velocity then.
TURNED_PROBABILITY = 0.4
#: Odds of a new drone against a lost drone where no new ones come, and of no drone if the candidate does not move. A
#: candidate that is not sure waits for the frames that make it so, unless a lost drone is clearly more probable.
NEW_ODDS, UNSURE_ODDS, NO_DRONE_ODDS = 0.1, 3.0, 10.0
#: Number of drones that are taken to have come before the first one did: Jeffreys' prior of a rate.
CAME_BEFORE = 0.5
#: New drones come where drones were found, and as far about it as a drone flies in this time: a few flights do not show
#: all of the region.
AROUND_S = 0.5
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
    """Drones that may be found again, in their last state.

    Attributes:
        drone: (lost,), index of the drone.
        position_m, velocity_m_s: (lost, 3), state when last seen; for a drone that stood still, its place and 0.
        instant: (lost,), the instant when last seen.
        size_m: (lost, 3), full lengths along the world's axes; NaN where they are not known.
        doubtful: (lost,), whether the drone is tracked again, but only at the place where it was lost, without moving
            since. This track may follow a ghost. Such a drone is only assigned to a candidate that departs from there.
        left_m: (places, 3), all places where drones stood still when they were lost. Ghosts may be at these places.
        region_m: (2, 3), corners of the box about all places where drones were found, metres.
        new_per_s: rate at which new drones come, as the frames so far show, 1/s; 0 where the drones are counted.
    """

    drone: Int[np.ndarray, "lost"]
    position_m: Float[np.ndarray, "lost 3"]
    velocity_m_s: Float[np.ndarray, "lost 3"]
    instant: Int[np.ndarray, "lost"]
    size_m: Float[np.ndarray, "lost 3"]
    doubtful: Bool[np.ndarray, "lost"]
    left_m: Float[np.ndarray, "places 3"]
    region_m: Float[np.ndarray, "2 3"]
    new_per_s: float


def find_false_tracks(
    position_m: Float[np.ndarray, "frames drones 3"],
    tracked: Bool[np.ndarray, "frames drones"],
    size_m: Float[np.ndarray, "drones 3"],
) -> Bool[np.ndarray, "drones"]:
    """Find false tracks, which follow ghosts: tracks that never moved, at a place where a moving drone was.

    If a drone lands and stays for most of a video, the background model learns it. Before it lands and after it
    departs, its place is foreground that looks like a drone. A drone whose first position is given, and that was found
    in few frames, is not false: few frames show no standing.

    Args:
        position_m: (frames, drones, 3), positions from the first frame of the video.
        tracked: (frames, drones), whether the drone was found, and not only predicted.
        size_m: (drones, 3), full lengths along the world's axes.
    """
    found_m = np.where(tracked[..., None], position_m, np.nan)
    never_moved, is_false = np.zeros((2, len(size_m)), bool)
    for drone in np.flatnonzero(tracked.sum(axis=0) >= RETURNED_FOUND).tolist():
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
    instant: Int[np.ndarray, "frames"],
    fps: float,
    *,
    counted: bool = False,
) -> LostTracks:
    """Find the drones that are lost in the last frame, or were, and may be found again; false tracks are left out.

    A drone whose first position is given, and that no frame has shown, was last seen at this position.

    Args:
        position_m, velocity_m_s: (frames, drones, 3), states in all frames so far.
        tracked: (frames, drones), whether the drone was found, and not only predicted.
        size_m: (drones, 3), full lengths along the world's axes.
        instant: (frames,), the frames' instants.
        fps: instants per second.
        counted: whether it is known how many drones there are, so that what appears is one of them.
    """
    drones, last, places, velocities, doubtful, left = [], [], [], [], [], []
    is_there = np.isfinite(position_m).all(axis=-1)
    is_false = find_false_tracks(position_m, tracked, size_m)
    for drone in np.flatnonzero(is_there.any(axis=0) & ~is_false).tolist():
        seen = np.flatnonzero(tracked[:, drone])
        if not len(seen):
            seen = np.flatnonzero(is_there[:, drone])[:1]
        losses = seen[np.flatnonzero(np.diff(seen, append=len(tracked)) > 1)]
        if not len(losses):
            continue
        standing = [
            _standing_place(position_m[:, drone], seen[seen <= end], instant / fps) for end in losses.tolist()
        ]
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
    found = tracked & ~is_false
    # Drones that are found at the beginning did not come: they were there.
    came = found.any(axis=0) & ~found[:WINDOW_FRAMES].any(axis=0)
    elapsed_s = (instant[-1] - instant[0] + 1) / fps
    return LostTracks(
        drone=columns,
        position_m=np.array(places).reshape(-1, 3),
        velocity_m_s=np.array(velocities).reshape(-1, 3),
        instant=instant[np.array(last, int)],
        size_m=size_m[columns],
        doubtful=np.array(doubtful, bool),
        left_m=np.array(left).reshape(-1, 3),
        region_m=_box_m(position_m[found]),
        new_per_s=0.0 if counted else float((came.sum() + CAME_BEFORE) / elapsed_s),
    )


def _box_m(places_m: Float[np.ndarray, "places 3"]) -> Float[np.ndarray, "2 3"]:
    """Corners of the box about some places; inside out where there are none."""
    return np.stack([places_m.min(axis=0, initial=np.inf), places_m.max(axis=0, initial=-np.inf)])


def _standing_place(
    position_m: Float[np.ndarray, "frames 3"],
    seen: Int[np.ndarray, "seen"],
    time_s: Float[np.ndarray, "frames"],
) -> Float[np.ndarray, "3"] | None:
    """Place of a drone that stood still when it was last seen; None if it moved."""
    for seconds in STILL_S:
        recent = seen[time_s[seen] >= time_s[seen[-1]] - seconds]
        moved_m = float(np.linalg.norm(np.ptp(position_m[recent], axis=0)))
        if moved_m < STILL_M_S * np.ptp(time_s[recent]):
            return np.median(position_m[recent], axis=0)
    return None


def reidentify(
    candidates: tuple[TrackCandidate, ...],
    lost: LostTracks,
    limits: FlightLimits,
    *,
    max_births: int | None = None,
) -> Int[np.ndarray, "candidates"]:
    """Assign candidates to lost drones with the largest total likelihood.

    A drone's velocity is an Ornstein-Uhlenbeck process (see `log_transition`): after a short gap a drone is
    expected on its course, after a long gap anywhere within reach. A drone that stood still most probably stayed. The
    alternative is a new drone anywhere in the region where drones are found, of any usual size or as large as those
    that were lost. The odds against a lost drone are `NEW_ODDS` and the number of new drones that come within its gap.
    Of several lost drones each is the one that comes back with the same probability.

    Args:
        candidates: the candidates.
        lost: drones that may be found again.
        limits: where and how fast drones may fly.
        max_births: largest number of new drones; None for any number. If it is 0, a candidate that moves is assigned to
            a lost drone even if that is unlikely.

    Returns:
        (candidates,), a row of `lost`, or `NEW`, or `NO_DRONE`. Never new are a candidate that is not sure, one that
        does not move, and a slow one at a place where a drone stood still.
    """
    count = len(lost.drone)
    places_m = np.concatenate([lost.region_m, *(one.position_m[None] for one in candidates)])
    around_m = AROUND_S * SPEED_SHARE * limits.max_speed_m_s * np.array([[-1.0], [1.0]])
    low_m, high_m = np.clip(_box_m(places_m) + around_m, *limits.bounds_m)
    log_volume = float(np.log(np.prod(high_m - low_m)))
    is_ghost = [any(_departs_from(other, one) for other in candidates) for one in candidates]
    is_dying = [_is_dying_ghost(one, lost, limits.fps) for one in candidates]
    may_be_new = [
        one.moves and one.is_sure and not ghost and not dying
        for one, ghost, dying in zip(candidates, is_ghost, is_dying, strict=True)
    ]
    scores = np.full((len(candidates), count + len(candidates)), _IMPOSSIBLE)
    for row, candidate in enumerate(candidates):
        log_new = _log_velocity(candidate.velocity_m_s, limits) - log_volume
        odds = NEW_ODDS if candidate.is_sure or not lost.new_per_s else UNSURE_ODDS
        log_new += _log_span_of_new(candidate, lost) + np.log(odds if candidate.moves else NO_DRONE_ODDS)
        scores[row, count + row] = _NEW_NOT_ALLOWED if candidate.moves and max_births == 0 else log_new
        for column in range(0 if is_ghost[row] else count):
            # What may be a ghost is no drone that was lost elsewhere.
            if not is_dying[row] or _may_have_stayed(candidate, lost, column, limits):
                scores[row, column] = _log_likelihood(candidate, lost, column, limits)
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


def _log_span_of_new(candidate: TrackCandidate, lost: LostTracks) -> float:
    """Log density of the logarithm of a new drone's span: any usual one, or each of the lost drones' with an error."""
    spans_m = lost.size_m[np.isfinite(lost.size_m).all(axis=-1)].max(axis=-1)
    off = np.log(candidate.size_m.max() / spans_m)
    log_like = [log_normal(each, SPAN_STD**2) for each in off[:, None]]
    return float(logsumexp([-np.log(np.log(SPANS_M[1] / SPANS_M[0])), *log_like]) - np.log(1 + len(off)))


def _log_likelihood(
    candidate: TrackCandidate,
    lost: LostTracks,
    row: int,
    limits: FlightLimits,
) -> float:
    """Log likelihood of a lost drone being the candidate: a density over position, velocity and span."""
    place, velocity, span = lost.position_m[row], lost.velocity_m_s[row], float(lost.size_m[row].max())
    if not np.isfinite(span):
        span = float(candidate.size_m.max())
    log_span = log_normal(np.log(candidate.size_m.max(keepdims=True) / span), SPAN_STD**2)
    log_stayed = -np.inf
    near_m = STAYED_SPANS * span
    if _may_have_stayed(candidate, lost, row, limits):
        log_stayed = np.log(STAYED_PROBABILITY / (4 / 3 * np.pi * near_m**3))
        log_stayed += _log_velocity(candidate.velocity_m_s, limits)
    if lost.doubtful[row]:
        return log_stayed + log_span if candidate.moves and log_stayed > -np.inf else _IMPOSSIBLE
    gap_s = (candidate.instant - int(lost.instant[row])) / limits.fps
    if gap_s < -MAX_OVERLAP_S:
        return _IMPOSSIBLE
    gap_s = max(gap_s, 0.0)
    distance = float(np.linalg.norm(candidate.position_m - place))
    reach_m = limits.max_speed_m_s * gap_s + REACH_SIGMAS * POSITION_STD_M
    if distance > reach_m:
        return _UNREACHABLE - distance
    before = np.stack([place, velocity])
    after = np.stack([candidate.position_m, candidate.velocity_m_s])
    own, any_drone = _speeds2(velocity, limits)
    log_turned = log_transition(before, after, gap_s, any_drone, limits.bounds_m, parts=1)
    log_turned += np.log(TURNED_PROBABILITY) + _log_velocity(candidate.velocity_m_s, limits)
    log_flown = max(
        log_turned,
        *(log_transition(before, after, gap_s, each, limits.bounds_m) for each in (own, any_drone)),
    )
    num_flying = sum(
        not doubtful and not _stands(lost, each, limits) for each, doubtful in enumerate(lost.doubtful)
    )
    log_flown -= np.log((1 + lost.new_per_s * gap_s / NEW_ODDS) * max(num_flying, 1))
    log_flown += np.log(1 - STAYED_PROBABILITY) if _stands(lost, row, limits) else 0.0
    return max(log_stayed, log_flown) + log_span


def _speeds2(velocity_m_s: Float[np.ndarray, "3"], limits: FlightLimits) -> tuple[float, float]:
    """Variances of the velocity along each axis, m2/s2: a drone goes on as slowly as it flies, or as any drone."""
    any_drone = (SPEED_SHARE * limits.max_speed_m_s) ** 2
    own = max(float(velocity_m_s @ velocity_m_s) / 3, VELOCITY_STD_M_S**2)
    return min(own, any_drone), any_drone


def _log_velocity(velocity_m_s: Float[np.ndarray, "3"], limits: FlightLimits) -> float:
    """Log density of the velocity of a drone that is known from nothing else."""
    return max(log_normal(velocity_m_s, each) for each in _speeds2(velocity_m_s, limits))


def _stands(lost: LostTracks, row: int, limits: FlightLimits) -> bool:
    """Whether a drone stood still when it was lost, or was at the floor, where it lands."""
    height_m = float(lost.position_m[row, 2] - limits.bounds_m[0, 2])
    slow = float(np.linalg.norm(lost.velocity_m_s[row])) < STILL_M_S
    return slow or height_m < STAYED_SPANS * float(lost.size_m[row].max())


def _may_have_stayed(candidate: TrackCandidate, lost: LostTracks, row: int, limits: FlightLimits) -> bool:
    """Whether a lost drone stood where the candidate is, or where it comes from."""
    near_m = STAYED_SPANS * float(lost.size_m[row].max())
    is_near = _smallest_distance(candidate, lost.position_m[row]) < near_m
    return is_near and _stands(lost, row, limits)


def _departs_from(candidate: TrackCandidate, ghost: TrackCandidate) -> bool:
    """Whether a candidate departs from another candidate that stands still, or creeps while the drone overlaps it."""
    near_m = STAYED_SPANS * float(ghost.size_m.max())
    speed, creep = (float(np.linalg.norm(one.velocity_m_s)) for one in (candidate, ghost))
    faster = candidate.moves and (not ghost.moves or creep < min(speed, STILL_M_S))
    return faster and _smallest_distance(candidate, ghost.position_m) < near_m


def _is_dying_ghost(candidate: TrackCandidate, lost: LostTracks, fps: float) -> bool:
    """Whether a candidate is slow and at a place where a drone stood still, as a ghost that the background absorbs."""
    near_m = STAYED_SPANS * float(candidate.size_m.max())
    creeps = _speed_m_s(candidate, fps) < STILL_M_S
    return creeps and bool((np.linalg.norm(lost.left_m - candidate.position_m, axis=-1) < near_m).any())


def _speed_m_s(candidate: TrackCandidate, fps: float) -> float:
    """Speed on the whole way: a ghost's velocity is noisy, while the drone that departs hides a part of it."""
    if len(candidate.path) < 2:
        return float(np.linalg.norm(candidate.velocity_m_s))
    first, last = min(candidate.path), max(candidate.path)
    way_m = candidate.path[last].position_m - candidate.path[first].position_m
    return float(np.linalg.norm(way_m)) * fps / (last - first)


def _smallest_distance(candidate: TrackCandidate, place_m: Float[np.ndarray, "3"]) -> float:
    """Smallest distance of a candidate from a place, when it was first seen or within `DEPARTURE_S` before."""
    speed2 = float(candidate.velocity_m_s @ candidate.velocity_m_s)
    offset = candidate.position_m - place_m
    ago_s = np.clip(offset @ candidate.velocity_m_s / max(speed2, 1e-9), 0.0, DEPARTURE_S)
    return float(np.linalg.norm(offset - ago_s * candidate.velocity_m_s))


#: Time constant of the velocity, seconds: after this time the last velocity says little about the position.
VELOCITY_TIME_S = 1.0
#: Standard deviations of measured positions and velocities along each axis.
POSITION_STD_M, VELOCITY_STD_M_S = 0.1, 0.3
#: Number of reflected images of the room on either side; a drone that is reflected more often may be anywhere.
NUM_WALLS = 3

#: Position (metres) and velocity (metres per second).
Motion = Float[np.ndarray, "2 3"]


def log_transition(
    before: Motion,
    after: Motion,
    gap_s: float,
    variance: float,
    bounds_m: Float[np.ndarray, "2 3"],
    *,
    parts: int = 2,
) -> float:
    """Log density of a measured state after a gap, over position and velocity: an Ornstein-Uhlenbeck process.

    The velocity returns to 0 on average (G. E. Uhlenbeck, L. S. Ornstein, On the theory of the Brownian motion,
    Physical Review 36, 1930). After a short gap the drone is expected on its course, after a long gap anywhere in the
    room. The walls of the room reflect the drone.

    Args:
        before, after: (2, 3), measured positions and velocities, in the room.
        gap_s: time between them, at least 0.
        variance: stationary variance of the velocity along each axis, m2/s2.
        bounds_m: (2, 3), corners of the room.
        parts: 1 for the density over the position alone.
    """
    time = VELOCITY_TIME_S
    decay = np.exp(-gap_s / time)
    transition = np.array([[1.0, time * (1 - decay)], [0.0, decay]])
    process = variance * np.array(
        [
            [time**2 * (2 * gap_s / time - 3 + 4 * decay - decay**2), time * (1 - decay) ** 2],
            [time * (1 - decay) ** 2, 1 - decay**2],
        ]
    )
    measured = np.diag([POSITION_STD_M**2, VELOCITY_STD_M_S**2])
    covariance = (transition @ measured @ transition.T + process + measured)[:parts, :parts]
    error = (_reflect(after, bounds_m) - (transition @ before)[:, None])[:parts]
    distance2 = np.einsum("iwa,ij,jwa->wa", error, np.linalg.inv(covariance), error)
    per_axis = logsumexp(-distance2 / 2, axis=0)
    return float(per_axis.sum() - 3 * np.log(np.linalg.det(2 * np.pi * covariance)) / 2)


def log_normal(value: Float[np.ndarray, "dims"], variance: float) -> float:
    """Log density of a Gaussian with mean 0 and the same variance along each axis."""
    return float(-(value @ value / variance + len(value) * np.log(2 * np.pi * variance)) / 2)


def _reflect(motion: Motion, bounds_m: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 images 3"]:
    """Position and velocity along each axis, and their images after reflections at the walls."""
    (place, velocity), (low, high) = motion, bounds_m
    away = 2 * (high - low) * np.arange(-NUM_WALLS, NUM_WALLS + 1)[:, None]
    places = np.concatenate([place + away, 2 * low - place + away])
    return np.stack([places, np.repeat([velocity, -velocity], len(away), axis=0)])
