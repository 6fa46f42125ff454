"""Scores of tracks: HOTA, GOSPA, errors of whole paths, and the consistency of covariances with errors.

HOTA, detection, association and localisation in one score: J. Luiten, A. Osep, P. Dendorfer, P. Torr, A. Geiger,
L. Leal-Taixe, B. Leibe, HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking, International Journal of
Computer Vision 129, 2021. The paper leaves the choice of similarity to the user. Here, similarity falls linearly from 1
at distance 0 to 0 at `GATE_M`, so that the thresholds 0.05, 0.10 ... 0.95 are distances of 0.475 m ... 0.025 m.

GOSPA, one figure, in metres, for errors of position, missed drones and false tracks: A. S. Rahmathullah,
A. F. Garcia-Fernandez, L. Svensson, Generalized Optimal Sub-Pattern Assignment Metric, International Conference on
Information Fusion, 2017. Each frame is scored alone, so identities do not matter.

Absolute trajectory error (ATE) and relative pose error (RPE), as in benchmarks of SLAM: J. Sturm, N. Engelhard,
F. Endres, W. Burgard, D. Cremers, A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.

NEES, the normalised estimation error squared: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, section 5.4.2.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from psotrack.errors import InputError
from psotrack.evaluation.tables import Consistency, Gospa, Hota, PathErrors
from psotrack.support import similarity
from psotrack.trajectories.association import (
    GATE_M,
    UNASSIGNED,
    Distances,
    Partners,
    cheapest_partners,
    paired_values,
)

_Quaternions = Float[np.ndarray, "frames drones 4"]
_Vectors = Float[np.ndarray, "frames drones 3"]
_Pairs = Int[np.ndarray, "2 pairs"]
_Known = Bool[np.ndarray, "frames drones"]
_Counted = Bool[np.ndarray, "frames estimates"]
_Covariances = Float[np.ndarray, "frames drones 3 3"]
_THRESHOLDS = np.linspace(0.05, 0.95, 19)
#: Tolerance for rounding when a similarity is compared with a threshold.
_EPSILON = np.finfo(float).eps


def hota(distance_m: Distances, known: _Known, counted: _Counted) -> Hota:
    """HOTA, DetA, AssA and LocA, each the mean over the thresholds.

    Each frame has one assignment for all thresholds. The assignment maximises the sum of similarities, each weighted by
    the overlap of the two whole tracks (section 5.2 of the paper). A pair is a match at threshold alpha if its
    similarity is at least alpha. TP, FN and FP are counted over all frames. For a match, TPA is the number of frames in
    which its drone and its track are matched; FNA and FPA are the numbers of the other frames of the drone and of the
    track:

    - DetA_alpha = TP / (TP + FN + FP);
    - AssA_alpha = mean over matches of TPA / (TPA + FNA + FPA);
    - HOTA_alpha = sqrt(DetA_alpha AssA_alpha);
    - LocA_alpha = mean over matches of the similarity; 1 at a threshold without matches, as in the authors' code;
      LocA is None if the lowest threshold has no matches.

    Args:
        distance_m: (frames, drones, estimates), NaN where either is not known.
        known: (frames, drones), whether the drone's position is known; each drone's is known in at least one frame.
        counted: (frames, estimates), whether the estimate counts as a true or false positive; the other estimates are
            further than `GATE_M` from all drones.
    """
    similarity = np.where(distance_m < GATE_M, 1.0 - distance_m / GATE_M, 0.0)
    # Number of frames of a drone plus number of frames of a track: (drones, estimates).
    frames_of_both = known.sum(axis=0)[:, None] + counted.sum(axis=0)[None, :]
    weighted = _track_fit(similarity, frames_of_both) * similarity
    partners = cheapest_partners(-weighted)
    reached = np.nan_to_num(paired_values(similarity, partners))
    num_known, num_counted = int(known.sum()), int(counted.sum())
    parts = np.empty((len(_THRESHOLDS), 3))
    for part, threshold in zip(parts, _THRESHOLDS, strict=True):
        matched = reached >= threshold - _EPSILON
        num_matched = int(matched.sum())
        together = _frames_together(matched, partners, similarity.shape[2])
        association = together**2 / np.maximum(1, frames_of_both - together)
        part[:] = (
            num_matched / (num_known + num_counted - num_matched),
            association.sum() / max(1, num_matched),
            reached[matched].mean() if num_matched else 1.0,
        )
    deta, assa, loca = parts.T
    return Hota(
        hota=float(np.sqrt(deta * assa).mean()),
        deta=float(deta.mean()),
        assa=float(assa.mean()),
        loca=float(loca.mean()) if deta[0] > 0 else None,
    )


def _track_fit(
    similarity: Distances, frames_of_both: Int[np.ndarray, "drones estimates"]
) -> Float[np.ndarray, "drones estimates"]:
    """Overlap of each drone with each track over all frames, in [0, 1], used as weight of the matching.

    In each frame, a pair's similarity is divided by the sum of similarities of the drone and of the track.
    """
    total = similarity.sum(axis=1, keepdims=True) + similarity.sum(axis=2, keepdims=True) - similarity
    share = np.divide(similarity, total, out=np.zeros_like(similarity), where=total > _EPSILON)
    overlap = share.sum(axis=0)
    return overlap / (frames_of_both - overlap)


def _frames_together(
    matched: _Known, partners: Partners, num_estimates: int
) -> Int[np.ndarray, "drones estimates"]:
    """Number of frames in which each pair is matched."""
    assigned = matched & (partners != UNASSIGNED)
    _, drones = np.nonzero(assigned)
    together = np.zeros((matched.shape[1], num_estimates), int)
    np.add.at(together, (drones, partners[assigned]), 1)
    return together


def gospa(distance_m: Distances, known: _Known, counted: _Counted) -> Gospa:
    """GOSPA with alpha = 2, p = 2 and the cut-off c = `GATE_M`, and its three parts.

    In each frame, over all assignments (proposition 1 of the paper):

    GOSPA^2 = min [ sum over pairs of distance^2 + c^2 / 2 (missed + false) ]

    A missed drone costs c / sqrt(2), and a pair further apart than c counts as a missed drone and a false track. The
    result is the root of the mean of GOSPA^2 over frames; it is a metric (section IV of the paper), and its parts add
    up: localisation^2 + missed^2 + false^2 = GOSPA^2.

    GOSPA grows with the number of drones: one drone missed in all frames costs 0.354 m, ten cost 1.118 m.

    Args:
        distance_m: (frames, drones, estimates), NaN where either is not known.
        known: (frames, drones), whether the drone's position is known.
        counted: (frames, estimates), whether the estimate counts as a true or false positive.
    """
    cut_m2 = GATE_M**2
    # A pair at the cut-off costs the same as a missed drone and a false track.
    cost_m2 = np.where(distance_m < GATE_M, distance_m**2, cut_m2)
    paired_m2 = paired_values(cost_m2, cheapest_partners(cost_m2))
    matched = paired_m2 < cut_m2
    num_matched = int(matched.sum())
    parts_m2 = np.array(
        [
            paired_m2[matched].sum(),
            cut_m2 / 2 * (known.sum() - num_matched),
            cut_m2 / 2 * (counted.sum() - num_matched),
        ]
    ) / len(distance_m)
    localisation_m, missed_m, false_m = np.sqrt(parts_m2).tolist()
    return Gospa(
        gospa_m=float(np.sqrt(parts_m2.sum())),
        gospa_localisation_m=localisation_m,
        gospa_missed_m=missed_m,
        gospa_false_m=false_m,
    )


#: Time between the two poses of a relative pose error, seconds.
RPE_SPAN_S = 1.0


def path_errors(
    est_m: _Vectors,
    ref_m: _Vectors,
    orientation_est_wxyz: _Quaternions,
    orientation_wxyz: _Quaternions,
    later: _Pairs,
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


def rows_apart(frame: Int[np.ndarray, "frames"], time_s: Float[np.ndarray, "frames"]) -> _Pairs:
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
    est_wxyz: _Quaternions, ref_wxyz: _Quaternions, later: _Pairs
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


#: The chi-square distribution with 3 degrees of freedom is below this with probability 0.9.
INSIDE_90 = 2.0 * float(gammaincinv(3 / 2, 0.9))


def consistency(
    residual_m: _Vectors,
    centred_m: _Vectors,
    covariance_m2: _Covariances,
    relative_covariance_m2: _Covariances | None = None,
) -> Consistency:
    """Share of reference positions inside the estimate's 90 % ellipsoid, and mean NEES, over frames and drones.

    NEES is r^T C^-1 r with the residual r and its covariance C. For Gaussian errors with covariance C, NEES has a
    chi-square distribution with 3 degrees of freedom: the mean is 3, and 90 % of the values are below `INSIDE_90`.

    Args:
        residual_m: (frames, drones, 3), estimate minus reference, NaN where either is not known.
        centred_m: (frames, drones, 3), residuals minus each drone's mean residual.
        covariance_m2: (frames, drones, 3, 3), covariances of the estimates in the world; NaN where not known.
        relative_covariance_m2: (frames, drones, 3, 3), covariances of the centred residuals, known where
            `covariance_m2` is; None: the same.

    Raises:
        InputError: a covariance is not positive definite.
    """
    known = np.isfinite(residual_m).all(axis=-1) & np.isfinite(covariance_m2).all(axis=(-2, -1))
    if not known.any():
        return Consistency(None, None, None, None)
    relative_m2 = (covariance_m2 if relative_covariance_m2 is None else relative_covariance_m2)[known]
    smallest_m2 = np.linalg.eigvalsh([covariance_m2[known], relative_m2])[..., 0].min()
    if not smallest_m2 > 0:
        raise InputError(
            "estimate",
            expected="covariances that are positive definite",
            found=f"one whose smallest eigenvalue is {smallest_m2:.3g} m2",
            remedy="leave a covariance empty (NaN) where it is not known",
        )
    raw, centred = _nees(residual_m[known], covariance_m2[known]), _nees(centred_m[known], relative_m2)
    return Consistency(
        inside_90_rate=float(np.mean(raw <= INSIDE_90)),
        mean_nees=float(raw.mean()),
        offset_removed_inside_90_rate=float(np.mean(centred <= INSIDE_90)),
        offset_removed_mean_nees=float(centred.mean()),
    )


def _nees(
    residual_m: Float[np.ndarray, "points 3"], covariance_m2: Float[np.ndarray, "points 3 3"]
) -> Float[np.ndarray, "points"]:
    return np.einsum("ni,ni->n", residual_m, np.linalg.solve(covariance_m2, residual_m[..., None])[..., 0])
