"""How good a track is: position errors, what was missed, and whether drones kept their identity.

References:
    K. Bernardin, R. Stiefelhagen, Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics,
    EURASIP Journal on Image and Video Processing, 2008 (MOTA, MOTP, mismatches).
    E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi, Performance Measures and a Data Set for
    Multi-Target, Multi-Camera Tracking, ECCV Workshops, 2016 (IDF1).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from psotrack.evaluation.association import (
    GATE_M,
    UNASSIGNED,
    AlignedPair,
    align,
    fixed_identity,
    identity_switches,
    matched_per_frame,
    paired_distances,
)
from psotrack.trajectories import Trajectories


@dataclass(frozen=True)
class ErrorSummary:
    """Of the distances between true and estimated positions; all None where there are none.

    The standard deviation is that of the distances about their mean (divided by their number); p95 is the
    95th percentile, interpolated.
    """

    mean_error_m: float | None
    median_error_m: float | None
    std_error_m: float | None
    p95_error_m: float | None
    max_error_m: float | None


@dataclass(frozen=True)
class DroneEvaluation(ErrorSummary):
    """The errors of one true drone.

    Attributes:
        drone: its name in the reference.
        estimate: name of the estimated drone that stands for it, or None.
        frames: in which its true position is known.
        missed_rate: share of those frames without a row, or with a lost one.
        offset_removed_mean_error_m: mean error when the mean residual is taken out; None if never seen.
        offset_m: that residual, estimate minus truth, (x, y, z); None if never seen.
        offset_frame: of `offset_m`: the true body's where its orientation is known in every frame of it, else
            the world's.
    """

    drone: str
    estimate: str | None
    frames: int
    missed_rate: float
    offset_removed_mean_error_m: float | None
    offset_m: tuple[float, float, float] | None
    offset_frame: Literal["body", "world"] | None


@dataclass(frozen=True)
class Evaluation(ErrorSummary):
    """An estimate judged by its reference; see `evaluate` for the definitions."""

    frames: int
    drones: int
    missed_rate: float
    id_switches: int
    mota: float
    motp_m: float | None
    idf1: float
    matched_mean_error_m: float | None
    offset_removed_mean_error_m: float | None
    per_drone: tuple[DroneEvaluation, ...]

    def to_dict(self) -> dict[str, Any]:
        """The contract for other programs: fit for strict JSON, with null where there is no number."""
        values = asdict(self)
        return {key: values[key] for key in _CONTRACT} | {
            "per_drone": [{key: drone[key] for key in _CONTRACT_DRONE} for drone in values["per_drone"]]
        }


#: Keys of `Evaluation.to_dict`, in this order.
_CONTRACT = (
    "frames",
    "drones",
    "mean_error_m",
    "median_error_m",
    "std_error_m",
    "p95_error_m",
    "max_error_m",
    "missed_rate",
    "id_switches",
    "mota",
    "motp_m",
    "idf1",
    "matched_mean_error_m",
    "offset_removed_mean_error_m",
    "per_drone",
)
_CONTRACT_DRONE = (
    "drone",
    "estimate",
    "frames",
    "mean_error_m",
    "median_error_m",
    "std_error_m",
    "p95_error_m",
    "max_error_m",
    "missed_rate",
    "offset_removed_mean_error_m",
    "offset_m",
    "offset_frame",
)


def evaluate(traj_est: Trajectories, traj_ref: Trajectories) -> Evaluation:
    """Judge an estimate by its reference. The names of the estimated drones do not matter.

    What counts: the frames of the reference in which some drone's position is known, and in each the drones
    whose position is known (`frames`, `drones` and all rates are over these). Missed: no row in the estimate,
    or a lost one.

    - Errors are distances between a true drone and the estimate that stands for it, wherever it is not
      missed. Identity is fixed once (`association.fixed_identity`), so that a later swap costs.
    - `missed_rate`: missed / known, over frames and drones; a true drone without partner is missed
      throughout.
    - `matched_mean_error_m`: the mean over pairs that are assigned anew in each frame, within 0.5 m.
    - `mota` = 1 - (misses + false positives + `id_switches`) / known, and `motp_m`, the mean distance of the
      matched pairs in metres (Bernardin and Stiefelhagen 2008): pairs within 0.5 m, a pair of the previous
      frame is kept while it is valid, and a switch is a true drone matched to another estimate than when it
      was last matched.
    - `idf1` = 2 IDTP / (known + estimated), with the one assignment of whole tracks that has the most frames
      within 0.5 m, IDTP (Ristani et al. 2016).
    - An estimate whose own drone is unknown in a frame, and that is near no other, is no false positive.
    - `offset_removed_mean_error_m`: the mean error after one constant offset per drone, its mean residual, is
      taken out: in the true body's frame where the orientation is known, else in the world's. Silhouettes
      and marker crosses have their middle elsewhere than the body's origin; that is no fault of a tracker.

    Args:
        traj_est: the estimate; its times are not used.
        traj_ref: the reference.

    Raises:
        InputError: nothing is known in the reference, or the two have no frame in common.
    """
    pair = align(traj_est, traj_ref)
    known = pair.truth_known
    partner = fixed_identity(pair)
    error_m = paired_distances(pair.distance_m, np.broadcast_to(partner, known.shape))
    residuals = [_residuals(pair, drone, estimate) for drone, estimate in enumerate(partner.tolist())]

    kept = matched_per_frame(pair.distance_m, keep=True)
    kept_m = paired_distances(pair.distance_m, kept)
    matched_m = paired_distances(pair.distance_m, matched_per_frame(pair.distance_m, keep=False))
    id_switches = int(identity_switches(kept).sum())
    num_known, num_estimated = int(known.sum()), int(_counted_estimates(pair, partner).sum())
    num_matched = int(np.isfinite(kept_m).sum())
    misses, false_positives = num_known - num_matched, num_estimated - num_matched
    return Evaluation(
        **_summary(error_m),
        frames=len(pair.frame),
        drones=len(pair.drones),
        missed_rate=_missed_rate(error_m, known),
        id_switches=id_switches,
        mota=1 - (misses + false_positives + id_switches) / num_known,
        motp_m=_mean(kept_m),
        idf1=2 * _identity_true_positives(pair.distance_m) / (num_known + num_estimated),
        matched_mean_error_m=_mean(matched_m),
        offset_removed_mean_error_m=_mean(np.concatenate([drone.remaining_m for drone in residuals])),
        per_drone=tuple(
            DroneEvaluation(
                **_summary(error_m[:, drone]),
                drone=name,
                estimate=None if partner[drone] == UNASSIGNED else pair.drones_est[partner[drone]],
                frames=int(known[:, drone].sum()),
                missed_rate=_missed_rate(error_m[:, drone], known[:, drone]),
                offset_removed_mean_error_m=_mean(residuals[drone].remaining_m),
                offset_m=residuals[drone].offset_m,
                offset_frame=residuals[drone].offset_frame,
            )
            for drone, name in enumerate(pair.drones)
        ),
    )


def _counted_estimates(
    pair: AlignedPair, partner: Int[np.ndarray, "drones"]
) -> Bool[np.ndarray, "frames estimates"]:
    """(frames, estimates), those that a matching may find right or wrong.

    An estimate that follows its own drone while nobody knows where that is cannot be judged, unless it is
    near another.
    """
    unjudged = np.zeros(pair.est_m.shape[:2], bool)
    assigned = partner != UNASSIGNED
    unjudged[:, partner[assigned]] = ~pair.truth_known[:, assigned]
    near_some = (pair.distance_m <= GATE_M).any(axis=1)
    return np.isfinite(pair.est_m).all(axis=-1) & (near_some | ~unjudged)


def _identity_true_positives(distance_m: Float[np.ndarray, "frames drones estimates"]) -> int:
    """Frames within the gate under the assignment of whole tracks that has the most of them."""
    together = (distance_m <= GATE_M).sum(axis=0)
    return int(together[linear_sum_assignment(together, maximize=True)].sum())


@dataclass(frozen=True)
class _Residuals:
    """What is between one true drone and its estimate: a constant, and what remains."""

    remaining_m: Float[np.ndarray, "seen"]
    offset_m: tuple[float, float, float] | None = None
    offset_frame: Literal["body", "world"] | None = None


def _residuals(pair: AlignedPair, drone: int, estimate: int) -> _Residuals:
    if estimate == UNASSIGNED:
        return _Residuals(np.empty(0))
    residual_m = pair.est_m[:, estimate] - pair.ref_m[:, drone]
    seen = np.isfinite(residual_m).all(axis=-1)
    residual_m, orientation_wxyz = residual_m[seen], pair.orientation_wxyz[seen, drone]
    if not len(residual_m):
        return _Residuals(np.empty(0))
    in_body = bool(np.isfinite(orientation_wxyz).all())
    if in_body:
        world_to_body = Rotation.from_quat(orientation_wxyz, scalar_first=True).inv()
        residual_m = world_to_body.apply(residual_m)
    offset_m = residual_m.mean(axis=0)
    x, y, z = offset_m.tolist()
    return _Residuals(
        np.linalg.norm(residual_m - offset_m, axis=-1), (x, y, z), "body" if in_body else "world"
    )


def _missed_rate(error_m: Float[np.ndarray, "*shape"], known: Bool[np.ndarray, "*shape"]) -> float:
    return float((known & np.isnan(error_m)).sum() / known.sum())


def _mean(error_m: Float[np.ndarray, "*shape"]) -> float | None:
    there = error_m[np.isfinite(error_m)]
    return float(there.mean()) if len(there) else None


def _summary(error_m: Float[np.ndarray, "*shape"]) -> dict[str, float | None]:
    there = error_m[np.isfinite(error_m)]
    names = [field.name for field in fields(ErrorSummary)]
    if not len(there):
        return dict.fromkeys(names)
    values = (there.mean(), np.median(there), there.std(), np.percentile(there, 95), there.max())
    return {name: float(value) for name, value in zip(names, values, strict=True)}
