"""Accuracy of tracks: position errors, missed drones, and whether drones kept their identity.

References:
    K. Bernardin, R. Stiefelhagen, Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics,
    EURASIP Journal on Image and Video Processing, 2008 (MOTA, MOTP, mismatches).
    E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi, Performance Measures and a Data Set for
    Multi-Target, Multi-Camera Tracking, ECCV Workshops, 2016 (IDF1).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from psotrack.evaluation.scores import consistency, gospa, hota, path_errors, rows_apart
from psotrack.evaluation.tables import DroneEvaluation, ErrorSummary, Evaluation
from psotrack.support.standard_errors import standard_error
from psotrack.trajectories import Trajectories
from psotrack.trajectories.association import (
    GATE_M,
    UNASSIGNED,
    AlignedPair,
    Distances,
    align,
    fixed_identity,
    fixed_partner_values,
    identity_switches,
    paired_values,
    partners_per_frame,
)

if TYPE_CHECKING:
    from pandas import DataFrame

logger = logging.getLogger(__name__)

#: Values of the tracks in an `AlignedPair`.
_OF_TRACKS = ("est_m", "orientation_est_wxyz", "covariance_m2", "relative_covariance_m2")
#: Share of the frames after the end of the tracks that is worth a warning.
_MUCH = 0.05


def evaluate(traj_est: Trajectories, traj_ref: Trajectories) -> Evaluation:
    """Compare an estimate with a reference. The names of the estimated tracks do not matter.

    All figures are over the known positions: frames and drones whose position is in the reference. A drone is missed in
    a frame where its position is known and the estimate has no row, or a row with the status lost.

    - Errors are distances between a drone and the track that follows it, where the drone is not missed. The assignment
      of tracks to drones is one for all frames (`association.fixed_identity`), so that a later swap costs.
    - `missed_rate`: missed / known positions; a drone without a track is missed in all its frames.
    - `matched_mean_error_m`: mean distance of the pairs within 0.5 m, when drones and tracks are assigned frame by
      frame.
    - `mota` = 1 - (misses + false positives + `id_switches`) / known, and `motp_m`, the mean distance of the matched
      pairs (Bernardin and Stiefelhagen 2008): pairs are within 0.5 m, a pair of the previous frame is kept while it is
      valid, and an identity switch is a drone matched to another track than at its previous match.
    - `idf1` = 2 IDTP / (known + estimated), where IDTP is the number of frames within 0.5 m under the assignment of
      whole tracks that has the most such frames (Ristani et al. 2016).
    - A track whose drone has no known position in a frame is no false positive, unless it is near another drone.
    - `hota`, `deta`, `assa`, `loca`: see `scores.hota`; `gospa_*`: see `scores.gospa`.
    - `offset_removed_mean_error_m`: the mean error after each drone's mean residual is subtracted: in the body's frame
      where the reference's orientation is known, else in the world's frame. The middles of silhouettes and of marker
      crosses differ from the body's origin, which is no fault of a tracker. In `per_drone`, `offset_m` is this lever
      arm and `offset_standard_error_m` its standard error (see `standard_errors.standard_error`).
    - `ate_*`, `rpe_*`: see `scores.path_errors`. For all drones together, `ate_aligned_rmse_m` aligns all tracks by one
      rigid motion; in `per_drone`, each track by its own.
    - `inside_90_rate`, `mean_nees`, where the estimate has covariances: see `scores.consistency`.

    Args:
        traj_est: the estimate, in the reference's frames.
        traj_ref: the reference.

    Raises:
        InputError: the reference has no known position, both have no frame in common or frames of other times, or a
            covariance of the estimate is not positive definite.
    """
    pair = align(traj_est, traj_ref)
    known = pair.truth_known
    beyond = int((pair.frame > traj_est.frame[-1]).sum())
    if beyond > _MUCH * len(pair.frame):
        logger.warning(
            "the tracks end with frame %d, the reference with frame %d: all drones count as missed in the last %.0f %% "
            "of the frames; were only the first frames tracked (--frames)?",
            traj_est.frame[-1],
            pair.frame[-1],
            100 * beyond / len(pair.frame),
        )
    partner = fixed_identity(pair)
    # Each drone with the track that follows it in all frames.
    followed = {name: fixed_partner_values(getattr(pair, name), partner) for name in _OF_TRACKS}
    residual_m = followed["est_m"] - pair.ref_m
    each_drone = [
        _centre(residual_m[:, drone], pair.orientation_wxyz[:, drone]) for drone in range(len(partner))
    ]
    followed |= {
        "residual_m": residual_m,
        "centred_m": np.stack([centred_m for _, centred_m in each_drone], axis=1),
    }
    kept = partners_per_frame(pair.distance_m, keep=True)
    kept_m = paired_values(pair.distance_m, kept)
    matched_m = paired_values(pair.distance_m, partners_per_frame(pair.distance_m, keep=False))
    _warn_of_millimetres(pair, bool(np.isfinite(matched_m).any()))
    id_switches = int(identity_switches(kept).sum())
    counted = _counted_estimates(pair, partner)
    num_known, num_estimated = int(known.sum()), int(counted.sum())
    num_matched = int(np.isfinite(kept_m).sum())
    misses, false_positives = num_known - num_matched, num_estimated - num_matched
    tracks = {UNASSIGNED: None} | dict(enumerate(pair.drones_est))
    return Evaluation(
        **_errors(pair, followed, slice(None)),
        **vars(hota(pair.distance_m, known, counted)),
        **vars(gospa(pair.distance_m, known, counted)),
        frames=len(pair.frame),
        drones=len(pair.drones),
        id_switches=id_switches,
        mota=1 - (misses + false_positives + id_switches) / num_known,
        motp_m=_mean(kept_m),
        idf1=2 * _identity_true_positives(pair.distance_m) / (num_known + num_estimated),
        matched_mean_error_m=_mean(matched_m),
        per_drone=tuple(
            DroneEvaluation(
                **_errors(pair, followed, slice(drone, drone + 1)),
                drone=name,
                estimate=tracks[partner[drone]],
                frames=int(known[:, drone].sum()),
                **each_drone[drone][0],
            )
            for drone, name in enumerate(pair.drones)
        ),
    )


def _warn_of_millimetres(pair: AlignedPair, has_matches: bool) -> None:
    """Warn of tracks that are nowhere near the reference, and would be near it if their unit was the millimetre."""
    far_m = np.linalg.norm(pair.ref_m[:, :, None] - pair.est_m[:, None] / 1e3, axis=-1)
    near = far_m[np.isfinite(far_m)] < GATE_M
    # Of all pairs of a track and a drone, one in as many as there are drones is right.
    if not has_matches and near.size and near.mean() > 0.5 / max(pair.distance_m.shape[1:]):
        logger.warning(
            "the tracks are far away, and near the reference as millimetres: write their positions in metres"
        )


def errors_over_time(traj_est: Trajectories, traj_ref: Trajectories) -> DataFrame:
    """One row per frame and drone whose position is known, sorted by drone and frame.

    Returns:
        Columns `frame`; `time_s`; `drone`, the drone's name in the reference; `error_m`, distance to the track that
        follows the drone as in `evaluate`, NaN where the drone is missed; and `switch`, whether the drone is matched to
        another track than at its previous match.

    Raises:
        InputError: the estimate and the reference do not fit together.
    """
    import pandas as pd

    pair = align(traj_est, traj_ref)
    error_m = np.linalg.norm(fixed_partner_values(pair.est_m, fixed_identity(pair)) - pair.ref_m, axis=-1)
    switch = identity_switches(partners_per_frame(pair.distance_m, keep=True))
    frame, drone = np.nonzero(pair.truth_known)
    order = np.lexsort((frame, drone))
    frame, drone = frame[order], drone[order]
    return pd.DataFrame(
        {
            "frame": pair.frame[frame],
            "time_s": pair.time_s[frame],
            "drone": pd.Categorical(np.array(pair.drones)[drone], categories=list(pair.drones)),
            "error_m": error_m[frame, drone],
            "switch": switch[frame, drone],
        }
    )


def _counted_estimates(
    pair: AlignedPair, partner: Int[np.ndarray, "drones"]
) -> Bool[np.ndarray, "frames estimates"]:
    """(frames, estimates), the estimates that count as true or false positives.

    An estimate does not count where the position of its own drone is unknown, unless it is near another drone.
    """
    unknown = np.zeros(pair.est_m.shape[:2], bool)
    assigned = partner != UNASSIGNED
    unknown[:, partner[assigned]] = ~pair.truth_known[:, assigned]
    near_a_drone = (pair.distance_m <= GATE_M).any(axis=1)
    return np.isfinite(pair.est_m).all(axis=-1) & (near_a_drone | ~unknown)


def _identity_true_positives(distance_m: Distances) -> int:
    """Number of frames within the gate under the assignment of whole tracks that has the most such frames."""
    together = (distance_m <= GATE_M).sum(axis=0)
    return int(together[linear_sum_assignment(together, maximize=True)].sum())


def _centre(
    residual_m: Float[np.ndarray, "frames 3"], orientation_wxyz: Float[np.ndarray, "frames 4"]
) -> tuple[dict[str, Any], Float[np.ndarray, "frames 3"]]:
    """Figures of the mean residual of one drone, its lever arm, and the residuals without it, in the world.

    The mean is in the body's frame where the orientation is known.
    """
    centred_m = np.full_like(residual_m, np.nan)
    seen = np.isfinite(residual_m).all(axis=-1)
    if not seen.any():
        return {}, centred_m
    in_body = bool(np.isfinite(orientation_wxyz[seen]).all())
    frame_to_world = Rotation.identity()
    if in_body:
        frame_to_world = Rotation.from_quat(orientation_wxyz[seen], scalar_first=True)
    turned_m = frame_to_world.inv().apply(residual_m[seen])
    offset_m = turned_m.mean(axis=0)
    centred_m[seen] = residual_m[seen] - frame_to_world.apply(offset_m)
    found = {"offset_m": tuple(offset_m.tolist()), "offset_frame": "body" if in_body else "world"}
    if len(turned_m) > 1:
        found["offset_standard_error_m"] = tuple(standard_error(turned_m).tolist())
    return found, centred_m


def _errors(pair: AlignedPair, followed: Mapping[str, np.ndarray], drones: slice) -> dict[str, Any]:
    """Figures that are given for each drone and for all drones together."""
    of_tracks = {name: values[:, drones] for name, values in followed.items()}
    residual_m, centred_m = of_tracks["residual_m"], of_tracks["centred_m"]
    error_m, known = np.linalg.norm(residual_m, axis=-1), pair.truth_known[:, drones]
    paths = path_errors(
        of_tracks["est_m"],
        pair.ref_m[:, drones],
        of_tracks["orientation_est_wxyz"],
        pair.orientation_wxyz[:, drones],
        rows_apart(pair.frame, pair.time_s),
    )
    covariances = of_tracks["covariance_m2"], of_tracks["relative_covariance_m2"]
    return {
        **vars(_summary(error_m)),
        **vars(paths),
        **vars(consistency(residual_m, centred_m, *covariances)),
        "missed_rate": float((known & np.isnan(error_m)).sum() / known.sum()),
        "offset_removed_mean_error_m": _mean(np.linalg.norm(centred_m, axis=-1)),
    }


def _summary(error_m: Float[np.ndarray, "*shape"]) -> ErrorSummary:
    known_m = error_m[np.isfinite(error_m)]
    if not len(known_m):
        return ErrorSummary(None, None, None, None, None)
    values = (known_m.mean(), np.median(known_m), known_m.std(), np.percentile(known_m, 95), known_m.max())
    return ErrorSummary(*map(float, values))


def _mean(error_m: Float[np.ndarray, "*shape"]) -> float | None:
    known_m = error_m[np.isfinite(error_m)]
    return float(known_m.mean()) if len(known_m) else None
