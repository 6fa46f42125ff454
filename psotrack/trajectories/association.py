"""Which estimated drone stands for which true one: once for a whole run, or anew in each frame.

`UNASSIGNED` marks a true drone without a partner. All assignments are optimal
(`scipy.optimize.linear_sum_assignment`), and all of them are blind to the names of the estimated drones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.errors import InputError
from psotrack.trajectories import Trajectories

#: An estimate further than this from a true drone is not a sighting of it.
GATE_M = 0.5
#: How much of the beginning decides who is who, from the first frame with truth.
IDENTITY_WINDOW_S = 1.0
#: In place of the index of an estimated drone.
UNASSIGNED = -1


@dataclass(frozen=True)
class AlignedPair:
    """An estimate and its reference over the frames that count: those in which some true drone is known.

    Attributes:
        frame: (frames,), numbers of the frames.
        time_s: (frames,), the reference's times.
        drones: names of the true drones that are known in some frame.
        drones_est: names of the estimated drones.
        ref_m: (frames, drones, 3), NaN where the truth is unknown.
        est_m: (frames, estimates, 3), NaN where there is no row, or a lost one.
        orientation_wxyz: (frames, drones, 4), of the truth; NaN where unknown.
        orientation_est_wxyz: (frames, estimates, 4), of the estimates; NaN where unknown.
        covariance_m2: (frames, estimates, 3, 3), of the estimates' positions; NaN where unknown.
        distance_m: (frames, drones, estimates), NaN where either is.
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
    distance_m: Float[np.ndarray, "frames drones estimates"]

    @property
    def truth_known(self) -> Bool[np.ndarray, "frames drones"]:
        """(frames, drones), what is there to be found."""
        return np.isfinite(self.ref_m).all(axis=-1)


def align(traj_est: Trajectories, traj_ref: Trajectories) -> AlignedPair:
    """Bring an estimate to the frames of its reference, in float64.

    Frames and drones of which nothing is known do not count; neither do the estimate's frames outside the
    reference. Reference frames that the estimate does not have are missed in full.

    Raises:
        InputError: nothing is known in the reference, or the two have no frame in common.
    """
    known = traj_ref.seen
    rows, columns = known.any(axis=1), known.any(axis=0)
    if not rows.any():
        raise InputError("reference", expected="a known position in at least one frame", found="none")
    frame = traj_ref.frame[rows]
    _, to, source = np.intersect1d(frame, traj_est.frame, assume_unique=True, return_indices=True)
    if not len(to):
        raise InputError(
            "estimate",
            expected=f"frames of the reference, which knows positions from frame {frame[0]} to {frame[-1]}",
            found=_span(traj_est.frame),
            remedy="check that both belong to the same sequence",
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
        distance_m=np.linalg.norm(ref_m[:, :, None] - est_m[:, None], axis=-1),
    )


def fixed_identity(pair: AlignedPair) -> Int[np.ndarray, "drones"]:
    """Who is who, decided once: a track that later moves to another drone pays for it, as in the paper.

    One optimal assignment on the mean distance over the first second from the first frame with truth, at
    whatever distance. Drones without a partner by then (true ones that appear later, tracks that are born
    later) are assigned to each other in the same way, over all frames. What is left after that stays without:
    a surplus track is a false one, a surplus true drone is missed.

    Returns:
        (drones,), index of the estimated drone, or `UNASSIGNED`.
    """
    partner = np.full(len(pair.drones), UNASSIGNED)
    first_second = pair.time_s < pair.time_s[0] + IDENTITY_WINDOW_S
    for distance_m in (pair.distance_m[first_second], pair.distance_m):
        drones = np.flatnonzero(partner == UNASSIGNED)
        estimates = np.setdiff1d(np.arange(len(pair.drones_est)), partner)
        mean_m = _mean_over_frames(distance_m[:, drones][:, :, estimates])
        rows, columns = _assign(mean_m)
        partner[drones[rows]] = estimates[columns]
    return partner


def matched_per_frame(
    distance_m: Float[np.ndarray, "frames drones estimates"], *, keep: bool
) -> Int[np.ndarray, "frames drones"]:
    """Who is who in each frame: as many pairs within `GATE_M` as can be, then the least sum of distances.

    Args:
        distance_m: (frames, drones, estimates), NaN where either is not seen.
        keep: pairs of the previous frame that are still within the gate stay (Bernardin and Stiefelhagen
            2008), so that two drones that pass each other do not count as confused.

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


def cheapest_partners(cost: Float[np.ndarray, "frames drones estimates"]) -> Int[np.ndarray, "frames drones"]:
    """(frames, drones), partners of the least sum of costs in each frame, as many as there can be.

    For costs that make a bad pair as good as none.
    """
    partners = np.full(cost.shape[:2], UNASSIGNED)
    for here, partner in zip(cost, partners, strict=True):
        rows, columns = linear_sum_assignment(here)
        partner[rows] = columns
    return partners


def paired_values(
    values: Float[np.ndarray, "frames drones estimates"], partners: Int[np.ndarray, "frames drones"]
) -> Float[np.ndarray, "frames drones"]:
    """(frames, drones), between each true drone and its partner; NaN where it has none, or either is not seen."""
    if not values.shape[2]:
        return np.full(partners.shape, np.nan)
    picked = np.take_along_axis(values, partners[..., None], axis=2)[..., 0]
    return np.where(partners == UNASSIGNED, np.nan, picked)


def of_partners(
    values: Float[np.ndarray, "frames estimates *rest"], partner: Int[np.ndarray, "drones"]
) -> Float[np.ndarray, "frames drones *rest"]:
    """What belongs to the estimate that stands for each true drone throughout; NaN where none does."""
    picked = np.full((len(values), len(partner), *values.shape[2:]), np.nan)
    assigned = partner != UNASSIGNED
    picked[:, assigned] = values[:, partner[assigned]]
    return picked


def identity_switches(partners: Int[np.ndarray, "frames drones"]) -> Bool[np.ndarray, "frames drones"]:
    """(frames, drones), where a true drone has another partner than when it last had one."""
    switched = np.zeros(partners.shape, bool)
    last = np.full(partners.shape[1], UNASSIGNED)
    for here, partner in zip(switched, partners, strict=True):
        matched = partner != UNASSIGNED
        here[:] = matched & (last != UNASSIGNED) & (partner != last)
        last = np.where(matched, partner, last)
    return switched


def _assign(
    cost: Float[np.ndarray, "drones estimates"],
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """The most pairs of finite cost that there can be, and among those the least sum of costs."""
    possible = np.isfinite(cost)
    # Dearer than any set of possible pairs, so that one more possible pair always pays.
    forbidden = 1.0 + 2.0 * cost[possible].sum()
    rows, columns = linear_sum_assignment(np.where(possible, cost, forbidden))
    kept = possible[rows, columns]
    return rows[kept], columns[kept]


def _mean_over_frames(
    distance_m: Float[np.ndarray, "frames drones estimates"],
) -> Float[np.ndarray, "drones estimates"]:
    """Mean over the frames in which both are seen; NaN where there are none."""
    both = np.isfinite(distance_m)
    count = both.sum(axis=0)
    total_m = np.where(both, distance_m, 0.0).sum(axis=0)
    return np.where(count > 0, total_m / np.maximum(count, 1), np.nan)


def _span(frame: Int[np.ndarray, "frames"]) -> str:
    return f"frames {frame[0]} to {frame[-1]}" if len(frame) else "no frames"
