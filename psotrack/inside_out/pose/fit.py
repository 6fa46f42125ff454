"""The most likely pose near an initial pose, and the corners that fit the most likely pose.

Robust steps come first, then steps with all corners that fit (`psotrack.geometry.estimation.gauss_newton`). Studentised
residuals, which are residuals in units of their own standard deviations, decide which corners and markers fit (Cook &
Weisberg, Residuals and influence in regression, 1982, section 2.2). The covariance is the inverse of the information
after the elimination of the inset, the focal length and the markers' places (see `equations`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log, pi

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from psotrack.calibration import spread_px
from psotrack.geometry import NEAR_M
from psotrack.geometry.estimation import NormalEquations, cauchy_weight, gauss_newton
from psotrack.inside_out.frame_motion import FrameMotion
from psotrack.inside_out.pose.equations import (
    PRIOR_RESIDUALS,
    Noise,
    SeenCorners,
    Solution,
    Sums,
    corner_residuals,
    equations,
    log_prior,
    summed,
    with_prior,
)
from psotrack.inside_out.pose.frame_motion import (
    frame_motion,
    line_time_effects,
    unmodelled_effects,
    unmodelled_residuals,
)
from psotrack.inside_out.pose.records import CornerResiduals

#: Probability that a good corner, or the mean of a good marker, is rejected as an outlier.
FALSE_ALARM = 1e-3
#: Smallest number of corners of a marker that fit; a marker with two bad corners may be anything.
MIN_CORNERS = 3
#: First estimate of the deviation of a marker's place, as a multiple of the stated deviation. An estimate that is too
#: large shrinks within few steps, and an estimate that is too small grows slowly.
_FIRST_PLACE_SCALE = 10.0
#: Deviations above which a fit is rejected: of corners, as a multiple of the stated noise, and of places, metres.
_LARGEST_NOISE_SCALE, _LARGEST_PLACE_M = 30.0, 0.05
#: Largest number of robust steps and of steps without robust weights; and the step from which a rejected corner stays
#: rejected.
_MAX_STEPS, _NO_RETURN = 12, 5
#: Squared lengths in standard deviations of the last robust step and of the last step.
_LAST_ROBUST, _LAST = 1.0, 1e-2
#: A corner fits the robust pose if its distance is below this multiple of the robust scale.
_WITHIN = 4.0
#: Longest step, because an initial pose may be far off: rad, and as a share of the markers' distance.
_LONGEST = 0.3
#: Smallest variance of a residual, as a share of the corner's own variance.
_LEAST_VARIANCE = 0.02
#: Logarithm of the density of an outlier's pixel, which may lie anywhere within about 100 x 100 px.
_LOG_ANYWHERE = -2 * log(100.0)


@dataclass(frozen=True)
class Fit:
    """The most likely pose near an initial pose.

    Attributes:
        position_m: (3,), the camera's centre, world, metres.
        R_world_cam: (3, 3), camera to world.
        covariance: (6, 6), covariance as in `CameraPath`.
        common: (6, 3 markers + 1), effects of one standard deviation of each marker's place in the map along each axis,
            and of the focal length.
        fits: (markers, 4), True for corners that fit the pose.
        reprojection_px: root mean square distance of these corners in the image.
        log_evidence: logarithm of the probability density of all corners, integrated over poses near this pose.
        residuals: residuals of the corners and of the markers' means.
        motion: what a frame of a rolling shutter says about pose and motion together; None of a global shutter.
        by_line_time: (6,), change of the pose by an error of the line time of one standard deviation; None if the line
            time is exact.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "6 errors"]
    fits: Bool[np.ndarray, "markers 4"]
    reprojection_px: float
    log_evidence: float
    residuals: CornerResiduals
    motion: FrameMotion | None = None
    by_line_time: Float[np.ndarray, "6"] | None = None

    @property
    def used(self) -> Bool[np.ndarray, "markers"]:
        """(markers,), True for markers with at least one corner that fits."""
        return np.any(self.fits, axis=1)


