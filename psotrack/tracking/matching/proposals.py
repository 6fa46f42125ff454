"""Candidates for groups: pairs of detections, and predictions, completed with detections of the other cameras."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.tracking.matching.epipolar import squared_epipolar_distances
from psotrack.tracking.matching.groups import (
    UNEXPLAINED_COST,
    Groups,
    are_in_bounds,
    are_valid,
    make_groups,
    normal_equations,
    solve_points,
    squared_distances,
)
from psotrack.tracking.matching.padded_sightings import BY_PLACE, PaddedSightings, Priors


def propose_groups(padded: PaddedSightings, priors: Priors, bounds_m: Float[np.ndarray, "2 3"]) -> Groups:
    """Candidates for groups: in every camera the detection nearest to the projection of a proposed point.

    Candidates may share detections: `assign_groups` chooses among them.

    Args:
        padded: sightings of the frame.
        priors: expected drones, and the room.
        bounds_m: (2, 3), corners of the region where drones can be, metres.
    """
    point, covariance = _pair_points(padded, priors)
    kept = are_in_bounds(point, bounds_m)
    point, covariance, prior = _add_expected(point[kept], covariance[kept], priors)
    # First add all detections that agree with the two rays, then keep those that agree with the resulting point.
    for _ in range(2):
        distance = squared_distances(padded, point[:, None], covariance[:, None])
        detection = np.where(distance.min(axis=-1) < UNEXPLAINED_COST, distance.argmin(axis=-1), -1)
        _, first = np.unique(np.column_stack([detection, prior]), axis=0, return_index=True)
        detection = detection[first]
        groups = make_groups(
            padded, priors, detection, np.zeros(detection.shape, bool), prior[first], point[first]
        )
        groups = groups.only(are_in_bounds(groups.point, bounds_m))
        point, covariance, prior = groups.point, groups.covariance, groups.prior
    return groups.only(are_valid(padded, groups, bounds_m))


def _pair_points(
    padded: PaddedSightings, priors: Priors
) -> tuple[Float[np.ndarray, "pairs 3"], Float[np.ndarray, "pairs 3 3"]]:
    """Points in which the rays of two detections nearly meet, and covariances of the points.

    The detections are near each other's epipolar lines. Only pairs are kept with which enough other cameras agree.
    """
    by_place = priors.min_viewpoints[-1] == BY_PLACE
    least = 3 if by_place else int(priors.min_viewpoints[-1])
    close = squared_epipolar_distances(padded) < UNEXPLAINED_COST
    proposing = _proposing_camera_pairs(padded, least)
    tried = _proposing_camera_pairs(padded, 2) if by_place else proposing
    first, second, i, j = np.nonzero(close & tried[..., None, None])
    # Another camera agrees if it has a detection near the epipolar lines of both detections.
    others = np.any(close[first, :, i] & close[second, :, j], axis=-1)
    kept = proposing[first, second] & (padded.num_viewpoints(others) >= least - 2)
    camera, detection = np.stack([first, second], axis=-1), np.stack([i, j], axis=-1)
    if not by_place:
        camera, detection, kept = camera[kept], detection[kept], kept[kept]
    room, middle = priors.equations(np.array([-1]))
    depth = padded.depth(priors.mean[-1])[camera]
    for _ in range(2):
        normal, right = normal_equations(padded, camera, detection, depth)
        point, covariance = solve_points(normal.sum(axis=1) + room, right.sum(axis=1) + middle)
        depth = np.take_along_axis(padded.depth(point), camera, axis=-1)
    if by_place:
        # Where only two viewpoints have the place in view, no other camera can agree.
        kept |= padded.required_viewpoints(point, np.full(len(point), BY_PLACE)) == 2
    return point[kept], covariance[kept]


def _proposing_camera_pairs(
    padded: PaddedSightings, min_viewpoints: int
) -> Bool[np.ndarray, "cameras cameras"]:
    """Pairs of cameras whose detections propose points: few, but at least one among any `min_viewpoints` viewpoints.

    Of three viewpoints, two are in the same half of the rig. Pairs in one half of the rig are therefore enough, and
    neighbours see a point from better angles than cameras that face each other.
    """
    apart = np.triu(padded.at @ padded.at.T < 0.5)
    if min_viewpoints < 3:
        return apart
    centre = padded.at.T @ padded.straight.centre_world / padded.at.sum(axis=0)[:, None]
    half = padded.at @ (np.lexsort(centre.T[::-1]).argsort() < len(centre) // 2) > 0.5
    return apart & (half[:, None] == half)


def _add_expected(
    point: Float[np.ndarray, "pairs 3"], covariance: Float[np.ndarray, "pairs 3 3"], priors: Priors
) -> tuple[Float[np.ndarray, "proposed 3"], Float[np.ndarray, "proposed 3 3"], Int[np.ndarray, "proposed"]]:
    """Add proposals for expected drones to the pairs' points; each proposal has the index of its prior.

    Returned are the pairs' points, each point again for every expected drone near it (fused with the prediction), and
    the predictions themselves.
    """
    expected, spread = priors.mean[:-1], np.linalg.inv(priors.normal[:-1])
    off = point[:, None] - expected
    apart = np.linalg.inv(covariance[:, None] + spread)
    squared = (off[..., None, :] @ apart @ off[..., None])[..., 0, 0]
    pair, known = np.nonzero(squared < UNEXPLAINED_COST)
    gain = spread[known] @ apart[pair, known]
    return (
        np.concatenate([point, expected[known] + (gain @ off[pair, known][..., None])[..., 0], expected]),
        np.concatenate([covariance, spread[known] - gain @ spread[known], spread]),
        np.concatenate([np.full(len(point), -1), known, np.arange(len(expected))]),
    )
