"""Candidates for groups: pairs of detections, and predictions, completed with detections of the other cameras."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import Camera, cross_matrices, undistort
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
        first = _first_of_equal(np.column_stack([detection, prior]))
        detection = detection[first]
        groups = make_groups(
            padded, priors, detection, np.zeros(detection.shape, bool), prior[first], point[first]
        )
        groups = groups.only(are_in_bounds(groups.point, bounds_m))
        point, covariance, prior = groups.point, groups.covariance, groups.prior
    return groups.only(are_valid(padded, groups, bounds_m))


def _first_of_equal(rows: Int[np.ndarray, "rows columns"]) -> Int[np.ndarray, "different"]:
    """Index of the first of all equal rows, in the order of the rows' values; faster than `np.unique`."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    return order[np.diff(ordered, axis=0, prepend=ordered[:1] - 1).any(axis=1)]


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
        depth = padded.depth(point)[np.arange(len(point))[:, None], camera]
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
    off, total = point[:, None] - expected, covariance[:, None] + spread
    # Most pairs are farther than along the longest axis of a covariance, which is no longer than its trace.
    reached = np.vecdot(off, off) < UNEXPLAINED_COST * np.trace(total, axis1=-2, axis2=-1)
    off, apart = off[reached], np.linalg.inv(total[reached])
    near = np.vecdot(off, np.matvec(apart, off)) < UNEXPLAINED_COST
    known = np.nonzero(reached)[1][near]
    gain = spread[known] @ apart[near]
    return (
        np.concatenate([point, expected[known] + np.matvec(gain, off[near]), expected]),
        np.concatenate([covariance, spread[known] - gain @ spread[known], spread]),
        np.concatenate([np.full(len(point), -1), known, np.arange(len(expected))]),
    )


def epipolar_distance(
    first: Camera,
    second: Camera,
    first_px: Float[np.ndarray, "n 2"],
    second_px: Float[np.ndarray, "m 2"],
) -> Float[np.ndarray, "n m 2"]:
    """Distances of two cameras' detections from each other's epipolar lines, in undistorted pixels.

    Args:
        first, second: single cameras.
        first_px, second_px: (n, 2) and (m, 2), detections in the first and in the second camera, pixels.

    Returns:
        (n, m, 2), pixels. [..., 0]: distance of the second camera's detection from the epipolar line of the first
        camera's detection. [..., 1]: the reverse. Infinite or NaN if both cameras stand at the same place.
    """
    x = _homogeneous(undistort(first, first_px)), _homogeneous(undistort(second, second_px))
    E = _essential(np.stack([first.T_cam_world, second.T_cam_world])[:, :3])[0, 1]
    in_second, in_first = x[0] @ E.T, x[1] @ E
    product = np.abs(in_second @ x[1].T)
    # A line in pixels is the line in normalised coordinates times the inverse of K.
    norm_second, norm_first = (
        np.linalg.norm((line @ np.linalg.inv(cam.K))[:, :2], axis=-1)
        for cam, line in ((second, in_second), (first, in_first))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([product / norm_second[:, None], product / norm_first], axis=-1)


def squared_epipolar_distances(padded: PaddedSightings) -> Float[np.ndarray, "cameras cameras padded padded"]:
    """Squared Sampson distance of every pair of detections from their epipolar lines, in squared standard deviations.

    For two detections of one point the distance has a χ² distribution with one degree of freedom. Padding has an
    infinite distance.
    """
    x = _homogeneous(padded.x)
    lines = x[:, None] @ _essential(padded.T).swapaxes(-1, -2)
    squared_norm = (lines[..., 0] ** 2 + lines[..., 1] ** 2)[..., None]
    detected = np.isfinite(padded.variance)
    variance = np.where(detected, padded.variance, 1.0)
    across = squared_norm * variance[:, None]
    across = across + squared_norm.swapaxes(0, 1).swapaxes(-1, -2) * variance[:, None, :, None]
    squared = (lines @ x.swapaxes(-1, -2)) ** 2
    both = detected[:, None, :, None] & detected[:, None]
    return np.divide(squared, across, where=both & (across > 0), out=np.full(squared.shape, np.inf))


def _essential(T: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "cameras cameras 3 3"]:
    """Essential matrices: E[a, b] x is the epipolar line in camera b of the point x in camera a.

    Hartley and Zisserman, Multiple View Geometry, section 9.6.
    """
    R, t = T[..., :3], T[..., 3]
    R_ba = R @ R[:, None].swapaxes(-1, -2)
    t_ba = t - (R_ba @ t[:, None, :, None])[..., 0]
    return cross_matrices(t_ba) @ R_ba


def _homogeneous(x: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 3"]:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)
