"""Parameters and results of the resolution of identity swaps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import SettingsError, check_positive
from psotrack.support import short_repr


@dataclass(frozen=True)
class IdentityParams:
    """Parameters that decide when labels are uncertain and when they are settled.

    Attributes:
        encounter_m: drones nearer than this may be confused: about twice a drone's size, because their silhouettes then
            touch in some views.
        decision_probability: smallest probability of a swap that is undone. It is high, because trackers swap drones
            less often than the even odds that are assumed here.
        patience_s: time after the last near frame after which undecided labels are kept, seconds: the motion before the
            encounter says nothing more by then.

    Raises:
        SettingsError: a value is out of range.
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
        first_frame: first frame of the group of drones that contains the two.
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
        ambiguity: (frames, pairs), probability that `order` confuses the two drones, given all frames up to this frame;
            0 outside encounters.
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
