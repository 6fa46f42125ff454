"""Results of the resolution of identity swaps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float, Int

from psotrack.support import short_repr


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
