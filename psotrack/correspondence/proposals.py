"""Candidates for groups: what pairs of detections and predictions propose, completed by the other views."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence.epipolar import line_distances
from psotrack.correspondence.groups import (
    UNEXPLAINED,
    Groups,
    distances,
    equations,
    measured,
    solved,
    valid,
    within,
)
from psotrack.correspondence.sight import Priors, Sight


def proposals(sight: Sight, priors: Priors, bounds_m: Float[np.ndarray, "2 3"]) -> Groups:
    """Groups of the detections nearest to where something is proposed, without heed to other groups."""
    point, covariance = _pairs(sight, priors)
    kept = within(point, bounds_m)
    point, covariance, prior = _with_expected(point[kept], covariance[kept], priors)
    # From two rays to all that agree; then those that agree with all.
    for _ in range(2):
        distance = distances(sight, point[:, None], covariance[:, None])
        support = np.where(distance.min(axis=-1) < UNEXPLAINED, distance.argmin(axis=-1), -1)
        _, first = np.unique(np.column_stack([support, prior]), axis=0, return_index=True)
        support = support[first]
        groups = measured(sight, priors, support, np.zeros(support.shape, bool), prior[first], point[first])
        groups = groups.only(within(groups.point, bounds_m))
        point, covariance, prior = groups.point, groups.covariance, groups.prior
    return groups.only(valid(sight, groups, bounds_m))


def _pairs(
    sight: Sight, priors: Priors
) -> tuple[Float[np.ndarray, "pairs 3"], Float[np.ndarray, "pairs 3 3"]]:
    """Points, and their covariances, of pairs of detections near each other's epipolar lines, if other views agree."""
    least = int(priors.least[-1])
    close = line_distances(sight) < UNEXPLAINED
    first, second, i, j = np.nonzero(close & _proposing(sight, least)[..., None, None])
    # Where both lines meet in another view there must be something too.
    others = np.any(close[first, :, i] & close[second, :, j], axis=-1)
    kept = sight.num_viewpoints(others) >= least - 2
    camera, support = np.stack([first, second], axis=-1)[kept], np.stack([i, j], axis=-1)[kept]
    room, middle = priors.equations(np.array([-1]))
    depth = sight.depth(priors.mean[-1])[camera]
    for _ in range(2):
        normal, right = equations(sight, camera, support, depth)
        point, covariance = solved(normal.sum(axis=1) + room, right.sum(axis=1) + middle)
        depth = np.take_along_axis(sight.depth(point), camera, axis=-1)
    return point, covariance


def _proposing(sight: Sight, least: int) -> Bool[np.ndarray, "cameras cameras"]:
    """Pairs of cameras that propose: so few that there is still one among any `least` viewpoints.

    Of three viewpoints two are in the same half of the rig, and neighbours see a point from better angles than
    cameras that face each other.
    """
    apart = np.triu(sight.at @ sight.at.T < 0.5)
    if least < 3:
        return apart
    centre = sight.at.T @ sight.straight.centre_world / sight.at.sum(axis=0)[:, None]
    half = sight.at @ (np.lexsort(centre.T[::-1]).argsort() < len(centre) // 2) > 0.5
    return apart & (half[:, None] == half)


def _with_expected(
    point: Float[np.ndarray, "pairs 3"], covariance: Float[np.ndarray, "pairs 3 3"], priors: Priors
) -> tuple[Float[np.ndarray, "proposed 3"], Float[np.ndarray, "proposed 3 3"], Int[np.ndarray, "proposed"]]:
    """The pairs, each once more for every expected drone near it, and the predictions; each with its prior."""
    expected, spread = priors.mean[:-1], np.linalg.inv(priors.normal[:-1])
    off = point[:, None] - expected
    apart = np.linalg.inv(covariance[:, None] + spread)
    squared = (off[..., None, :] @ apart @ off[..., None])[..., 0, 0]
    pair, known = np.nonzero(squared < UNEXPLAINED)
    gain = spread[known] @ apart[pair, known]
    return (
        np.concatenate([point, expected[known] + (gain @ off[pair, known][..., None])[..., 0], expected]),
        np.concatenate([covariance, spread[known] - gain @ spread[known], spread]),
        np.concatenate([np.full(len(point), -1), known, np.arange(len(expected))]),
    )
