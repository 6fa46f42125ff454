"""Matching detections over cameras: `match`, from cameras and pixels to drones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.correspondence.groups import SHARED, UNEXPLAINED, Groups
from psotrack.correspondence.packing import exchanged, offers_of, packed
from psotrack.correspondence.proposals import proposals
from psotrack.correspondence.sight import Sight, priors_of, sight_of
from psotrack.errors import SettingsError
from psotrack.geometry import Camera, triangulate


@dataclass(frozen=True)
class Matches:
    """Drones in one frame, each with the detections that are of it.

    Attributes:
        position_m: (drones, 3), by `triangulate`, world, metres.
        detection: (drones, cameras), index of the detection that each camera sees the drone at, -1 for none. Two drones
            that overlap in an image may share one.
        cost: (drones,), mean over these detections of the squared distance from where the drone is seen, in standard
            deviations: about 2 - 3 / n for n of them.
        ambiguity: (drones,), 0 to 1, likelihood relative to this assignment of the best other one found in which some
            of these detections are of a drone elsewhere.
        expected: (drones,), index of the expected drone that it is, -1 for one that nobody expected.
    """

    position_m: Float[np.ndarray, "drones 3"]
    detection: Int[np.ndarray, "drones cameras"]
    cost: Float[np.ndarray, "drones"]
    ambiguity: Float[np.ndarray, "drones"]
    expected: Int[np.ndarray, "drones"]


def match(
    cameras: Camera,
    points_px: list[Float[np.ndarray, "_ 2"]],
    noise_px: list[Float[np.ndarray, "_"]],
    *,
    bounds_m: Float[np.ndarray, "2 3"],
    min_views: int = 3,
    expected_m: Float[np.ndarray, "known 3"] | None = None,
    expected_covariance_m2: Float[np.ndarray, "known 3 3"] | None = None,
) -> Matches:
    """The groups of detections with the least total cost (see `psotrack.correspondence`).

    Two viewpoints are enough for a drone that is expected; and where no camera has more than one detection, for then
    there is nothing to confuse. The position is from the detections alone: what was expected only helps to tell whose
    they are.

    Args:
        cameras: with one leading axis.
        points_px: for each camera (n, 2), middles of detections; n may be 0, and what is not finite is no detection.
        noise_px: for each camera (n,), their standard deviations along either axis.
        bounds_m: (2, 3), corners of the region where drones are.
        min_views: least number of viewpoints (see `triangulation.viewpoints`), 2 or more.
        expected_m: (known, 3), predicted positions of drones, world.
        expected_covariance_m2: (known, 3, 3), covariances of the predictions.

    Raises:
        SettingsError: a noise is not above 0, predictions come without covariances or the reverse, or fewer than two
            views are to be enough.
    """
    if (expected_m is None) != (expected_covariance_m2 is None):
        raise SettingsError(
            "expected_m", expected="predictions with covariances", found="one without the other"
        )
    if min_views < 2:
        raise SettingsError("min_views", expected="2 or more", found=f"{min_views}")
    if expected_m is None or expected_covariance_m2 is None:
        expected_m, expected_covariance_m2 = np.empty((0, 3)), np.empty((0, 3, 3))
    alone = len(expected_m) < 2 and max(map(len, points_px), default=0) < 2
    priors = priors_of(bounds_m, expected_m, expected_covariance_m2, 2 if alone else min_views)
    sight = sight_of(cameras, points_px, noise_px)
    proposed = proposals(sight, priors, bounds_m)
    return _matches(sight, packed(sight, proposed, priors, bounds_m), proposed)


def _matches(sight: Sight, groups: Groups, proposed: Groups) -> Matches:
    views = np.arange(len(sight.x)), groups.support
    x = np.where(groups.seen[..., None], sight.x[views], np.nan)
    weights = 1 / (sight.variance[views] * sight.depth(groups.point) ** 2)
    position = triangulate(sight.straight, x, weights)
    squared = np.where(groups.seen, UNEXPLAINED - SHARED * groups.shared - groups.gain, 0.0)
    # Rays of two views may be parallel.
    there = np.isfinite(position).all(axis=-1)
    return Matches(
        position_m=position[there],
        detection=groups.support[there],
        cost=(squared.sum(axis=-1) / groups.seen.sum(axis=-1))[there],
        ambiguity=_ambiguity(sight, groups, proposed)[there],
        expected=groups.prior[there],
    )


def _ambiguity(sight: Sight, groups: Groups, proposed: Groups) -> Float[np.ndarray, "groups"]:
    """Likelihood relative to this assignment of the best other one found, for each group (see `Matches`).

    A rival of a group is a candidate that has some of its detections, another one in place of some, and a place that
    the group's detections do not speak for. It is put in, whatever that costs, and what is left completed.
    """
    both = proposed.seen[:, None] & groups.seen
    same = proposed.support[:, None] == groups.support
    off = proposed.point[:, None] - groups.point
    elsewhere = np.einsum("pgi,gij,pgj->pg", off, np.linalg.inv(groups.covariance), off) > UNEXPLAINED
    rival = (both & same).any(axis=-1) & (both & ~same).any(axis=-1) & elsewhere
    ambiguity = np.zeros(len(groups))
    if not rival.any():
        return ambiguity
    offers = offers_of(sight, groups, proposed, forced=True)
    value = np.where(rival, offers.value[:, None], -np.inf)
    for which in np.unique(value.argmax(axis=0)[rival.any(axis=0)]):
        gained = offers.value[which]
        if offers.broken[which].any():
            # What is left may be of other drones. The rival stays: nothing is taken from it.
            taken = (proposed.support == proposed.support[which]) & proposed.seen[which]
            others = proposed.only(~taken.any(axis=-1))
            other = exchanged(sight, offers.accepted(groups, proposed, int(which)), others)
            gained = other.worth.sum() - groups.worth.sum()
        likelihood = np.exp(min(gained, 0.0) / 2)
        ambiguity[rival[which]] = np.maximum(ambiguity[rival[which]], likelihood)
    return ambiguity