def fit(
    seen: SeenCorners,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    fits: Bool[np.ndarray, "markers 4"] | None = None,
) -> Fit | None:
    """Fit a pose near an initial pose, and find the corners that fit.

    Args:
        seen: markers of the frame.
        position_m: (3,), the camera's centre in the initial pose, world, metres.
        R_world_cam: (3, 3), camera to world, in the initial pose.
        fits: (markers, 4), True for corners that fit the initial pose; None to find these corners by robust steps.

    Returns:
        The fit; None if the markers do not determine the pose, or no pose explains the markers.
    """
    pose = _Pose(position_m, R_world_cam, seen.expected_extra)
    if fits is None:
        start = _RobustFit(seen, pose, np.zeros(seen.corners_px.shape[:2], bool), np.inf)
        robust = gauss_newton(start, max_steps=_MAX_STEPS)
        pose, fits = robust.pose, robust.fits
    noise = Noise(
        seen.noise_px**2, (_FIRST_PLACE_SCALE * seen.place_m) ** 2, PRIOR_RESIDUALS, PRIOR_RESIDUALS
    )
    try:
        found = gauss_newton(_NoiseFit(seen, pose, fits, noise), max_steps=_MAX_STEPS)
    except np.linalg.LinAlgError:
        return None
    if found.last is None or found.last.solution.length > _LAST_ROBUST:
        return None
    return _fitted(seen, found.pose, found.last, found.noise)


@dataclass(frozen=True)
class _Pose:
    """A pose as in `Fit`; `extra` has the inset (px), the focal length (stated standard deviations), and the motion."""

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    extra: Float[np.ndarray, "extra"]

    def moved(self, step: Float[np.ndarray, "unknowns"], depth_m: Float[np.ndarray, "markers 4"]) -> _Pose:
        """Take a step, shortened to the longest step; `depth_m` are the depths of the corners, metres."""
        distance_m = np.maximum(depth_m, NEAR_M).mean()
        longest = max(np.linalg.norm(step[:3]) / distance_m, np.linalg.norm(step[3:6]), _LONGEST)
        step = step * (_LONGEST / longest)
        turn = np.asarray(cv2.Rodrigues(step[3:6])[0])
        return _Pose(self.position_m + step[:3], self.R_world_cam @ turn, self.extra + step[6:])


@dataclass(frozen=True)
class _RobustFit:
    """A pose that is fitted with Cauchy weights, `estimation.least_squares.Reweighted`.

    Attributes:
        seen: markers of the frame.
        pose: the pose.
        fits: (markers, 4), True for corners near the pose of the previous step.
        length: squared length of the previous step in standard deviations; 0 if no further step is possible.
    """

    seen: SeenCorners
    pose: _Pose
    fits: Bool[np.ndarray, "markers 4"]
    length: float

    def moved(self) -> _RobustFit:
        """Take a step with weights whose scale is the median of the distances."""
        pose = self.pose
        rows, depth_m = equations(self.seen, pose.position_m, pose.R_world_cam, pose.extra)
        distance_px = np.where(depth_m > NEAR_M, np.linalg.norm(rows[..., -1], axis=-1), np.inf)
        scale_px = max(self.seen.noise_px, spread_px(distance_px.ravel(), 6))
        fits = distance_px < _WITHIN * scale_px
        stopped = _RobustFit(self.seen, pose, fits, 0.0)
        if not np.isfinite(scale_px):
            return stopped
        weighted = rows * np.sqrt(cauchy_weight((distance_px / scale_px) ** 2))[..., None, None] / scale_px
        weighted = weighted.reshape(-1, rows.shape[-1])
        total = weighted.T @ weighted
        normal = with_prior(
            NormalEquations(total[:-1, :-1], total[:-1, -1]),
            self.seen.prior_information,
            pose.extra - self.seen.expected_extra,
        )
        try:
            step = normal.solved().shared
        except np.linalg.LinAlgError:
            return stopped
        return _RobustFit(self.seen, pose.moved(step, depth_m), fits, float(step @ normal.right))

    def is_settled(self, before: _RobustFit) -> bool:
        return self.length < _LAST_ROBUST


@dataclass(frozen=True)
class _LastStep:
    """The last step of a `_NoiseFit`.

    Attributes:
        fits: (markers, 4), True for the corners that the step used.
        off_px: (markers, 4, 2), linearised residuals after the step.
        sums: sums of the equations.
        solution: the step.
        rows: (markers, 4, 2, unknowns + 1), the equations of all corners.
    """

    fits: Bool[np.ndarray, "markers 4"]
    off_px: Float[np.ndarray, "markers 4 2"]
    sums: Sums
    solution: Solution
    rows: Float[np.ndarray, "markers 4 2 columns"]


