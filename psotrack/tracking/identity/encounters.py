"""Follow an encounter of two drones from the first frame in which they are near until their labels are decided."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.support import short_repr
from psotrack.tracking.identity import labellings
from psotrack.tracking.motion import Measurements, MotionParams, last_state


class LabelOutcome(StrEnum):
    """Outcome of an encounter for the labels of its two drones."""

    KEPT = "kept"
    SWAPPED = "swapped"
    #: Kept, because the evidence was too weak.
    UNDECIDED = "undecided"
    #: The recording ends before a decision; more frames may change the result.
    OPEN = "open"


@dataclass(frozen=True)
class Encounter:
    """Two drones that met.

    Attributes:
        drones: labels of the two drones, the lower label first.
        first_frame: first frame in which the two drones are near.
        closest_frame, distance_m: frame of the smallest distance, and this distance, metres.
        last_frame: frame of the decision; the recording's last frame if there was none.
        log_odds: natural logarithm of the odds of a swap, in the last frame.
        outcome: outcome for the labels.
    """

    drones: tuple[int, int]
    first_frame: int
    closest_frame: int
    distance_m: float
    last_frame: int
    log_odds: float
    outcome: LabelOutcome


@dataclass(frozen=True, repr=False)
class Identities:
    """Track of each drone in every frame.

    Attributes:
        order: (frames, drones), index of each drone's track; `relabelled` applies it.
        pairs: (pairs, 2), labels of two drones, the lower label first.
        ambiguity: (frames, pairs), probability that `order` exchanges the two drones, given all frames up to this
            frame; 0 outside encounters.
        encounters: encounters in the order of their decisions.
    """

    order: Int[np.ndarray, "frames drones"]
    pairs: Int[np.ndarray, "pairs 2"]
    ambiguity: Float[np.ndarray, "frames pairs"]
    encounters: tuple[Encounter, ...]

    __repr__ = short_repr


def relabelled(value: np.ndarray, order: Int[np.ndarray, "frames drones"]) -> np.ndarray:
    """Reorder an array (frames, tracks, ...) into (frames, drones, ...)."""
    return np.take_along_axis(value, order.reshape(*order.shape, *[1] * (value.ndim - 2)), axis=1)


#: Least log odds of a swap that is undone, and of labels that are certain: a probability of 0.99. It is high, because
#: trackers swap drones less often than the even odds that are assumed here.
_SURE_LOG_ODDS = math.log(99)

#: Time after the last near frame after which undecided labels are kept, seconds: the motion before the encounter says
#: nothing more by then.
_PATIENCE_S = 2.0

#: Drones that were near are separate again when their distance exceeds this number times `encounter_m`.
_HYSTERESIS = 1.25

#: Rate of swaps of two tracks while they are near, per second. An encounter lasts some tenths of a second, so without
#: measurements a swap and no swap are about equally likely after it.
_SWAPS_PER_S = 5.0

#: Cost of a swap, frames: two swaps, there and back, must make more than twice this number of frames right.
_SWAP_COST_FRAMES = 3.0

#: Near tracks attract each other. This is the added standard deviation at distance 0, as a share of `encounter_m`; it
#: falls to 0 at `encounter_m`, with the square of the remaining distance.
_PULL = 0.1

#: Number of frames before an encounter from which motion states are estimated; older frames have no more influence.
_WARM_UP = 50


@dataclass(frozen=True, eq=False)
class FollowedEncounter:
    """An encounter that was followed to its end.

    Attributes:
        encounter: what the record says about it.
        exchanged: (frames,), frames of the recording in which the labels must be exchanged.
        ambiguity: (rows,), probability that this is wrong, from the first to the last frame of the encounter.
    """

    encounter: Encounter
    exchanged: Bool[np.ndarray, "frames"]
    ambiguity: Float[np.ndarray, "rows"]


def follow(
    drones: tuple[int, int],
    first: int,
    measured: Measurements,
    motion: MotionParams,
    encounter_m: float,
) -> FollowedEncounter:
    """Follow an encounter of two drones from its first frame until it is decided, or until the recording ends.

    Args:
        drones: labels of the two drones, the lower label first.
        first: first frame in which they are near.
        measured: measurements of the two drones.
        motion: motion parameters of the two drones during encounters.
        encounter_m: drones nearer than this may be taken for each other.
    """
    later = measured[first:]
    distance_m = np.linalg.norm(later.position_m[:, 0] - later.position_m[:, 1], axis=-1)
    distance_m = np.where(later.was_measured.all(axis=1), distance_m, np.nan)
    last_near = _latest(distance_m < encounter_m)
    is_apart = _latest(distance_m > _HYSTERESIS * encounter_m) > last_near
    is_over = later.time_s - later.time_s[last_near] >= _PATIENCE_S
    known_m = distance_m[_latest(np.isfinite(distance_m))]
    pull_m = _PULL * encounter_m * np.maximum(1 - known_m / encounter_m, 0.0) ** 2
    dt_s = np.diff(measured.time_s, prepend=measured.time_s[0])[first:]
    # In the frame in which tracks become separate they may still have swapped.
    may_swap = ~is_apart | ~np.roll(is_apart, 1)
    frames = zip(
        dt_s,
        later.position_m,
        later.covariance_m2 + pull_m[:, None, None, None] ** 2 * np.eye(3),
        later.was_measured,
        labellings.log_change(_SWAPS_PER_S * dt_s * may_swap),
        strict=True,
    )
    now = labellings.begin(last_state(_before(measured, first, encounter_m), motion))
    log_probability, before, log_odds, is_settled = [], [], 0.0, False
    for k, frame in enumerate(frames):
        now = labellings.step(now, *frame, motion)
        log_probability.append(np.asarray(now.log_probability))
        before.append(np.asarray(now.before))
        log_odds = float(log_probability[-1][1] - log_probability[-1][0])
        is_settled = bool(is_over[k] or (is_apart[k] and abs(log_odds) >= _SURE_LOG_ODDS))
        if is_settled:
            break
    is_swapped = log_odds >= _SURE_LOG_ODDS
    path = labellings.best_path(np.array(before), _SWAP_COST_FRAMES, at_the_end=is_swapped)
    end = first + len(path)
    exchanged = np.full(len(measured.time_s), is_swapped)
    exchanged[:first], exchanged[first:end] = False, path
    closest = int(np.nanargmin(distance_m[: len(path)]))
    encounter = Encounter(
        drones=drones,
        first_frame=first,
        closest_frame=first + closest,
        distance_m=float(distance_m[closest]),
        last_frame=end - 1,
        log_odds=log_odds,
        outcome=_outcome(log_odds) if is_settled else LabelOutcome.OPEN,
    )
    return FollowedEncounter(encounter, exchanged, np.exp(np.where(path, *np.array(log_probability).T)))


def _latest(happens: Bool[np.ndarray, "rows"]) -> Int[np.ndarray, "rows"]:
    """(rows,), the last row up to each row in which something happens; 0 before the first."""
    return np.maximum.accumulate(np.where(happens, np.arange(len(happens)), 0))


def _outcome(log_odds: float) -> LabelOutcome:
    if log_odds >= _SURE_LOG_ODDS:
        return LabelOutcome.SWAPPED
    return LabelOutcome.KEPT if log_odds <= -_SURE_LOG_ODDS else LabelOutcome.UNDECIDED


def _before(measured: Measurements, first: int, encounter_m: float) -> Measurements:
    """Measurements before an encounter.

    A drone that appears in its first frame has that frame's measurement, which gives only its place.
    """
    rows = np.arange(first - _WARM_UP, first)
    past = measured[np.maximum(rows, 0)]
    past.was_measured[rows < 0] = False
    is_new = ~past.was_measured.any(axis=0)
    past.position_m[-1, is_new] = measured.position_m[first, is_new]
    past.covariance_m2[-1, is_new] = encounter_m**2 * np.eye(3)
    past.was_measured[-1, is_new] = True
    return past
