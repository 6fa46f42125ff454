"""Decide the labels of a group, and record its encounters."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from psotrack.identity import labellings
from psotrack.identity.groups import Group
from psotrack.identity.records import Encounter, Identities, IdentityParams, LabelOutcome
from psotrack.identity.tracks import MeasuredTracks

_log = logging.getLogger(__name__)

#: Cost of a swap, frames: two swaps, there and back, must make more than twice this number of frames right.
_SWAP_COST_FRAMES = 3.0


def is_settled(group: Group, time_s: float, params: IdentityParams) -> bool:
    """Whether the labels are certain and a drone has left the group, or `patience_s` has passed.

    In a group of more than two drones, the drones that stay near each other start a new group.
    """
    sure = np.exp(group.log_probability[-1].max()) >= params.decision_probability
    left = group.apart.all(axis=1).any()
    return bool((sure and left) or time_s - group.near_s >= params.patience_s)


def settle(
    group: Group,
    found: Identities,
    tracks: MeasuredTracks,
    params: IdentityParams,
    *,
    still_open: bool = False,
) -> Identities:
    """Decide a group's labels after its last frame, and add them and its encounters to the identities."""
    num = len(group.drones)
    rows = slice(group.first, group.first + len(group.before))
    log_probability = np.array(group.log_probability)
    chosen = _decision(log_probability[-1], num, params)
    probability = labellings.smooth_labels(np.array(group.before), chosen)
    taken = labellings.best_path(probability, _SWAP_COST_FRAMES * labellings.exchanges(num))
    track = group.tracks[labellings.labellings(num)[taken]]

    order = found.order.copy()
    order[rows, group.drones] = track
    order[rows.stop :, group.drones] = track[-1]
    ambiguity = found.ambiguity.copy()
    encounters = list(found.encounters)
    weight = np.exp(log_probability)
    for (one, other), wrong in zip(
        combinations(range(num), 2), np.moveaxis(labellings.confusions(num), -1, 0), strict=True
    ):
        drones = tuple(sorted(group.drones[[one, other]].tolist()))
        pair = int((found.pairs == drones).all(axis=1).argmax())
        ambiguity[rows, pair] = (weight * wrong[taken]).sum(axis=1)
        distance_m = tracks.distance_m[np.arange(rows.start, rows.stop), track[:, one], track[:, other]]
        distance_m = np.where(np.isnan(distance_m), np.inf, distance_m)
        if distance_m.min() >= params.encounter_m:
            continue
        # Odds for the tracks before resolution.
        swapped = np.logaddexp.reduce(log_probability[-1][wrong[0]])
        right = np.logaddexp.reduce(log_probability[-1][~wrong[0]])
        if still_open:
            outcome = LabelOutcome.OPEN
        elif wrong[0, chosen]:
            outcome = LabelOutcome.SWAPPED
        else:
            sure = right >= np.log(params.decision_probability)
            outcome = LabelOutcome.KEPT if sure else LabelOutcome.UNDECIDED
        encounter = Encounter(
            drones=drones,
            first_frame=group.first,
            closest_frame=group.first + int(distance_m.argmin()),
            distance_m=float(distance_m.min()),
            last_frame=rows.stop - 1,
            log_odds=float(swapped - right),
            outcome=outcome,
        )
        _log.info("%s", encounter)
        encounters.append(encounter)
    return replace(found, order=order, ambiguity=ambiguity, encounters=tuple(encounters))


def _decision(
    log_probability: Float[np.ndarray, "labellings"], num_drones: int, params: IdentityParams
) -> int:
    """The labelling with the fewest swaps among those that the most probable labelling does not exclude."""
    odds = np.log(params.decision_probability) - np.log1p(-params.decision_probability)
    possible = log_probability > log_probability.max() - odds
    number = np.where(possible, labellings.exchanges(num_drones)[0], np.inf)
    return int(np.lexsort((-log_probability, number))[0])