@dataclass(frozen=True)
class _NoiseFit:
    """A pose that is fitted together with the noise and the fitting corners, `estimation.least_squares.Reweighted`.

    Attributes:
        seen: markers of the frame.
        pose: the pose.
        fits: (markers, 4), True for corners that fit.
        noise: variances of the errors.
        number: number of steps so far.
        last: the last step; None before the first step.
    """

    seen: SeenCorners
    pose: _Pose
    fits: Bool[np.ndarray, "markers 4"]
    noise: Noise
    number: int = 0
    last: _LastStep | None = None

    def moved(self) -> _NoiseFit:
        """Take a step, find the corners that fit, and estimate the noise."""
        pose, fits, noise = self.pose, self.fits, self.noise
        rows, depth_m = equations(self.seen, pose.position_m, pose.R_world_cam, pose.extra)
        is_ahead = depth_m > NEAR_M
        sums = summed(rows, fits & is_ahead, self.seen.centre_scale)
        solution = sums.solved(noise, self.seen.prior_information, pose.extra - self.seen.expected_extra)
        if solution is None:
            raise np.linalg.LinAlgError("expected markers that determine the pose")
        off_px = rows @ np.append(-solution.step, 1.0)
        still_fits = fits & is_ahead
        if self.number > 0:
            # Corners are judged by the noise that the residuals show; in the first step only the stated noise is known.
            still_fits = _explained(
                off_px,
                rows[..., :-1],
                is_ahead,
                fits,
                solution.covariance,
                noise,
                self.seen.centre_scale,
            )
        if self.number >= _NO_RETURN:
            # The gates depend on the fit and the fit on the gates. A corner that alternates stays out.
            still_fits &= fits
        return _NoiseFit(
            self.seen,
            pose.moved(solution.step, depth_m),
            still_fits,
            sums.noise(solution, noise, self.seen),
            self.number + 1,
            _LastStep(fits, off_px, sums, solution, rows),
        )

    def is_settled(self, before: _NoiseFit) -> bool:
        if self.last is None or before.number == 0 or self.last.solution.length >= _LAST:
            return False
        return bool((self.fits == before.fits).all())


def _fitted(seen: SeenCorners, pose: _Pose, last: _LastStep, noise: Noise) -> Fit | None:
    """Make the result from the last step and the noise; None if the residuals are too large for a usable pose."""
    fits, off_px, sums = last.fits, last.off_px, last.sums
    widened = noise.widened()
    off_prior = pose.extra - seen.expected_extra
    solution: Solution | None = sums.solved(widened, seen.prior_information, off_prior)
    too_large = noise.own_px2 > (_LARGEST_NOISE_SCALE * seen.noise_px) ** 2
    if solution is None or too_large or noise.place_m2 > _LARGEST_PLACE_M**2:
        return None
    by_others = unmodelled_effects(seen, last.rows, fits, widened, seen.prior_information)
    if by_others is None:
        return None
    covariance = (solution.covariance + by_others @ by_others.T)[:6, :6]
    motion, by_line_time, whole = None, None, covariance
    if seen.rows is not None:
        motion = frame_motion(seen, sums, last.rows, fits, widened, pose.extra)
        if motion is None:
            return None
    if seen.unsure is not None:
        assumed = seen.unsure.expected if motion is None else motion.assumed
        by_motion = line_time_effects(seen, last.rows, fits, widened, seen.prior_information)
        if by_motion is None:
            return None
        by_line_time = by_motion[:6] @ assumed
        whole = covariance + np.outer(by_line_time, by_line_time)
        if motion is None:
            # The motion that turns an error of the line time into an error of the pose is uncertain, too.
            whole = whole + by_motion[:6] @ seen.unsure.covariance @ by_motion[:6].T
    # The inset is an error of the measurement, so the reported distances are without the inset.
    distance_px = np.linalg.norm(off_px + pose.extra[0] * seen.inward, axis=-1)[fits]
    return Fit(
        pose.position_m,
        pose.R_world_cam,
        whole,
        sums.common(solution, widened, seen.map_share)[:6],
        fits,
        float(np.sqrt(np.mean(distance_px**2))),
        _log_evidence(off_px[fits], fits.size, covariance, seen.noise_px) + log_prior(seen, pose.extra),
        corner_residuals(
            last.rows,
            off_px,
            fits,
            solution,
            widened,
            seen,
            unmodelled_residuals(seen, last.rows, by_others),
        ),
        motion,
        by_line_time,
    )


