"""Matching of detections over cameras: `match` computes drones from cameras and pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.geometry import Camera, Rig
from psotrack.tracking.matching.assignment import apply_exchanges, assign_groups, propose_exchanges
from psotrack.tracking.matching.groups import UNEXPLAINED_COST, Groups
from psotrack.tracking.matching.padded_sightings import BY_PLACE, PaddedSightings, make_priors, pad_sightings
from psotrack.tracking.matching.proposals import propose_groups

#: Drones are searched up to this many times the distance between the outermost cameras, metres at least.
REACH, LEAST_REACH_M = 20.0, 20.0
#: No drone is expected.
NOTHING_EXPECTED = np.empty((0, 3)), np.empty((0, 3, 3))


@dataclass(frozen=True)
class Matches:
    """Drones in one frame, and the detections of each drone.

    Attributes:
        position_m: (drones, 3), positions in the world, metres.
        detection: (drones, cameras), index of the drone's detection in each camera; -1 for no detection. Two drones
            that overlap in an image may share a detection.
        ambiguity: (drones,), from 0 to 1: likelihood, relative to this assignment, of the best other assignment that
            was found and in which some of the drone's detections belong to a drone at another place.
        expected: (drones,), index of the expected drone; -1 for a drone that was not expected.
    """

    position_m: Float[np.ndarray, "drones 3"]
    detection: Int[np.ndarray, "drones cameras"]
    ambiguity: Float[np.ndarray, "drones"]
    expected: Int[np.ndarray, "drones"]


def match(
    cameras: Camera,
    points_px: Float[np.ndarray, "cameras boxes 2"],
    noise_px: Float[np.ndarray, "cameras boxes"],
    *,
    bounds_m: Float[np.ndarray, "2 3"],
    min_views: int | None = 3,
    expected: tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3 3"]] = NOTHING_EXPECTED,
) -> Matches:
    """Find the groups of detections that have the smallest total cost (see `psotrack.tracking.matching`).

    Two viewpoints are enough for an expected drone. They are also enough if no camera has more than one detection and
    at most one drone is expected, because then no detections can be confused. The positions are compromises of
    the detections and the expected positions.

    Args:
        cameras: cameras with one leading axis.
        points_px: (cameras, boxes, 2), middles of the detections, pixels; NaN for no detection.
        noise_px: (cameras, boxes), standard deviations of the middles along each axis, pixels; above 0, or NaN for
            no detection.
        bounds_m: (2, 3), corners of the region where drones can be, metres.
        min_views: smallest number of viewpoints (see `psotrack.geometry.viewpoints`), 2 or more; None: three where at
            least three viewpoints have the place in view, else two.
        expected: predicted positions of drones in the world, (known, 3), metres, and their covariances, (known, 3, 3),
            square metres.
    """
    padded = pad_sightings(cameras, points_px, noise_px)
    unambiguous = len(expected[0]) < 2 and np.isfinite(padded.variance).sum(axis=1).max(initial=0) < 2
    least = 2 if unambiguous else BY_PLACE if min_views is None else min_views
    priors = make_priors(bounds_m, *expected, least)
    proposed = propose_groups(padded, priors, bounds_m)
    groups = assign_groups(padded, proposed, priors, bounds_m)
    return Matches(groups.point, groups.detection, _ambiguity(padded, groups, proposed), groups.prior)


def _ambiguity(padded: PaddedSightings, groups: Groups, proposed: Groups) -> Float[np.ndarray, "groups"]:
    """For each group, the likelihood of the best other assignment relative to this assignment (see `Matches`).

    A rival of a group is a candidate that has some of the group's detections, has other detections in other cameras
    of the group, and is at a place that the group's detections exclude. Each rival is put into the assignment at any
    cost, and the remaining detections are assigned anew.
    """
    both = proposed.seen[:, None] & groups.seen
    same = proposed.detection[:, None] == groups.detection
    off = proposed.point[:, None] - groups.point
    elsewhere = np.einsum("pgi,gij,pgj->pg", off, np.linalg.inv(groups.covariance), off) > UNEXPLAINED_COST
    rival = (both & same).any(axis=-1) & (both & ~same).any(axis=-1) & elsewhere
    ambiguity = np.zeros(len(groups))
    if not rival.any():
        return ambiguity
    exchanges = propose_exchanges(padded, groups, proposed, forced=True)
    value = np.where(rival, exchanges.value[:, None], -np.inf)
    for which in np.unique(value.argmax(axis=0)[rival.any(axis=0)]):
        gained = exchanges.value[which]
        if exchanges.broken[which].any():
            # The remaining detections may form other groups, but must not take detections of the rival.
            taken = (proposed.detection == proposed.detection[which]) & proposed.seen[which]
            others = proposed.only(~taken.any(axis=-1))
            other = apply_exchanges(padded, exchanges.apply(groups, proposed, int(which)), others)
            gained = other.saving.sum() - groups.saving.sum()
        likelihood = np.exp(min(gained, 0.0) / 2)
        ambiguity[rival[which]] = np.maximum(ambiguity[rival[which]], likelihood)
    return ambiguity


def wide_bounds(rig: Rig) -> Float[np.ndarray, "2 3"]:
    """(2, 3), corners of a region so wide that no drone is outside, metres, for recordings without given bounds.

    Drones fly far above cameras on the ground.
    """
    centre_m = rig.cameras.centre_world
    reach_m = max(REACH * float(np.linalg.norm(np.ptp(centre_m, axis=0))), LEAST_REACH_M)
    return np.stack([centre_m.min(axis=0) - reach_m, centre_m.max(axis=0) + reach_m])
