"""What identity is settled by, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import SettingsError, check_positive
from psotrack.support import short_repr


@dataclass(frozen=True)
class IdentityParams:
    """When labels are in doubt, and when they are not any more.

    Attributes:
        encounter_m: drones nearer than this may be taken for each other: about twice a drone's size, as their
            silhouettes then touch in some view.
        decision_probability: labels are exchanged if that is at least so probable. High, because trackers exchange
            drones more seldom than the even odds that are assumed here.
        patience_s: so long after drones were last near, what is undecided stays as it is: their motion before tells
            nothing any more.

    Raises:
        SettingsError: a value makes no sense.
    """

    encounter_m: float = 0.6
    decision_probability: float = 0.99
    patience_s: float = 2.0

    def __post_init__(self) -> None:
        check_positive("encounter_m", self.encounter_m)
        check_positive("patience_s", self.patience_s)
        if not 0.5 < self.decision_probability < 1:
            raise SettingsError(
                "decision_probability",
                expected="more than 0.5 and less than 1",
                found=f"{self.decision_probability:g}",
            )


class LabelOutcome(StrEnum):
    """What became of the labels of two drones that met."""

    KEPT = "kept"
    SWAPPED = "swapped"
    #: Kept, for want of evidence.
    UNDECIDED = "undecided"
    #: The recording ends before it is settled; what is said of it may still change.
    OPEN = "open"


@dataclass(frozen=True)
class Encounter:
    """Two drones that met.

    Attributes:
        drones: their labels, the lower one first.
        first_frame: when they, or others of their group, came near.
        closest_frame, distance_m: when they were nearest, and how near.
        last_frame: when it was decided; the last of the recording, if it was not.
        log_odds: natural logarithm of the odds that their tracks have been exchanged, in the last frame.
        outcome: what was done.
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
    """Which track each drone is in every frame.

    Attributes:
        order: (frames, drones), the track of each drone; `np.take_along_axis` applies it (see `relabelled`).
        pairs: (pairs, 2), labels of two drones, the lower one first.
        ambiguity: (frames, pairs), the probability that, with the labels of `order`, the track of one of the two is
            the other drone, given all frames up to this one. 0 outside of encounters.
        encounters: in the order in which they were settled.
    """

    order: Int[np.ndarray, "frames drones"]
    pairs: Int[np.ndarray, "pairs 2"]
    ambiguity: Float[np.ndarray, "frames pairs"]
    encounters: tuple[Encounter, ...]

    __repr__ = short_repr


def relabelled(value: np.ndarray, order: Int[np.ndarray, "frames drones"]) -> np.ndarray:
    """(frames, drones, ...), what was by tracks, by drones."""
    return np.take_along_axis(value, order.reshape(*order.shape, *[1] * (value.ndim - 2)), axis=1)