def _explained(
    off_px: Float[np.ndarray, "markers 4 2"],
    slopes: Float[np.ndarray, "markers 4 2 unknowns"],
    ahead: Bool[np.ndarray, "markers 4"],
    fits: Bool[np.ndarray, "markers 4"],
    covariance: Float[np.ndarray, "unknowns unknowns"],
    noise: Noise,
    centre_scale: float,
) -> Bool[np.ndarray, "markers 4"]:
    """(markers, 4), True if the studentised residuals of the corner and of its marker's mean are in the gate."""
    used = np.any(fits, axis=1)
    good = ahead & _within(off_px, slopes, np.ones(fits.shape), covariance, noise, fits)
    count = np.maximum(good.sum(axis=1), 1)
    mean_px = (off_px * good[..., None]).sum(axis=1) / count[:, None]
    mean_slopes = (slopes * good[..., None, None]).sum(axis=1) / count[:, None, None]
    # Where means are more accurate than those of independent errors, the gate stays as wide as for independent errors.
    within = _within(mean_px, mean_slopes, count / max(centre_scale, 1.0) ** 2, covariance, noise, used)
    kept = within & (good.sum(axis=1) >= MIN_CORNERS)
    if used.sum() == 1:
        # The corners of a single marker give two equations more than unknowns, too few to find a bad corner.
        good[used], kept[used] = ahead[used], True
    return good & kept[:, None]


def _within(
    off_px: Float[np.ndarray, "*items 2"],
    slopes: Float[np.ndarray, "*items 2 unknowns"],
    count: Shaped[np.ndarray, "*items"],
    covariance: Float[np.ndarray, "unknowns unknowns"],
    noise: Noise,
    fitted: Bool[np.ndarray, "*items"],
) -> Bool[np.ndarray, "*items"]:
    """True for residuals that are within the gate of their covariance.

    The covariance is smaller than the noise for corners that were used in the fit, and larger for others.

    Args:
        off_px: (items, 2), residuals, each the mean over corners.
        slopes: (items, 2, unknowns), derivatives, the same means.
        count: (items,), number of corners of each mean.
        covariance: (unknowns, unknowns), covariance of the unknowns.
        noise: variances of the errors.
        fitted: (items,), True for items that were used in the fit.
    """
    own_px2 = noise.own_px2 / count
    by_place = slopes[..., :3]
    half = (slopes.reshape(-1, len(covariance)) @ covariance).reshape(slopes.shape)
    sign = np.where(fitted, -1.0, 1.0)
    of_place = noise.place_m2 * (by_place * by_place).sum(axis=-1)
    variance = of_place + sign[..., None] * (half * slopes).sum(axis=-1)
    # A residual without degrees of freedom has a variance of 0 and no information.
    least = _LEAST_VARIANCE * own_px2
    xx, yy = (np.maximum(own_px2 + variance[..., axis], least) for axis in (0, 1))
    xy = noise.place_m2 * (by_place[..., 0, :] * by_place[..., 1, :]).sum(axis=-1)
    xy += sign * (half[..., 0, :] * slopes[..., 1, :]).sum(axis=-1)
    x, y = off_px[..., 0], off_px[..., 1]
    square = (yy * x * x - 2 * xy * x * y + xx * y * y) / np.maximum(xx * yy - xy * xy, least * least)
    # Satterthwaite's degrees of freedom of a sum of variances, and the gate of 2 F(2, freedom), which exceeds x with a
    # probability of (1 + x / freedom)^(-freedom / 2).
    place_px2 = of_place.mean(axis=-1)
    parts = own_px2**2 / noise.own_freedom + place_px2**2 / noise.place_freedom
    freedom = (own_px2 + place_px2) ** 2 / parts
    return square < freedom * (FALSE_ALARM ** (-2 / freedom) - 1)


def _log_evidence(
    off_px: Float[np.ndarray, "corners 2"],
    num_corners: int,
    covariance: Float[np.ndarray, "6 6"],
    stated_px: float,
) -> float:
    """Logarithm of the density of all corners of a frame.

    Residuals of fitting corners have Student's t distribution, because their variance is integrated out. Other corners
    have a uniform density. The poses are integrated out by Laplace's approximation.

    Args:
        off_px: (corners, 2), residuals of the fitting corners.
        num_corners: number of all corners.
        covariance: (6, 6), covariance of the pose.
        stated_px: stated standard deviation of a corner.
    """
    count, prior_px2 = off_px.size, PRIOR_RESIDUALS * stated_px**2
    half = (PRIOR_RESIDUALS + count) / 2
    of_fitted = lgamma(half) - lgamma(PRIOR_RESIDUALS / 2) - count / 2 * log(pi * prior_px2)
    of_fitted -= half * log(1 + np.sum(off_px**2) / prior_px2)
    of_others = (num_corners - len(off_px)) * _LOG_ANYWHERE
    of_poses = 0.5 * (6 * log(2 * pi) + np.linalg.slogdet(covariance)[1])
    return float(of_fitted + of_others + of_poses)
