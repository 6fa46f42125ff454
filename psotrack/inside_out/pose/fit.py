"""The most likely pose near an initial pose, and the corners that fit the most likely pose.

Gauss-Newton steps with the covariances of the corners (`equations`). Studentised residuals, which are residuals in
units of their own standard deviations, decide which corners and markers fit (Cook & Weisberg, Residuals and influence
in regression, 1982, section 2.2). The gate widens with the median of the residuals, where a lens, a map or a rolling
shutter is wrong.
"""

from __future__ import annotations

from math import lgamma, log, pi

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import NEAR_M
from psotrack.inside_out.pose.equations import Equations, SeenMarkers, linearised
from psotrack.inside_out.pose.records import MarkerPose

#: Probability that a good corner, or the mean of a good marker, is rejected as an outlier; and the gate of its squared
#: residual, which has the chi-square distribution with 2 degrees of freedom. Median of that distribution.
FALSE_ALARM = 1e-3
_GATE, _MEDIAN = -2 * log(FALSE_ALARM), 2 * log(2)
#: Smallest number of corners of a marker that fit; a marker with two bad corners may be anything.
MIN_CORNERS = 3
#: Largest factor of the gate's standard deviations.
_MOST_SCALE = 30.0
#: Largest number of steps, and the step from which a rejected corner stays rejected: the gates depend on the fit and
#: the fit on the gates, and a corner that alternates stays out. Squared length of the last step, standard deviations.
_MAX_STEPS, _NO_RETURN, _LAST = 20, 8, 1e-2
#: Standard deviation of a shift of all corners of a frame along x and along y, pixels: it looks like a turn of the
#: camera, so that no residual shows it. In drawn videos it was 0.012 to 0.017 px; of a camera, it may be larger.
_SHIFT_PX = 0.015
#: Longest step, because an initial pose may be far away: rad, and as a fraction of the markers' distance.
_LONGEST = 0.3
#: Weight of the stated variance, as a number of residuals, in the density of the residuals; and logarithm of the
#: density of an outlier's pixel, which may lie anywhere within about 100 x 100 px.
_PRIOR_RESIDUALS, _LOG_ANYWHERE = 3.0, -2 * log(100.0)


def fit(
    seen: SeenMarkers,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    fits: Bool[np.ndarray, "markers 4"] | None = None,
) -> MarkerPose | None:
    """Fit a pose near an initial pose, and find the corners that fit.

    Args:
        seen: markers of the frame.
        position_m: (3,), the camera's centre in the initial pose, world, metres.
        R_world_cam: (3, 3), camera to world, in the initial pose.
        fits: (markers, 4), True for corners that fit the initial pose; None for all.

    Returns:
        The fit; None if the markers do not determine the pose, or no pose explains the markers.
    """
    fits = np.ones(seen.corners_px.shape[:2], bool) if fits is None else fits
    extra, number, settled = np.zeros(2), 0, False
    try:
        while not settled:
            found = linearised(seen, position_m, R_world_cam, extra, fits)
            step, covariance = found.solved(extra)
            length = float(step @ np.linalg.solve(covariance, step))
            still_fits, scale = _explained(found, step, covariance)
            if number >= _NO_RETURN:
                still_fits = still_fits & fits
            # In the first steps the pose is still far away, and a large step says nothing of single corners.
            settled = length < _LAST and bool((still_fits == fits).all())
            if number == _MAX_STEPS or not still_fits.any() or scale > _MOST_SCALE:
                return None
            distance_m = np.maximum(found.depth_m, NEAR_M).mean()
            longest = max(np.linalg.norm(step[:3]) / distance_m, np.linalg.norm(step[3:6]), _LONGEST)
            step = step * (_LONGEST / longest)
            position_m = position_m + step[:3]
            R_world_cam = R_world_cam @ Rotation.from_rotvec(step[3:6]).as_matrix()
            extra, fits, number = extra + step[6:], still_fits, number + 1
    except np.linalg.LinAlgError:
        return None
    found = linearised(seen, position_m, R_world_cam, extra, fits)
    # The inset is an error of the measurement, so the reported distances are without the inset.
    off_px = found.residual_px.reshape(-1, 4, 2) + extra[0] * seen.inward
    by_shift, constant = _other_errors(found, covariance)
    used = np.any(found.fits, axis=1)
    return MarkerPose(
        position_m,
        R_world_cam,
        covariance[:6, :6] + by_shift,
        constant,
        num_markers=int(used.sum()),
        used=used,
        reprojection_px=float(np.sqrt(np.mean((off_px[found.fits] ** 2).sum(axis=-1)))),
        equations=found,
        log_evidence=_log_evidence(seen, found, covariance[:6, :6]),
    )


