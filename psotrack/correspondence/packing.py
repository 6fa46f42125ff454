"""The set of groups with the least total cost, by local search: exchanges of groups, and assignments per camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.correspondence.groups import (
    SHARED,
    UNEXPLAINED,
    Groups,
    distances,
    enough,
    equations,
    measured,
    solved,
    valid,
)
from psotrack.correspondence.sight import Priors, Sight

#: Groups nearer than this are two drones only if two viewpoints see both, for a detector may see one drone twice.
SEPARATION_M = 0.3

#: Rounds of exchanges and assignments. The cost falls in each, and hardly ever in the third.
_MAX_ROUNDS = 4
#: Gains below this are rounding.
_LEAST_GAIN = 1e-9


def packed(sight: Sight, proposed: Groups, priors: Priors, bounds_m: Float[np.ndarray, "2 3"]) -> Groups:
    """Groups that can be together, and together cost the least that was found."""
    best = proposed.only(np.zeros(0, int))
    groups = exchanged(sight, _start(proposed), proposed)
    for _ in range(_MAX_ROUNDS):
        groups = _reassigned(sight, groups, priors)
        groups = groups.only(valid(sight, groups, bounds_m))
        if groups.worth.sum() <= best.worth.sum() + _LEAST_GAIN:
            break
        best = groups
        groups = exchanged(sight, best, proposed)
        if groups is best:
            break
    return best


def _start(proposed: Groups) -> Groups:
    """The candidate that is worth most, then that of those that can be together with it, and so on."""
    support = proposed.support
    clash = ((support[:, None] == support) & (support >= 0)).any(axis=-1)
    clash |= np.linalg.norm(proposed.point[:, None] - proposed.point, axis=-1) < SEPARATION_M
    clash |= (proposed.prior[:, None] == proposed.prior) & (proposed.prior >= 0)
    chosen, out = np.zeros(len(proposed), bool), np.zeros(len(proposed), bool)
    for which in np.argsort(-proposed.worth, kind="stable"):
        if not out[which]:
            chosen[which] = True
            out |= clash[which]
    return proposed.only(chosen)


@dataclass(frozen=True)
class Offers:
    """What it would change to put in candidates.

    Attributes:
        which: (offers,), index of the candidate.
        take, share: (offers, cameras), detections that it would get, alone and with another group.
        value: (offers,), how much less the assignment would cost.
        rest: (offers, groups, cameras), detections that the groups would keep.
        broken: (offers, groups), groups that would have to go.
    """

    which: Int[np.ndarray, "offers"]
    take: Bool[np.ndarray, "offers cameras"]
    share: Bool[np.ndarray, "offers cameras"]
    value: Float[np.ndarray, "offers"]
    rest: Bool[np.ndarray, "offers groups cameras"]
    broken: Bool[np.ndarray, "offers groups"]

    def accepted(self, groups: Groups, proposed: Groups, number: int) -> Groups:
        """The groups after one of the offers."""
        take, share = self.take[number], self.share[number]
        new = proposed.only(self.which[[number]])
        gain = np.where(take, new.gain, np.where(share, new.gain - SHARED, 0.0))
        new = replace(new, support=np.where(take | share, new.support, -1), shared=share[None], gain=gain)
        rest = self.rest[number]
        left = replace(groups, support=np.where(rest, groups.support, -1), gain=groups.gain * rest)
        return left.only(~self.broken[number]) + new


def offers_of(sight: Sight, groups: Groups, proposed: Groups, *, forced: bool = False) -> Offers:
    """What may be worth it: a candidate takes all its detections, those worth more there, or the free ones.

    Those that are not free it may share in the last case.

    Args:
        sight: with the detections.
        groups: of the assignment as it is.
        proposed: candidates.
        forced: one offer for every candidate instead, to take all its detections, whatever that costs.
    """
    lost, owner = _owned(sight, groups, proposed)
    there = proposed.seen
    net = np.where(there, proposed.gain - lost, 0.0)
    if forced:
        which = np.arange(len(proposed))
        take, share, value = there, np.zeros_like(there), net.sum(axis=-1) - proposed.price
    else:
        free = there & (owner < 0)
        takes = np.stack([there, net > 0, free, free])
        shares = np.zeros_like(takes)
        shares[-1] = there & ~free & (proposed.gain > SHARED)
        values = (takes * net + shares * (proposed.gain - SHARED)).sum(axis=-1) - proposed.price
        way, which = np.nonzero(values > _LEAST_GAIN)
        kept = enough(sight, takes[way, which], (takes | shares)[way, which], proposed.least[which])
        way, which = way[kept], which[kept]
        take, share, value = takes[way, which], shares[way, which], values[way, which]
    rest = groups.seen & ~(take[:, None] & (owner[which, None] == np.arange(len(groups))[:, None]))
    broken = ~enough(sight, rest & ~groups.shared, rest, groups.least)
    broken |= (proposed.prior[which, None] == groups.prior) & (groups.prior >= 0)
    near = np.linalg.norm(proposed.point[which, None] - groups.point, axis=-1) < SEPARATION_M
    broken |= near & (sight.num_viewpoints(take[:, None] & rest) < 2)
    left = (rest * groups.gain).sum(axis=-1) - groups.price
    return Offers(which, take, share, value - (broken * left).sum(axis=-1), rest, broken)


def _owned(
    sight: Sight, groups: Groups, proposed: Groups
) -> tuple[Float[np.ndarray, "candidates cameras"], Int[np.ndarray, "candidates cameras"]]:
    """What the candidates' detections gain where they are, and in which group; 0 and -1 for those that are free."""
    gain, owner = np.zeros(sight.variance.shape), np.full(sight.variance.shape, -1)
    row, camera = np.nonzero(groups.seen & ~groups.shared)
    gain[camera, groups.support[row, camera]] = groups.gain[row, camera]
    owner[camera, groups.support[row, camera]] = row
    column = np.arange(len(gain)), proposed.support
    return gain[column], owner[column]


def exchanged(sight: Sight, groups: Groups, proposed: Groups) -> Groups:
    """The groups after all offers that lower the cost, the best first; the same object if there are none."""
    for _ in range(len(proposed)):
        offers = offers_of(sight, groups, proposed)
        if offers.value.max(initial=0.0) <= _LEAST_GAIN:
            break
        groups = offers.accepted(groups, proposed, int(offers.value.argmax()))
    return groups


def _reassigned(sight: Sight, groups: Groups, priors: Priors) -> Groups:
    """The groups with those detections in every camera that all other cameras speak for, by optimal assignment."""
    normal, right = equations(
        sight, np.arange(len(groups.support.T)), groups.support, sight.depth(groups.point)
    )
    own = priors.equations(groups.prior)
    normal = (normal.sum(axis=1) + own[0])[:, None] - normal
    right = (right.sum(axis=1) + own[1])[:, None] - right
    distance = distances(sight, *solved(normal, right))
    cost = np.minimum(np.concatenate([distance, distance + SHARED], axis=-1), UNEXPLAINED)
    support, shared = np.full_like(groups.support, -1), np.zeros(groups.support.shape, bool)
    num_columns = distance.shape[-1]
    for camera in range(support.shape[1]):
        row, column = linear_sum_assignment(cost[:, camera])
        near = cost[row, camera, column] < UNEXPLAINED
        support[row[near], camera] = column[near] % num_columns
        shared[row[near], camera] = column[near] >= num_columns
    return measured(sight, priors, support, shared, groups.prior, groups.point)
