"""Groups of detections, each of one drone: where it is, and what is saved by the group."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence.sight import Priors, Sight
from psotrack.geometry import NEAR_M

#: Cost of a detection in no group. One in 1000 of a drone's is farther off (χ², two degrees of freedom).
UNEXPLAINED = 13.8
#: Cost of a group that nobody expects, as much as one detection: it keeps a drone from being made two.
NEW = 13.8
#: Cost of each further drone of a detection, -2 ln of 0.1: how likely two overlap so far that they get one box.
SHARED = 4.6


@dataclass(frozen=True)
class Groups:
    """Groups of detections, or candidates for them.

    Attributes:
        support: (groups, cameras), the detection in each camera, or -1.
        shared: (groups, cameras), whether the detection is another group's, which lets this one share it.
        gain: (groups, cameras), what is saved by the detection being in the group, 0 for none.
        prior: (groups,), index of the expected drone, or -1.
        least: (groups,), viewpoints that it must be seen from.
        price: (groups,), what the group itself costs.
        point, covariance: (groups, 3) and (groups, 3, 3).
    """

    support: Int[np.ndarray, "groups cameras"]
    shared: Bool[np.ndarray, "groups cameras"]
    gain: Float[np.ndarray, "groups cameras"]
    prior: Int[np.ndarray, "groups"]
    least: Int[np.ndarray, "groups"]
    price: Float[np.ndarray, "groups"]
    point: Float[np.ndarray, "groups 3"]
    covariance: Float[np.ndarray, "groups 3 3"]

    def __len__(self) -> int:
        return len(self.support)

    @property
    def seen(self) -> Bool[np.ndarray, "groups cameras"]:
        """Cameras that have a detection of the group."""
        return self.support >= 0

    @property
    def worth(self) -> Float[np.ndarray, "groups"]:
        """How much less the assignment costs with the group than without."""
        return self.gain.sum(axis=-1) - self.price

    def only(self, index: np.ndarray) -> Groups:
        """Those at `index`."""
        return Groups(**{name: value[index] for name, value in vars(self).items()})

    def __add__(self, other: Groups) -> Groups:
        return Groups(
            **{name: np.concatenate([value, vars(other)[name]]) for name, value in vars(self).items()}
        )


def measured(
    sight: Sight,
    priors: Priors,
    support: Int[np.ndarray, "groups cameras"],
    shared: Bool[np.ndarray, "groups cameras"],
    prior: Int[np.ndarray, "groups"],
    near: Float[np.ndarray, "groups 3"],
) -> Groups:
    """The groups of these detections, which are near these points."""
    normal, right = equations(sight, np.arange(len(support.T)), support, sight.depth(near))
    own = priors.equations(prior)
    point, covariance = solved(normal.sum(axis=1) + own[0], right.sum(axis=1) + own[1])
    distance = distances(sight, point[:, None])
    distance = np.take_along_axis(distance, support[..., None], axis=-1)[..., 0]
    off = point - priors.mean[prior]
    return Groups(
        support=support,
        shared=shared,
        gain=np.where(support >= 0, UNEXPLAINED - SHARED * shared - distance, 0.0),
        prior=prior,
        least=priors.least[prior],
        price=np.where(prior < 0, NEW, np.einsum("gi,gij,gj->g", off, own[0], off)),
        point=point,
        covariance=covariance,
    )


def valid(sight: Sight, groups: Groups, bounds_m: Float[np.ndarray, "2 3"]) -> Bool[np.ndarray, "groups"]:
    """Which groups may be: seen from enough viewpoints, in bounds, near what is expected, and worth something."""
    kept = enough(sight, groups.seen & ~groups.shared, groups.seen, groups.least)
    return (
        kept
        & within(groups.point, bounds_m)
        & (groups.worth > 0)
        & ((groups.prior < 0) | (groups.price < UNEXPLAINED))
    )


def enough(
    sight: Sight,
    own: Bool[np.ndarray, "*groups cameras"],
    seen: Bool[np.ndarray, "*groups cameras"],
    least: Int[np.ndarray, "..."],
) -> Bool[np.ndarray, "*groups"]:
    """Which groups are seen from enough viewpoints. One of these may be by a shared detection, if two are not."""
    return (sight.num_viewpoints(own) >= np.maximum(least - 1, 2)) & (sight.num_viewpoints(seen) >= least)


def within(points: Float[np.ndarray, "n 3"], bounds_m: Float[np.ndarray, "2 3"]) -> Bool[np.ndarray, "n"]:
    """Which points are in bounds."""
    return ((points >= bounds_m[0]) & (points <= bounds_m[1])).all(axis=-1)


def equations(
    sight: Sight,
    camera: Int[np.ndarray, "*#groups views"],
    support: Int[np.ndarray, "groups views"],
    depth: Float[np.ndarray, "groups views"],
) -> tuple[Float[np.ndarray, "groups views 3 3"], Float[np.ndarray, "groups views 3"]]:
    """Normal equations (3)-(6) of the detections. With their depths known they measure errors in the image."""
    weight = depth**-2.0
    return (
        sight.normal[camera, support] * weight[..., None, None],
        sight.right[camera, support] * weight[..., None],
    )


def solved(
    normal: Float[np.ndarray, "*groups 3 3"], right: Float[np.ndarray, "*groups 3"]
) -> tuple[Float[np.ndarray, "*groups 3"], Float[np.ndarray, "*groups 3 3"]]:
    """Points and their covariances."""
    covariance = np.linalg.inv(normal)
    return (covariance @ right[..., None])[..., 0], covariance


def distances(
    sight: Sight,
    point: Float[np.ndarray, "groups #cameras 3"],
    covariance: Float[np.ndarray, "groups #cameras 3 3"] | None = None,
) -> Float[np.ndarray, "groups cameras padded"]:
    """Squared distance in standard deviations of every detection from where points are seen; infinite for none.

    With the points' covariances it is what a detection adds to the cost of those that the point is from.
    """
    seen = (sight.T[:, :, :3] @ point[..., None])[..., 0] + sight.T[:, :, 3]
    ahead = seen[..., 2] > NEAR_M
    depth = np.where(ahead, seen[..., 2], 1.0)
    x = seen[..., :2] / depth[..., None]
    there = np.isfinite(sight.variance)
    variance = np.where(there, sight.variance, 1.0)
    there = there & ahead[..., None]
    dx, dy = sight.x[..., 0] - x[..., :1], sight.x[..., 1] - x[..., 1:]
    if covariance is None:
        return np.where(there, (dx * dx + dy * dy) / variance, np.inf)
    J = (sight.T[:, :2, :3] - x[..., None] * sight.T[:, 2:, :3]) / depth[..., None, None]
    S = J @ covariance @ J.swapaxes(-1, -2)
    a, b, c = S[..., 0, 0, None] + variance, S[..., 0, 1, None], S[..., 1, 1, None] + variance
    return np.where(there, (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b), np.inf)