def _explained(
    found: Equations, step: Float[np.ndarray, "8"], covariance: Float[np.ndarray, "8 8"]
) -> tuple[Bool[np.ndarray, "markers 4"], float]:
    """Corners whose residuals, and whose marker's mean residual, are in the gate; and the gate's factor, 1 or more."""
    off_px = found.residual_px - found.slopes @ step
    of_fit = found.slopes @ covariance @ found.slopes.swapaxes(1, 2)
    used = np.asarray(found.fits.any(axis=1))
    # The covariance of a residual is smaller than that of the error for corners that were used, else larger.
    whole = np.where(used[:, None, None], found.covariance - of_fit, found.covariance + of_fit)
    corner = whole.reshape(-1, 4, 2, 4, 2)[:, np.arange(4), :, np.arange(4)].swapaxes(0, 1)
    squares = _squares(off_px.reshape(-1, 4, 2), corner, found.covariance[:, :2, :2][:, None])
    is_ahead = found.depth_m > NEAR_M
    of_used = squares[found.fits & is_ahead]
    scale2 = max(1.0, float(np.median(of_used)) / _MEDIAN) if len(of_used) > 4 else 1.0
    good = is_ahead & (squares < scale2 * _GATE)
    averaged = np.zeros((len(good), 2, 8))
    share = good / np.maximum(good.sum(axis=1, keepdims=True), 1)
    averaged[:, 0, 0::2], averaged[:, 1, 1::2] = share, share
    # A mean is gated as if the corners' errors were independent: a lens or a map may be less exact than an edge.
    independent = np.einsum("mii->mi", found.own)[:, :1, None] * np.eye(2) / 4
    of_mean = averaged @ whole @ averaged.swapaxes(1, 2) + independent
    squares = _squares((averaged @ off_px[..., None])[..., 0], of_mean, independent)
    kept = (squares < scale2 * _GATE) & (good.sum(axis=1) >= MIN_CORNERS)
    if used.sum() == 1:
        # The corners of a single marker give two equations more than unknowns, too few to find a bad corner.
        good[used], kept[used] = is_ahead[used], True
    return good & kept[:, None], float(np.sqrt(scale2))


def _squares(
    off_px: Float[np.ndarray, "*items 2"],
    covariance: Float[np.ndarray, "*items 2 2"],
    least: Float[np.ndarray, "*#items 2 2"],
) -> Float[np.ndarray, "*items"]:
    """Squared residuals by their covariances; a residual without degrees of freedom has no information."""
    return np.einsum("...i,...ij,...j->...", off_px, np.linalg.inv(covariance + 0.02 * least), off_px)


def _other_errors(
    found: Equations, covariance: Float[np.ndarray, "8 8"]
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"]]:
    """Covariances of the pose by a shift of all corners, and by errors of the map and of the focal length."""
    gains = covariance[:6] @ found.slopes.swapaxes(1, 2) @ found.weight
    by_shift = _SHIFT_PX * gains.reshape(-1, 6, 4, 2).sum(axis=(0, 2))
    # A marker that is elsewhere moves its pixels as a move of the camera does, in the other direction.
    by_place = gains @ found.slopes[..., :3] * np.sqrt(found.variances[2])[:, None, None]
    constant = np.concatenate([*by_place, covariance[:6, 7:]], axis=1)
    return by_shift @ by_shift.T, constant @ constant.T


def _log_evidence(seen: SeenMarkers, found: Equations, covariance: Float[np.ndarray, "6 6"]) -> float:
    """Logarithm of the density of all corners of a frame.

    Residuals of fitting corners have Student's t distribution, because their variance is not exactly known. Other
    corners have a uniform density. The poses are integrated out by Laplace's approximation, whose curvature is that of
    this distribution.
    """
    std_px = np.repeat(seen.std_px, 4)[found.fits.ravel()]
    off = found.residual_px.reshape(-1, 2)[found.fits.ravel()] / std_px[:, None]
    count, half = off.size, (_PRIOR_RESIDUALS + off.size) / 2
    of_fitted = lgamma(half) - lgamma(_PRIOR_RESIDUALS / 2) - count / 2 * log(pi * _PRIOR_RESIDUALS)
    squares = float(np.sum(off**2))
    of_fitted -= half * log(1 + squares / _PRIOR_RESIDUALS) + 2 * np.log(std_px).sum()
    of_others = (found.fits.size - len(off)) * _LOG_ANYWHERE
    of_poses = 3 * log(2 * pi * (_PRIOR_RESIDUALS + squares) / (_PRIOR_RESIDUALS + count))
    return float(of_fitted + of_others + of_poses + np.linalg.slogdet(covariance)[1] / 2)
