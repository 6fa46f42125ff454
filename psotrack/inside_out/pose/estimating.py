"""Estimation of a camera's pose from the corners of markers in one frame.

The fit starts at the pose of all markers together, by SQPnP (Terzakis & Lourakis, ECCV 2020). Where this pose does not
explain most of the markers, some markers are wrong, and poses of pairs of markers are fitted too, by AP3P (Ke &
Roumeliotis, CVPR 2017), as in random sample consensus (Fischler & Bolles, CACM 24(6), 1981). Markers in a plane have a
second, mirrored pose (IPPE; Collins & Bartoli, IJCV 2014). Likelihoods, and the pose that motion predicts, decide which
of the fitted poses is returned.

A fit is Gauss-Newton steps with the covariances of the corners (`equations`). Studentised residuals, which are
residuals in units of their own standard deviations, decide which corners and markers fit (Cook & Weisberg, Residuals
and influence in regression, 1982, section 2.2). The gate widens with the median of the residuals, where a lens, a map
or a rolling shutter is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import combinations
from math import lgamma, log, pi

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from psotrack.calibration import Solver, solve_pnp
from psotrack.errors import InputError
from psotrack.geometry import NEAR_M, Camera, undistort
from psotrack.inside_out.pose.equations import (
    CameraPose,
    CornerNoise,
    Equations,
    MarkerPose,
    PoseSettings,
    SeenMarkers,
    linearised,
)

#: Position of the camera and rotation from camera to world.
_InitialPose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]

#: Largest distance of a corner from its projection, in standard deviations of a corner, and smallest value of it in
#: pixels, at which an initial pose of few markers still explains the corner.
_LOOSE, _LOOSE_PX = 15.0, 3.0
#: Largest number of pairs of markers from which poses are computed. With 40 % wrong markers a third of the pairs is
#: right.
_MOST_PAIRS = 55
#: Largest number of markers in a frame for which poses of single markers are computed too.
_FEW_MARKERS = 3
#: Largest number of initial poses that are fitted.
_MOST_INITIAL_POSES = 4
#: Ratio of the smallest to the largest extent of markers below which they may have a second, mirrored pose.
_NEARLY_FLAT = 0.1
#: Probability that a good corner, or the mean of a good marker, is rejected as an outlier; and the gate of its squared
#: residual, which has the chi-square distribution with 2 degrees of freedom. Median of that distribution.
FALSE_ALARM = 1e-3
_GATE, _MEDIAN = -2 * log(FALSE_ALARM), 2 * log(2)
#: Smallest number of corners of a marker that fit; a marker with two bad corners may be anything.
_MIN_CORNERS = 3
#: Largest factor of the gate's standard deviations.
_MOST_SCALE = 30.0
#: Largest number of steps, and the step from which a rejected corner stays rejected: the gates depend on the fit and
#: the fit on the gates, and a corner that alternates stays out. Squared length of the last step, standard deviations.
_MAX_STEPS, _NO_RETURN, _LAST = 20, 8, 1e-2
#: Longest step, because an initial pose may be far away: rad, and as a fraction of the markers' distance.
_LONGEST = 0.3
#: Weight of the stated variance, as a number of residuals, in the density of the residuals; and logarithm of the
#: density of an outlier's pixel, which may lie anywhere within about 100 x 100 px.
_PRIOR_RESIDUALS, _LOG_ANYWHERE = 3.0, -2 * log(100.0)
#: Weight of the recording's variances against the residuals of a frame, as a number of residuals: those of about six
#: markers. With 8 and with 20, the figures of Table 7 differ little, but four markers show their own errors less well.
_RECORDING_RESIDUALS = 50.0
#: Number of markers that suffices for a pose; in frames of fewer than eight markers, half of the markers suffice.
_ENOUGH_MARKERS = 4
#: Standard deviation of a corner whose detection states none, and the smallest that is believed, pixels.
_UNKNOWN_STD_PX, _LEAST_STD_PX = 0.2, 0.02
#: Logarithm of the density of a pose that is not where motion predicts it: in 1 of 1000 frames the camera is anywhere
#: in 1000 m³, in any orientation.
_LOG_UNEXPECTED = -log(1e3 * 1e3 * 8 * pi**2)
#: Squared Mahalanobis distance of two poses below which they are one pose: χ² with 6 degrees of freedom exceeds it
#: with probability 1/1000.
_SAME = 22.5


def estimate_pose(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    settings: PoseSettings,
    expected: CameraPose | None = None,
    *,
    std_px: Float[np.ndarray, " markers"] | None = None,
    map_std_m: Float[np.ndarray, " markers"] | None = None,
) -> MarkerPose | None:
    """Estimate the pose of a camera from one frame's markers; whole markers and single corners may be wrong.

    Args:
        corners_px: (markers, 4, 2), corners in the image, pixels.
        corners_m: (markers, 4, 3), the same corners in the world, metres.
        lens: intrinsics of the camera; the pose in it is ignored.
        settings: settings of pose estimation.
        expected: pose that motion predicts; decides between poses that fit about equally well.
        std_px: (markers,), standard deviation of a corner along x and along y by its detection, pixels; NaN or None
            where it is unknown.
        map_std_m: (markers,), standard deviation of a marker's place in the map along each axis, metres; 0 or None
            where it is unknown.

    Returns:
        The pose; None where there are too few markers, or no pose explains the markers.

    Raises:
        InputError: a coordinate is not finite.
    """
    if not (np.isfinite(corners_px).all() and np.isfinite(corners_m).all()):
        raise InputError("corners", expected="finite coordinates", found="NaN or infinity")
    count, noise = len(corners_px), settings.noise or CornerNoise()
    std_px = np.full(count, np.nan) if std_px is None else std_px
    std_px = np.where(np.isfinite(std_px), np.maximum(std_px, _LEAST_STD_PX), _UNKNOWN_STD_PX)
    map_std_m = np.zeros(count) if map_std_m is None else map_std_m
    map_std_m = np.where(map_std_m > 0, map_std_m, settings.map_error_m)
    rays = undistort(lens, np.asarray(corners_px, np.float64))
    # A marker where the lens model shows nothing counts as not seen.
    shown = np.isfinite(rays).all(axis=(1, 2))
    if shown.sum() < settings.min_markers:
        return None
    seen = SeenMarkers(
        np.asarray(corners_px, np.float64)[shown],
        rays[shown],
        np.asarray(corners_m, np.float64)[shown],
        lens,
        noise.scale * std_px[shown],
        noise.place_m,
        map_std_m[shown],
        settings.focal_error,
        noise.shift_px,
    )
    # One or two of many markers may agree by chance, because every single marker has a pose that explains this marker.
    least = min(_ENOUGH_MARKERS, shown.sum() / 2)
    poses = [pose for pose in _likely_poses(seen) if pose.used.sum() >= least]
    if not poses:
        return None
    log_likelihood = np.array([pose.log_evidence + _log_prior(pose, expected) for pose in poses])
    best = poses[log_likelihood.argmax()]
    odds = np.exp(np.sort(log_likelihood - log_likelihood.max()))[-2:-1].sum()
    used = np.zeros(count, bool)
    used[shown] = best.used
    if best.equations is not None:
        best = _with_errors_of_frame(best, best.equations, noise.shift_px)
    return replace(best, used=used, ambiguity=float(odds / (1 + odds)))


def _likely_poses(seen: SeenMarkers) -> list[MarkerPose]:
    """Different poses that explain all markers or a part of the markers, the most likely pose first."""
    found = _distinct(_fit(seen, *pose) for pose in _solve(seen.corners_m, seen.rays, "sqpnp"))
    # If all markers agree, or at least three markers and more than half of all, no other pose explains an equal number.
    count = len(seen.rays)
    enough = min(max(3, count // 2 + 1), count)
    if not found or found[0].used.sum() < enough or found[0].reprojection_px > _near_px(seen).mean():
        by_pairs = _poses_of_pairs(seen)
        found = _distinct([*found, *(_fit(seen, *pose, fits) for pose, fits in by_pairs)])
    mirrored = [_fit(seen, *pose, best.fits) for best in found for pose in _mirrored_poses(seen, best)]
    return _distinct([*found, *mirrored])


def _distinct(fits: Iterable[MarkerPose | None]) -> list[MarkerPose]:
    """Fits, the most likely first, without fits of the same pose as a more likely fit."""
    found: list[MarkerPose] = []
    for pose in sorted((pose for pose in fits if pose is not None), key=lambda pose: -pose.log_evidence):
        if not any(_mahalanobis2(pose, other)[0] < _SAME for other in found):
            found.append(pose)
    return found


def _mahalanobis2(pose: MarkerPose, other: CameraPose) -> tuple[float, float]:
    """Squared Mahalanobis distance of two poses, and the log determinant of the sum of their covariances."""
    turn = Rotation.from_matrix(other.R_world_cam.T @ pose.R_world_cam).as_rotvec()
    apart = np.concatenate([pose.position_m - other.position_m, turn])
    both = pose.covariance + other.covariance
    return float(apart @ np.linalg.solve(both, apart)), float(np.linalg.slogdet(both)[1])


def _log_prior(pose: MarkerPose, expected: CameraPose | None) -> float:
    """Log density of a pose given the pose that motion predicts."""
    if expected is None:
        return 0.0
    square, log_determinant = _mahalanobis2(pose, expected)
    return float(np.logaddexp(-0.5 * (square + log_determinant + 6 * log(2 * pi)), _LOG_UNEXPECTED))


def _fit(
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
    by_shift, constant = _other_errors(found, covariance, seen.shift_px)
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


def _with_errors_of_frame(pose: MarkerPose, found: Equations, shift_px: float) -> MarkerPose:
    """A pose whose variances are those of the recording and those that the residuals of its frame show.

    A frame in which the camera turns quickly has several times the errors of the others. The factor is that of a
    scaled inverse chi-square prior (Gelman et al., Bayesian Data Analysis, 3rd edition, section 2.6).
    """
    squares = float(np.einsum("mi,mij,mj->", found.residual_px, found.weight, found.residual_px))
    freedom = max(2 * int(found.fits.sum()) - 6, 0)
    factor = (_RECORDING_RESIDUALS + squares) / (_RECORDING_RESIDUALS + freedom)
    own, place_m2, map_m2 = found.variances
    found = replace(found, variances=(factor * own, factor * place_m2, map_m2))
    _, covariance = found.solved(np.zeros(2))
    by_shift, constant = _other_errors(found, covariance, shift_px)
    return replace(pose, covariance=covariance[:6, :6] + by_shift, constant=constant, equations=found)


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
    weight = good / np.maximum(good.sum(axis=1, keepdims=True), 1)
    averaged[:, 0, 0::2], averaged[:, 1, 1::2] = weight, weight
    # A mean is gated as if the corners' errors were independent: a lens or a map may be less exact than an edge.
    independent = np.einsum("mii->mi", found.own)[:, :1, None] * np.eye(2) / 4
    of_mean = averaged @ whole @ averaged.swapaxes(1, 2) + independent
    squares = _squares((averaged @ off_px[..., None])[..., 0], of_mean, independent)
    kept = (squares < scale2 * _GATE) & (good.sum(axis=1) >= _MIN_CORNERS)
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
    found: Equations, covariance: Float[np.ndarray, "8 8"], shift_px: float
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"]]:
    """Covariances of the pose by a shift of all corners, and by errors of the map and of the focal length."""
    gains = covariance[:6] @ found.slopes.swapaxes(1, 2) @ found.weight
    by_shift = shift_px * gains.reshape(-1, 6, 4, 2).sum(axis=(0, 2))
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


def _near_px(seen: SeenMarkers) -> Float[np.ndarray, "markers"]:
    """(markers,), distance of a corner from its projection at which a pose still explains the corner, pixels."""
    return np.maximum(_LOOSE * seen.std_px, _LOOSE_PX)


def _poses_of_pairs(seen: SeenMarkers) -> list[tuple[_InitialPose, Bool[np.ndarray, "markers 4"]]]:
    """Poses of pairs of markers that explain most corners, with these corners; each pose explains other markers."""
    poses = list(_poses_of_few(seen))
    if not poses:
        return []
    distance = _distances_px(seen, poses) / _near_px(seen)[:, None]
    fits = (distance < 1).sum(axis=-1) >= _MIN_CORNERS
    cost = np.minimum(distance, 10.0).sum(axis=(1, 2))
    chosen: list[tuple[_InitialPose, Bool[np.ndarray, "markers 4"]]] = []
    for index in np.argsort(cost, kind="stable"):
        used = fits[index][:, None] & (distance[index] < 1)
        if used.any() and not any((used.any(axis=1) == other.any(axis=1)).all() for _, other in chosen):
            chosen.append((poses[index], used))
    return chosen[:_MOST_INITIAL_POSES]


def _mirrored_poses(seen: SeenMarkers, best: MarkerPose) -> list[_InitialPose]:
    """Both poses of markers that lie nearly in a plane; one of them is near the best pose."""
    corners_m = seen.corners_m[best.used]
    extent_m = np.linalg.svd((corners_m - corners_m.mean(axis=(0, 1))).reshape(-1, 3), compute_uv=False)
    if extent_m[2] > _NEARLY_FLAT * extent_m[0]:
        return []
    return _solve(corners_m, seen.rays[best.used], "ippe")


def _distances_px(seen: SeenMarkers, poses: list[_InitialPose]) -> Float[np.ndarray, "poses markers 4"]:
    """Distance of each corner from its projection, pixels without distortion; infinite behind the camera."""
    position_m, R = (np.array(part) for part in zip(*poses, strict=True))
    x_cam = (seen.corners_m.reshape(-1, 3) - position_m[:, None]) @ R
    ahead = x_cam[..., 2] > NEAR_M
    projected = x_cam[..., :2] / np.where(ahead, x_cam[..., 2], 1.0)[..., None]
    off_px = (projected - seen.rays.reshape(-1, 2)) * np.diag(seen.lens.K)[:2]
    return np.where(ahead, np.linalg.norm(off_px, axis=-1), np.inf).reshape(len(poses), *seen.rays.shape[:2])


def _poses_of_few(seen: SeenMarkers) -> Iterator[_InitialPose]:
    """Poses of pairs of markers, from two opposite corners of each; in frames of few markers, of single markers too."""
    count = len(seen.rays)
    pairs = list(combinations(range(count), 2))
    if len(pairs) > _MOST_PAIRS:
        chosen = np.random.default_rng(0).permutation(len(pairs))[:_MOST_PAIRS]
        pairs = [pairs[index] for index in chosen]
    for pair in pairs:
        opposite = [[marker] for marker in pair], [[0, 2], [1, 3]]
        yield from _solve(seen.corners_m[opposite], seen.rays[opposite], "ap3p")
    for marker in range(count if count <= _FEW_MARKERS else 0):
        yield from _solve(seen.corners_m[marker], seen.rays[marker], "ippe")


def _solve(
    corners_m: Float[np.ndarray, "*corners 3"], rays: Float[np.ndarray, "*corners 2"], solver: Solver
) -> list[_InitialPose]:
    """Poses that a solver finds for corners on rays, the pose of smallest reprojection error first."""
    poses = solve_pnp(corners_m.reshape(-1, 3), rays.reshape(-1, 2), solver)
    return [(-T[:3, :3].T @ T[:3, 3], T[:3, :3].T) for T in poses]
