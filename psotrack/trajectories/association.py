"""Association of estimated drones with reference drones, for a whole run or for each frame.

The estimated drone that is assigned to a reference drone is called its partner; `UNASSIGNED` marks a reference drone
without partner. All assignments are optimal (`scipy.optimize.linear_sum_assignment`) and ignore the names of drones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.errors import InputError
from psotrack.trajectories import Trajectories

Distances = Float[np.ndarray, "frames drones estimates"]
Partners = Int[np.ndarray, "frames drones"]
#: Largest distance between an estimate and a reference drone that it can be assigned to in a frame, metres.
GATE_M = 0.5
#: Time from the first frame of the reference that decides the assignment for the whole run, seconds.
IDENTITY_WINDOW_S = 1.0
#: Partner index of a reference drone without partner.
UNASSIGNED = -1


@dataclass(frozen=True)
class AlignedPair:
    """An estimate and its reference in the evaluated frames: the frames with a known reference position.

    Attributes:
        frame: (frames,), numbers of the frames.
        time_s: (frames,), times of the reference, seconds.
        drones: names of the reference drones with a known position in at least one frame.
        drones_est: names of the estimated drones.
        ref_m: (frames, drones, 3), reference positions, metres; NaN if unknown.
        est_m: (frames, estimates, 3), estimated positions, metres; NaN if there is no estimate or its status is lost.
        orientation_wxyz: (frames, drones, 4), orientations of the reference drones; NaN if unknown.
        orientation_est_wxyz: (frames, estimates, 4), estimated orientations; NaN if unknown.
        covariance_m2: (frames, estimates, 3, 3), covariances of the estimated positions, m²; NaN if unknown.
        relative_covariance_m2: (frames, estimates, 3, 3), the same without the error that is constant for a drone;
            `covariance_m2` if it is not known apart.
        distance_m: (frames, drones, estimates), distances between reference drones and estimates, metres; NaN if one
            of the two is unknown.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    drones: tuple[str, ...]
    drones_est: tuple[str, ...]
    ref_m: Float[np.ndarray, "frames drones 3"]
    est_m: Float[np.ndarray, "frames estimates 3"]
    orientation_wxyz: Float[np.ndarray, "frames drones 4"]
    orientation_est_wxyz: Float[np.ndarray, "frames estimates 4"]
    covariance_m2: Float[np.ndarray, "frames estimates 3 3"]
    relative_covariance_m2: Float[np.ndarray, "frames estimates 3 3"]
    distance_m: Distances

    @property
    def truth_known(self) -> Bool[np.ndarray, "frames drones"]:
        """(frames, drones), True where the reference position is known."""
        return np.isfinite(self.ref_m).all(axis=-1)


def align(traj_est: Trajectories, traj_ref: Trajectories) -> AlignedPair:
    """Bring an estimate to the frames of its reference, in float64.

    Reference frames and drones without a known position are left out, and so are the estimate's frames outside the
    reference. In reference frames that the estimate does not have, all drones count as missed.

    Raises:
        InputError: the reference has no known position, estimate and reference have no frame in common, or a frame has
            another time in the estimate than in the reference.
    """
    known = traj_ref.seen
    rows, columns = known.any(axis=1), known.any(axis=0)
    if not rows.any():
        raise InputError("reference", expected="a known position in at least one frame", found="none")
    frame, own = traj_ref.frame[rows], traj_est.frame
    _, to, source = np.intersect1d(frame, own, assume_unique=True, return_indices=True)
    if not len(to):
        raise InputError(
            "estimate",
            expected=f"frames of the reference, which knows positions from frame {frame[0]} to {frame[-1]}",
            found=f"frames {own[0]} to {own[-1]}" if len(own) else "no frames",
            remedy="check that both belong to the same sequence",
        )
    apart_s = np.abs(traj_est.time_s[source] - traj_ref.time_s[rows][to])
    if len(traj_ref.time_s) > 1 and apart_s.max() > np.median(np.diff(traj_ref.time_s)) / 2:
        worst = int(np.argmax(apart_s))
        raise InputError(
            "estimate",
            expected=f"frame {frame[to[worst]]} at {traj_ref.time_s[rows][to[worst]]:.6g} s, as in the reference",
            found=f"{traj_est.time_s[source[worst]]:.6g} s",
            remedy="read_tracks(path, recording=...) finds the frames by the times",
        )
    kept = np.ix_(rows, columns)
    ref_m = np.where(known[kept][..., None], traj_ref.position_m[kept].astype(np.float64), np.nan)
    orientation_wxyz = np.full((*ref_m.shape[:2], 4), np.nan)
    if traj_ref.orientation_wxyz is not None:
        orientation_wxyz = traj_ref.orientation_wxyz[kept].astype(np.float64)

    def of_estimates(value: np.ndarray | None, *shape: int) -> np.ndarray:
        """The estimate's `value` in the reference's frames."""
        there = np.full((len(frame), traj_est.num_drones, *shape), np.nan)
        if value is not None:
            there[to] = value[source]
        return there

    est_m = of_estimates(np.where(traj_est.seen[..., None], traj_est.position_m, np.nan), 3)
    return AlignedPair(
        frame=frame,
        time_s=traj_ref.time_s[rows].astype(np.float64),
        drones=tuple(np.array(traj_ref.drones, object)[columns]),
        drones_est=traj_est.drones,
        ref_m=ref_m,
        est_m=est_m,
        orientation_wxyz=orientation_wxyz,
        orientation_est_wxyz=of_estimates(traj_est.orientation_wxyz, 4),
        covariance_m2=of_estimates(traj_est.covariance_m2, 3, 3),
        relative_covariance_m2=of_estimates(
            traj_est.covariance_m2
            if traj_est.relative_covariance_m2 is None
            else traj_est.relative_covariance_m2,
            3,
            3,
        ),
        distance_m=np.linalg.norm(ref_m[:, :, None] - est_m[:, None], axis=-1),
    )


