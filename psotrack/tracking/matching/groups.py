"""Groups of detections of the same drone: the drone's position, and how much the group lowers the total cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import NEAR_M
from psotrack.tracking.matching.padded_sightings import PaddedSightings, Priors

#: Cost of a detection in no group, squared standard deviations. Of a drone's own detections 1 in 1000 is farther from
#: the drone's projection (χ² distribution, two degrees of freedom).
UNEXPLAINED_COST = 13.8
#: Cost of a group that is not an expected drone: the cost of one detection. Without this cost, the detections of one
#: drone would often be split into two groups.
NEW_GROUP_COST = 13.8
#: Cost of each further group that shares a detection: -2 ln 0.1, for a probability of 0.1 that two drones overlap so
#: far that they get one box.
SHARED_COST = 4.6


@dataclass(frozen=True)
class Groups:
    """Groups of detections, or candidates for them.

    Attributes:
        detection: (groups, cameras), index of the detection in each camera; -1 for no detection.
        shared: (groups, cameras), True if the detection belongs to another group, and this group shares it.
        gain: (groups, cameras), cost that is saved because the detection is in the group; 0 for no detection.
        prior: (groups,), index of the expected drone; -1 for a new drone.
        min_viewpoints: (groups,), smallest number of viewpoints that must see the group.
        base_cost: (groups,), cost of the group without its detections.
        point: (groups, 3), positions in the world, metres.
        covariance: (groups, 3, 3), covariances of the positions, square metres.
    """

    detection: Int[np.ndarray, "groups cameras"]
    shared: Bool[np.ndarray, "groups cameras"]
    gain: Float[np.ndarray, "groups cameras"]
    prior: Int[np.ndarray, "groups"]
    min_viewpoints: Int[np.ndarray, "groups"]
    base_cost: Float[np.ndarray, "groups"]
    point: Float[np.ndarray, "groups 3"]
    covariance: Float[np.ndarray, "groups 3 3"]

    def __len__(self) -> int:
        return len(self.detection)

    @property
    def seen(self) -> Bool[np.ndarray, "groups cameras"]:
        """(groups, cameras), True where the group has a detection."""
        return self.detection >= 0

    @property
    def saving(self) -> Float[np.ndarray, "groups"]:
        """(groups,), how much less the assignment costs with the group than without it."""
        return self.gain.sum(axis=-1) - self.base_cost

    def only(self, index: np.ndarray) -> Groups:
        """Select the groups at `index`."""
        return Groups(**{name: value[index] for name, value in vars(self).items()})

    def __add__(self, other: Groups) -> Groups:
        return Groups(
            **{name: np.concatenate([value, vars(other)[name]]) for name, value in vars(self).items()}
        )


def make_groups(
    padded: PaddedSightings,
    priors: Priors,
    detection: Int[np.ndarray, "groups cameras"],
    shared: Bool[np.ndarray, "groups cameras"],
    prior: Int[np.ndarray, "groups"],
    approximate_m: Float[np.ndarray, "groups 3"],
) -> Groups:
    """Compute points and costs of groups with these detections.

    Args:
        padded: sightings of the frame.
        priors: expected drones, and the room.
        detection: (groups, cameras), index of the detection in each camera; -1 for no detection.
        shared: (groups, cameras), True where the detection belongs to another group.
        prior: (groups,), index of the expected drone; -1 for a new drone.
        approximate_m: (groups, 3), positions that are good enough for the depths in the cameras, metres.
    """
    depth_m = padded.depth(approximate_m)
    normal, right = normal_equations(padded, np.arange(len(detection.T)), detection, depth_m)
    own = priors.equations(prior)
    point, covariance = solve_points(normal.sum(axis=1) + own[0], right.sum(axis=1) + own[1])
    distance = squared_distances(padded, point[:, None])
    distance = distance[np.arange(len(detection))[:, None], np.arange(len(detection.T)), detection]
    off = point - priors.mean[prior]
    return Groups(
        detection=detection,
        shared=shared,
        gain=np.where(detection >= 0, UNEXPLAINED_COST - SHARED_COST * shared - distance, 0.0),
        prior=prior,
        min_viewpoints=padded.required_viewpoints(point, priors.min_viewpoints[prior]),
        base_cost=np.where(prior < 0, NEW_GROUP_COST, np.einsum("gi,gij,gj->g", off, own[0], off)),
        point=point,
        covariance=covariance,
    )


def are_valid(
    padded: PaddedSightings, groups: Groups, bounds_m: Float[np.ndarray, "2 3"]
) -> Bool[np.ndarray, "groups"]:
    """Say which groups are seen from enough viewpoints, in bounds, near their expected drone, and lower the cost."""
    seen_enough = have_enough_viewpoints(
        padded, groups.seen & ~groups.shared, groups.seen, groups.min_viewpoints
    )
    return (
        seen_enough
        & are_in_bounds(groups.point, bounds_m)
        & (groups.saving > 0)
        & ((groups.prior < 0) | (groups.base_cost < UNEXPLAINED_COST))
    )


def have_enough_viewpoints(
    padded: PaddedSightings,
    own: Bool[np.ndarray, "*groups cameras"],
    seen: Bool[np.ndarray, "*groups cameras"],
    min_viewpoints: Int[np.ndarray, "..."],
) -> Bool[np.ndarray, "*groups"]:
    """Say which groups are seen from enough viewpoints.

    One of the required viewpoints may see the group by a shared detection, if two or more viewpoints see the group by
    detections of its own.

    Args:
        padded: sightings of the frame.
        own: (groups, cameras), True where the group has a detection that it does not share.
        seen: (groups, cameras), True where the group has a detection.
        min_viewpoints: (groups,), required numbers of viewpoints.
    """
    enough_own = padded.num_viewpoints(own) >= np.maximum(min_viewpoints - 1, 2)
    return enough_own & (padded.num_viewpoints(seen) >= min_viewpoints)


def are_in_bounds(
    points: Float[np.ndarray, "n 3"], bounds_m: Float[np.ndarray, "2 3"]
) -> Bool[np.ndarray, "n"]:
    """Say which points are in bounds."""
    return ((points >= bounds_m[0]) & (points <= bounds_m[1])).all(axis=-1)


def normal_equations(
    padded: PaddedSightings,
    camera: Int[np.ndarray, "*#groups views"],
    detection: Int[np.ndarray, "groups views"],
    depth: Float[np.ndarray, "groups views"],
) -> tuple[Float[np.ndarray, "groups views 3 3"], Float[np.ndarray, "groups views 3"]]:
    """Left and right sides of the detections' normal equations (equations (3)-(6) of the paper).

    Each detection is weighted with its depth to the power of -2, so that the equations measure errors in the image.
    """
    weight = depth**-2.0
    return (
        padded.normal[camera, detection] * weight[..., None, None],
        padded.right[camera, detection] * weight[..., None],
    )


def solve_points(
    normal: Float[np.ndarray, "*groups 3 3"], right: Float[np.ndarray, "*groups 3"]
) -> tuple[Float[np.ndarray, "*groups 3"], Float[np.ndarray, "*groups 3 3"]]:
    """Solve normal equations: points, and their covariances."""
    covariance = np.linalg.inv(normal)
    return np.matvec(covariance, right), covariance


def squared_distances(
    padded: PaddedSightings,
    point: Float[np.ndarray, "groups #cameras 3"],
    covariance: Float[np.ndarray, "groups #cameras 3 3"] | None = None,
) -> Float[np.ndarray, "groups cameras padded"]:
    """Squared distances of all detections from the projections of points, in squared standard deviations.

    With the points' covariances, the distance is the cost that the detection adds to the detections from which the
    point was computed.

    Args:
        padded: sightings of the frame.
        point: (groups, cameras or 1, 3), positions in the world, metres.
        covariance: (groups, cameras or 1, 3, 3), covariances of the points; None for exact points.

    Returns:
        (groups, cameras, padded), infinite for padding, and for points that are not in front of the camera.
    """
    R = padded.T[..., :3]
    in_camera = np.matvec(R, point) + padded.T[..., 3]
    ahead = in_camera[..., 2:] > NEAR_M
    depth = np.where(ahead, in_camera[..., 2:], 1.0)
    x = in_camera[..., :2] / depth
    there = np.isfinite(padded.variance)
    variance = np.where(there, padded.variance, 1.0)
    there = there & ahead
    dx, dy = padded.x[..., 0] - x[..., :1], padded.x[..., 1] - x[..., 1:]
    if covariance is None:
        return np.where(there, (dx * dx + dy * dy) / variance, np.inf)
    J = (R[:, :2] - x[..., None] * R[:, 2:]) / depth[..., None]
    # Where the cameras share a covariance, one product for all of them is faster than one for each.
    rows = J.reshape(len(J), 1, 2 * len(R), 3) if covariance.shape[1] == 1 else J
    JC = (rows @ covariance).reshape(J.shape)
    a, b, c = (np.vecdot(JC[..., i, :], J[..., j, :])[..., None] for i, j in ((0, 0), (0, 1), (1, 1)))
    a, c = a + variance, c + variance
    return np.where(there, (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b), np.inf)
