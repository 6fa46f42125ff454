"""When the labels of a group are settled, and what that makes of them."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from psotrack.identity import labellings
from psotrack.identity.groups import Group
from psotrack.identity.records import Encounter, Identities, IdentityParams, LabelOutcome
from psotrack.identity.tracks import Tracks

_log = logging.getLogger(__name__)

#: Exchanging tracks for a while and back again must set right more than twice so many frames.
_EXCHANGE_COST_FRAMES = 3.0


def is_settled(group: Group, time_s: float, params: IdentityParams) -> bool:
    """Whether labels are certain and drones separate, or nothing more is to be expected.

    Of more than two drones it is enough that one has left: who stays behind begins anew, with a group of its own.
    """
    sure = np.exp(group.log_probability[-1].max()) >= params.decision_probability
    left = group.apart.all(axis=1).any()
    return bool((sure and left) or time_s - group.near_s >= params.patience_s)


def settled(
    group: Group, found: Identities, tracks: Tracks, params: IdentityParams, *, still_open: bool = False
) -> Identities:
    """What is found with a group's labels decided, after its last frame."""
    num = len(group.drones)
    rows = slice(group.first, group.first + len(group.before))
    log_probability = np.array(group.log_probability)
    chosen = _decision(log_probability[-1], num, params)
    probability = labellings.smoothed(np.array(group.before), chosen)
    taken = labellings.path(probability, _EXCHANGE_COST_FRAMES * labellings.exchanges(num))
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
        # Of the tracks as they were given.
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
    """The labelling with the fewest exchanges of those that the most probable one does not exclude."""
    odds = np.log(params.decision_probability) - np.log1p(-params.decision_probability)
    possible = log_probability > log_probability.max() - odds
    number = np.where(possible, labellings.exchanges(num_drones)[0], np.inf)
    return int(np.lexsort((-log_probability, number))[0])
