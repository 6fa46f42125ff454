"""Errors of whole paths, as in benchmarks of SLAM: absolute trajectory error (ATE) and relative pose error (RPE).

J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, A Benchmark for the Evaluation of RGB-D SLAM Systems,
IROS 2012.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.evaluation.records import PathErrors
from psotrack.support import similarity

#: Time between the two poses of a relative pose error, seconds.
RPE_SPAN_S = 1.0


def path_errors(
    est_m: Float[np.ndarray, "frames drones 3"],
    ref_m: Float[np.ndarray, "frames drones 3"],
    orientation_est_wxyz: Float[np.ndarray, "frames drones 4"],
    orientation_wxyz: Float[np.ndarray, "frames drones 4"],
    later: Int[np.ndarray, "2 pairs"],
) -> PathErrors:
    """Compute ATE and RPE over the frames and drones where estimate and reference are known.

    - ATE: distances between estimate and reference in the same frame. The aligned ATE is computed after the rigid
      motion of all estimates (rotation and translation, no scale, no reflection) that gives the smallest mean square.
      It ignores a rotation or a shift between the two worlds, and a constant offset in the world.
    - RPE: length of the difference between the estimated and the true displacement over a second. Sturm et al. rotate
      displacements into the bodies first. Here they stay in the world, so that methods with and without orientations
      are compared equally. A constant offset in the world does not change it.
    - RPE of rotations: angle between the estimated and the true rotation over a second.

    Args:
        est_m: (frames, drones, 3), estimated positions; NaN where not known.
        ref_m: (frames, drones, 3), reference positions; NaN where not known.
        orientation_est_wxyz: (frames, drones, 4), estimated orientations, body to world.
        orientation_wxyz: (frames, drones, 4), reference orientations, body to world.
        later: rows of frames that are `RPE_SPAN_S` apart, from `rows_apart`.
    """
    residual_m = est_m - ref_m
    known = np.isfinite(residual_m).all(axis=-1)
    first, second = later
    off_m = np.empty((0, 3))
    if known.any():
        _, R, shift_m = similarity(est_m[known], ref_m[known], with_scale=False)
        off_m = est_m[known] @ R.T + shift_m - ref_m[known]
    return PathErrors(
        ate_rmse_m=_rmse(np.linalg.norm(residual_m, axis=-1)),
        ate_aligned_rmse_m=_rmse(np.linalg.norm(off_m, axis=-1)),
        # The difference of two displacements is the displacement of the residual.
        rpe_1s_rmse_m=_rmse(np.linalg.norm(residual_m[second] - residual_m[first], axis=-1)),
        rpe_1s_rotation_rmse_deg=_rmse(_turn_errors_deg(orientation_est_wxyz, orientation_wxyz, later)),
    )


def rows_apart(
    frame: Int[np.ndarray, "frames"], time_s: Float[np.ndarray, "frames"]
) -> Int[np.ndarray, "2 pairs"]:
    """Rows of pairs of frames that are `RPE_SPAN_S` apart, rounded to whole frames, at least one frame.

    The distance is counted in frame numbers, so rows may be missing between the two.
    """
    if len(frame) < 2 or not time_s[-1] > time_s[0]:
        return np.empty((2, 0), int)
    frames_per_s = (frame[-1] - frame[0]) / (time_s[-1] - time_s[0])
    wanted = frame + max(1, round(RPE_SPAN_S * frames_per_s))
    row = np.minimum(np.searchsorted(frame, wanted), len(frame) - 1)
    first = np.flatnonzero(frame[row] == wanted)
    return np.stack([first, row[first]])


def _turn_errors_deg(
    est_wxyz: Float[np.ndarray, "frames drones 4"],
    ref_wxyz: Float[np.ndarray, "frames drones 4"],
    later: Int[np.ndarray, "2 pairs"],
) -> Float[np.ndarray, "turns"]:
    """Angles of (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), where all four orientations are known (Sturm et al., equation 2)."""
    first, second = later
    four_wxyz = np.stack([ref_wxyz[first], ref_wxyz[second], est_wxyz[first], est_wxyz[second]])
    known = np.isfinite(four_wxyz).all(axis=(0, -1))
    if not known.any():
        return np.empty(0)
    Q_i, Q_j, P_i, P_j = (Rotation.from_quat(wxyz[known], scalar_first=True) for wxyz in four_wxyz)
    return np.rad2deg(((Q_i.inv() * Q_j).inv() * (P_i.inv() * P_j)).magnitude())


def _rmse(error: Float[np.ndarray, "*shape"]) -> float | None:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None