def fixed_identity(pair: AlignedPair) -> Int[np.ndarray, "drones"]:
    """One partner per reference drone for the whole run, as in the paper: a track that changes drones gets errors.

    The first optimal assignment uses the mean distance over `IDENTITY_WINDOW_S` from the first reference frame, without
    a gate. Reference drones and tracks that remain without partner, because they appear later, are assigned to each
    other by the mean distance over all frames. A track that then has no partner is a false track, and a reference drone
    without partner is missed.

    Returns:
        (drones,), index of the estimated drone, or `UNASSIGNED`.
    """
    partner = np.full(len(pair.drones), UNASSIGNED)
    first_second = pair.time_s < pair.time_s[0] + IDENTITY_WINDOW_S
    for distance_m in (pair.distance_m[first_second], pair.distance_m):
        drones = np.flatnonzero(partner == UNASSIGNED)
        estimates = np.setdiff1d(np.arange(len(pair.drones_est)), partner)
        known_m = np.ma.masked_invalid(distance_m[:, drones][:, :, estimates])
        rows, columns = _assign(known_m.mean(axis=0).filled(np.nan))
        partner[drones[rows]] = estimates[columns]
    return partner


def partners_per_frame(distance_m: Distances, *, keep: bool) -> Partners:
    """Partners in each frame: the largest number of pairs within `GATE_M`, and among these the least sum of distances.

    Args:
        distance_m: (frames, drones, estimates), distances, metres; NaN if one of the two is not seen.
        keep: keep the pairs of the previous frame that are still within the gate (Bernardin and Stiefelhagen 2008), so
            that two drones that pass each other do not count as an identity switch.

    Returns:
        (frames, drones), index of the estimated drone, or `UNASSIGNED`.
    """
    gated_m = np.where(distance_m <= GATE_M, distance_m, np.nan)
    partners = np.full(distance_m.shape[:2], UNASSIGNED)
    previous = np.full(distance_m.shape[1], UNASSIGNED)
    for cost_m, partner in zip(gated_m, partners, strict=True):
        if keep:
            held = np.flatnonzero(previous != UNASSIGNED)
            held = held[np.isfinite(cost_m[held, previous[held]])]
            partner[held] = previous[held]
        drones = np.flatnonzero(partner == UNASSIGNED)
        estimates = np.setdiff1d(np.arange(cost_m.shape[1]), partner)
        rows, columns = _assign(cost_m[np.ix_(drones, estimates)])
        partner[drones[rows]] = estimates[columns]
        previous = partner
    return partners


def cheapest_partners(cost: Distances) -> Partners:
    """(frames, drones), partners with the least sum of costs in each frame; every possible partner is assigned.

    For metrics in which a bad pair costs as much as no pair.
    """
    partners = np.full(cost.shape[:2], UNASSIGNED)
    for frame_cost, partner in zip(cost, partners, strict=True):
        rows, columns = linear_sum_assignment(frame_cost)
        partner[rows] = columns
    return partners


def paired_values(values: Distances, partners: Partners) -> Float[np.ndarray, "frames drones"]:
    """(frames, drones), value of each reference drone with its partner of the frame; NaN without a partner."""
    if not values.shape[2]:
        return np.full(partners.shape, np.nan)
    picked = np.take_along_axis(values, partners[..., None], axis=2)[..., 0]
    return np.where(partners == UNASSIGNED, np.nan, picked)


def fixed_partner_values(
    values: Float[np.ndarray, "frames estimates *rest"], partner: Int[np.ndarray, "drones"]
) -> Float[np.ndarray, "frames drones *rest"]:
    """(frames, drones, ...), values of each reference drone's partner for the whole run; NaN without a partner.

    Args:
        values: (frames, estimates, ...), values of the estimates.
        partner: (drones,), partners from `fixed_identity`.
    """
    picked = np.full((len(values), len(partner), *values.shape[2:]), np.nan)
    assigned = partner != UNASSIGNED
    picked[:, assigned] = values[:, partner[assigned]]
    return picked


def identity_switches(partners: Partners) -> Bool[np.ndarray, "frames drones"]:
    """(frames, drones), True where a reference drone's partner differs from its previous partner."""
    switched = np.zeros(partners.shape, bool)
    last = np.full(partners.shape[1], UNASSIGNED)
    for switched_in_frame, partner in zip(switched, partners, strict=True):
        matched = partner != UNASSIGNED
        switched_in_frame[:] = matched & (last != UNASSIGNED) & (partner != last)
        last = np.where(matched, partner, last)
    return switched


def _assign(
    cost: Float[np.ndarray, "drones estimates"],
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """The largest number of pairs with finite cost, and among these sets of pairs the one with the least sum."""
    possible = np.isfinite(cost)
    # A forbidden pair costs more than all possible pairs together, so that one more possible pair is always better.
    forbidden = 1.0 + 2.0 * cost[possible].sum()
    rows, columns = linear_sum_assignment(np.where(possible, cost, forbidden))
    kept = possible[rows, columns]
    return rows[kept], columns[kept]
