"""Local search for the set of groups with the smallest total cost: exchanges of groups, and assignments per camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.tracking.matching.groups import (
    SHARED_COST,
    UNEXPLAINED_COST,
    Groups,
    are_valid,
    have_enough_viewpoints,
    make_groups,
    normal_equations,
    solve_points,
    squared_distances,
)
from psotrack.tracking.matching.padded_sightings import PaddedSightings, Priors

#: Two groups that are nearer to each other than this are two drones only if at least two viewpoints see both, because
#: a detector may draw two boxes about one drone, metres.
SEPARATION_M = 0.3

#: Largest number of rounds of exchanges and assignments. The cost hardly ever falls after the second round.
_MAX_ROUNDS = 4
#: Smallest saving that counts, squared standard deviations: smaller savings are rounding errors.
_MIN_SAVING = 1e-9


def assign_groups(
    padded: PaddedSightings, proposed: Groups, priors: Priors, bounds_m: Float[np.ndarray, "2 3"]
) -> Groups:
    """Search the set of compatible groups that has the smallest total cost.

    Args:
        padded: sightings of the frame.
        proposed: candidates for groups.
        priors: expected drones, and the room.
        bounds_m: (2, 3), corners of the region where drones can be, metres.
    """
    best = proposed.only(np.zeros(0, int))
    groups = apply_exchanges(padded, _greedy_groups(proposed), proposed)
    for _ in range(_MAX_ROUNDS):
        groups = _reassign_detections(padded, groups, priors)
        groups = groups.only(are_valid(padded, groups, bounds_m))
        if groups.saving.sum() <= best.saving.sum() + _MIN_SAVING:
            break
        best = groups
        groups = apply_exchanges(padded, best, proposed)
        if groups is best:
            break
    return best


def _greedy_groups(proposed: Groups) -> Groups:
    """Choose candidates one after the other: each time the one that saves most and clashes with none chosen before."""
    detection = proposed.detection
    clash = ((detection[:, None] == detection) & (detection >= 0)).any(axis=-1)
    clash |= np.linalg.norm(proposed.point[:, None] - proposed.point, axis=-1) < SEPARATION_M
    clash |= (proposed.prior[:, None] == proposed.prior) & (proposed.prior >= 0)
    chosen, out = np.zeros(len(proposed), bool), np.zeros(len(proposed), bool)
    for which in np.argsort(-proposed.saving, kind="stable"):
        if not out[which]:
            chosen[which] = True
            out |= clash[which]
    return proposed.only(chosen)


@dataclass(frozen=True)
class Exchanges:
    """Possible changes of an assignment: each puts one candidate in and removes the groups that it breaks.

    Attributes:
        which: (exchanges,), index of the candidate.
        take: (exchanges, cameras), True where the candidate takes its detection for itself.
        share: (exchanges, cameras), True where the candidate shares its detection with another group.
        value: (exchanges,), how much the exchange lowers the total cost.
        rest: (exchanges, groups, cameras), True where a group keeps its detection.
        broken: (exchanges, groups), True for groups that the exchange removes.
    """

    which: Int[np.ndarray, "exchanges"]
    take: Bool[np.ndarray, "exchanges cameras"]
    share: Bool[np.ndarray, "exchanges cameras"]
    value: Float[np.ndarray, "exchanges"]
    rest: Bool[np.ndarray, "exchanges groups cameras"]
    broken: Bool[np.ndarray, "exchanges groups"]

    def apply(self, groups: Groups, proposed: Groups, number: int) -> Groups:
        """The groups after exchange `number`."""
        take, share = self.take[number], self.share[number]
        new = proposed.only(self.which[[number]])
        gain = np.where(take, new.gain, np.where(share, new.gain - SHARED_COST, 0.0))
        new = replace(new, detection=np.where(take | share, new.detection, -1), shared=share[None], gain=gain)
        rest = self.rest[number]
        left = replace(groups, detection=np.where(rest, groups.detection, -1), gain=groups.gain * rest)
        return left.only(~self.broken[number]) + new


def propose_exchanges(
    padded: PaddedSightings, groups: Groups, proposed: Groups, *, forced: bool = False
) -> Exchanges:
    """Exchanges that may lower the cost.

    There are four kinds. The candidate takes (1) all its detections, (2) only the detections that gain more in the
    candidate than in their present group, (3) only the detections that are in no group, or (4) the detections that are
    in no group, and it shares its other detections.

    Args:
        padded: sightings of the frame.
        groups: groups of the present assignment.
        proposed: candidates.
        forced: propose exactly one exchange per candidate, in which the candidate takes all its detections, even if
            the cost rises.
    """
    lost, owner = _find_owners(padded, groups, proposed)
    seen = proposed.seen
    net = np.where(seen, proposed.gain - lost, 0.0)
    if forced:
        which = np.arange(len(proposed))
        take, share, value = seen, np.zeros_like(seen), net.sum(axis=-1) - proposed.base_cost
    else:
        free = seen & (owner < 0)
        takes = np.stack([seen, net > 0, free, free])
        shares = np.zeros_like(takes)
        shares[-1] = seen & ~free & (proposed.gain > SHARED_COST)
        values = (takes * net + shares * (proposed.gain - SHARED_COST)).sum(axis=-1) - proposed.base_cost
        kind, which = np.nonzero(values > _MIN_SAVING)
        kept = have_enough_viewpoints(
            padded, takes[kind, which], (takes | shares)[kind, which], proposed.min_viewpoints[which]
        )
        kind, which = kind[kept], which[kept]
        take, share, value = takes[kind, which], shares[kind, which], values[kind, which]
    rest = groups.seen & ~(take[:, None] & (owner[which, None] == np.arange(len(groups))[:, None]))
    broken = ~have_enough_viewpoints(padded, rest & ~groups.shared, rest, groups.min_viewpoints)
    broken |= (proposed.prior[which, None] == groups.prior) & (groups.prior >= 0)
    near = np.linalg.norm(proposed.point[which, None] - groups.point, axis=-1) < SEPARATION_M
    broken |= near & (padded.num_viewpoints(take[:, None] & rest) < 2)
    left = (rest * groups.gain).sum(axis=-1) - groups.base_cost
    return Exchanges(which, take, share, value - (broken * left).sum(axis=-1), rest, broken)


def _find_owners(
    padded: PaddedSightings, groups: Groups, proposed: Groups
) -> tuple[Float[np.ndarray, "candidates cameras"], Int[np.ndarray, "candidates cameras"]]:
    """Gains of the candidates' detections in their present groups, and the indices of these groups.

    For a detection in no group the gain is 0 and the index is -1.
    """
    gain, owner = np.zeros(padded.variance.shape), np.full(padded.variance.shape, -1)
    row, camera = np.nonzero(groups.seen & ~groups.shared)
    gain[camera, groups.detection[row, camera]] = groups.gain[row, camera]
    owner[camera, groups.detection[row, camera]] = row
    column = np.arange(len(gain)), proposed.detection
    return gain[column], owner[column]


def apply_exchanges(padded: PaddedSightings, groups: Groups, proposed: Groups) -> Groups:
    """Apply the exchange that lowers the cost most, again and again until no exchange lowers the cost.

    If no exchange lowers the cost, the same object is returned.
    """
    for _ in range(len(proposed)):
        exchanges = propose_exchanges(padded, groups, proposed)
        if exchanges.value.max(initial=0.0) <= _MIN_SAVING:
            break
        groups = exchanges.apply(groups, proposed, int(exchanges.value.argmax()))
    return groups


def _reassign_detections(padded: PaddedSightings, groups: Groups, priors: Priors) -> Groups:
    """Assign the detections of every camera optimally to the points that all other cameras see."""
    normal, right = normal_equations(
        padded, np.arange(len(groups.detection.T)), groups.detection, padded.depth(groups.point)
    )
    own = priors.normal[groups.prior]
    # Without one of two views, the room alone would say how far along the other ray the drone is: in the room's middle,
    # which may be behind a camera.
    mean = np.where(groups.prior[:, None] < 0, groups.point, priors.mean[groups.prior])
    own_right = (own @ mean[..., None])[..., 0]
    normal = (normal.sum(axis=1) + own)[:, None] - normal
    right = (right.sum(axis=1) + own_right)[:, None] - right
    distance = squared_distances(padded, *solve_points(normal, right))
    cost = np.minimum(np.concatenate([distance, distance + SHARED_COST], axis=-1), UNEXPLAINED_COST)
    detection, shared = np.full_like(groups.detection, -1), np.zeros(groups.detection.shape, bool)
    num_columns = distance.shape[-1]
    for camera in range(detection.shape[1]):
        row, column = linear_sum_assignment(cost[:, camera])
        near = cost[row, camera, column] < UNEXPLAINED_COST
        detection[row[near], camera] = column[near] % num_columns
        shared[row[near], camera] = column[near] >= num_columns
    return make_groups(padded, priors, detection, shared, groups.prior, groups.point)
