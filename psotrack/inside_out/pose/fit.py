"""The most likely pose near a start: robust steps first, then those of all corners that fit, and which ones do.

Which corners and markers fit, studentised residuals tell: residuals in units of their own standard deviations (Cook &
Weisberg, Residuals and influence in regression, 1982, section 2.2). The covariance is the inverse of the information,
with the inset, the focal length and the markers' places integrated out (see `equations`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log, pi

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from psotrack.calibration import spread_px
from psotrack.geometry import NEAR_M
from psotrack.inside_out.pose.equations import (
    PRIOR_RESIDUALS,
    Noise,
    SeenCorners,
    Solution,
    Sums,
    add_known,
    equations,
    log_known,
    summed,
)

#: Probability that a good corner, or the mean of a good marker, is taken for an outlier.
FALSE_ALARM = 1e-3
#: Corners that a marker needs: with two bad ones nobody knows what was found.
MIN_CORNERS = 3
#: Times its stated deviation that a marker's place is taken to be off at first: what begins too large shrinks within
#: few steps, what begins too small takes many to grow.
_START = 10.0
#: Times the stated noise, and metres off their places, that corners and markers may be before nothing is believed.
_HOPELESS, _HOPELESS_M = 30.0, 0.05
#: Of Gauss-Newton, with robust weights and without; and the step from which on no corner comes back.
_MOST_STEPS, _SETTLED = 12, 5
#: Squares of steps in standard deviations: near enough for robust weights, and the last one.
_NEAR, _LAST = 1.0, 1e-2
#: Scales of the robust weights within which a corner counts from then on.
_WITHIN = 4.0
#: A start may be far off: longest steps in rad, and of the markers' distance.
_LONGEST = 0.3
#: Share of a residual's own variance that is left to it at least.
_LEAST = 0.02
#: Logarithm of the density of a corner that is not where it should be: somewhere within about 100 x 100 px.
_LOG_ANYWHERE = -2 * log(100.0)


@dataclass(frozen=True)
class Fit:
    """A pose that no small change makes better.

    Attributes:
        position_m: (3,), the camera's centre, world.
        R_world_cam: (3, 3), camera to world.
        covariance: (6, 6), as in `CameraPath`.
        common: (6, 3 markers + 1), what one standard deviation of each marker's place in the map along each axis, and
            of the focal length, does to it.
        fits: (markers, 4), corners that the pose explains.
        reprojection_px: root mean square of their distances in the image.
        log_evidence: logarithm of the probability density of all corners, whatever the pose is near this one.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "6 errors"]
    fits: Bool[np.ndarray, "markers 4"]
    reprojection_px: float
    log_evidence: float

    @property
    def used(self) -> Bool[np.ndarray, "markers"]:
        """(markers,), those that the pose explains."""
        return np.any(self.fits, axis=1)


def fit(
    seen: SeenCorners,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    fits: Bool[np.ndarray, "markers 4"] | None = None,
) -> Fit | None:
    """The pose near a start, and the corners that it explains.

    Args:
        seen: the frame's markers.
        position_m: (3,), the camera's centre, world.
        R_world_cam: (3, 3), camera to world.
        fits: (markers, 4), corners that the start explains; None takes those that robust steps end at.

    Returns:
        None where the markers leave the pose free, or it explains none of them.
    """
    pose = _Pose(position_m, R_world_cam, np.zeros(2))
    if fits is None:
        pose, fits = _robust(seen, pose)
    noise = Noise(seen.noise_px**2, (_START * seen.place_m) ** 2, PRIOR_RESIDUALS, PRIOR_RESIDUALS)
    for number in range(_MOST_STEPS):
        rows, depth_m = equations(seen, pose.position_m, pose.R_world_cam, pose.extra)
        ahead = depth_m > NEAR_M
        sums = summed(rows, fits & ahead)
        solution = sums.solved(noise, pose.extra)
        if solution is None:
            return None
        pose = pose.stepped(solution.step, depth_m)
        off_px = rows @ np.append(-solution.step, 1.0)
        explained = fits & ahead
        if number > 0:
            # By the noise that is stated nothing is judged, only by what the residuals have made of it.
            explained = _explained(off_px, rows[..., :8], ahead, fits, solution.covariance, noise)
        if number >= _SETTLED:
            # The gates move with the fit and the fit with the gates; what swings to and fro ends outside.
            explained &= fits
        noise, length = sums.noise(solution, noise, seen), solution.length
        if number > 0 and length < _LAST and (explained == fits).all():
            break
        fits, before = explained, fits
    else:
        # The last step was that of the corners before.
        fits = before
    if length > _NEAR:
        return None
    return _fitted(seen, pose, fits, off_px, sums, noise)


@dataclass(frozen=True)
class _Pose:
    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    extra: Float[np.ndarray, "2"]

    def stepped(self, step: Float[np.ndarray, "8"], depth_m: Float[np.ndarray, "markers 4"]) -> _Pose:
        distance_m = np.maximum(depth_m, NEAR_M).mean()
        longest = max(np.linalg.norm(step[:3]) / distance_m, np.linalg.norm(step[3:6]), _LONGEST)
        step = step * (_LONGEST / longest)
        turn = np.asarray(cv2.Rodrigues(step[3:6])[0])
        return _Pose(self.position_m + step[:3], self.R_world_cam @ turn, self.extra + step[6:])


def _fitted(
    seen: SeenCorners,
    pose: _Pose,
    fits: Bool[np.ndarray, "markers 4"],
    off_px: Float[np.ndarray, "markers 4 2"],
    sums: Sums,
    noise: Noise,
) -> Fit | None:
    """What is to be said of a pose and of the corners that it explains; None where nothing is to be believed."""
    widened = noise.widened()
    solution: Solution | None = sums.solved(widened, pose.extra)
    hopeless = noise.own_px2 > (_HOPELESS * seen.noise_px) ** 2 or noise.place_m2 > _HOPELESS_M**2
    if solution is None or hopeless:
        return None
    covariance = solution.covariance[:6, :6]
    # The inset is part of what was measured: the distance in the image is without it.
    distance_px = np.linalg.norm(off_px + pose.extra[0] * seen.inward, axis=-1)[fits]
    return Fit(
        pose.position_m,
        pose.R_world_cam,
        covariance,
        sums.common(solution, widened, seen.map_share),
        fits,
        float(np.sqrt(np.mean(distance_px**2))),
        _log_evidence(off_px[fits], fits.size, covariance, seen.noise_px) + log_known(pose.extra),
    )


def _robust(seen: SeenCorners, pose: _Pose) -> tuple[_Pose, Bool[np.ndarray, "markers 4"]]:
    """Steps with the weights of a Cauchy loss, whose scale is the residuals' median, and what is within them then."""
    for _ in range(_MOST_STEPS):
        rows, depth_m = equations(seen, pose.position_m, pose.R_world_cam, pose.extra)
        distance_px = np.where(depth_m > NEAR_M, np.linalg.norm(rows[..., 8], axis=-1), np.inf)
        scale_px = max(seen.noise_px, spread_px(distance_px.ravel(), 6))
        fits = distance_px < _WITHIN * scale_px
        if not np.isfinite(scale_px):
            break
        weighted = (rows / np.hypot(scale_px, distance_px)[..., None, None]).reshape(-1, 9)
        total = weighted.T @ weighted
        add_known(total, pose.extra)
        try:
            step = np.linalg.solve(total[:8, :8], total[:8, 8])
        except np.linalg.LinAlgError:
            break
        pose = pose.stepped(step, depth_m)
        if step @ total[:8, 8] < _NEAR:
            break
    return pose, fits


def _explained(
    off_px: Float[np.ndarray, "markers 4 2"],
    slopes: Float[np.ndarray, "markers 4 2 8"],
    ahead: Bool[np.ndarray, "markers 4"],
    fits: Bool[np.ndarray, "markers 4"],
    covariance: Float[np.ndarray, "8 8"],
    noise: Noise,
) -> Bool[np.ndarray, "markers 4"]:
    """Corners, and markers' means, whose studentised residuals are within the gates."""
    used = np.any(fits, axis=1)
    good = ahead & _within(off_px, slopes, np.ones(fits.shape), covariance, noise, fits)
    count = np.maximum(good.sum(axis=1), 1)
    mean_px = (off_px * good[..., None]).sum(axis=1) / count[:, None]
    mean_slopes = (slopes * good[..., None, None]).sum(axis=1) / count[:, None, None]
    within = _within(mean_px, mean_slopes, count, covariance, noise, used)
    kept = within & (good.sum(axis=1) >= MIN_CORNERS)
    if used.sum() == 1:
        # Its four corners are two equations more than the unknowns: they cannot tell which of them is bad.
        good[used], kept[used] = ahead[used], True
    return good & kept[:, None]


def _within(
    off_px: Float[np.ndarray, "*items 2"],
    slopes: Float[np.ndarray, "*items 2 8"],
    count: Shaped[np.ndarray, "*items"],
    covariance: Float[np.ndarray, "8 8"],
    noise: Noise,
    fitted: Bool[np.ndarray, "*items"],
) -> Bool[np.ndarray, "*items"]:
    """Whether residuals, each the mean of so many corners, are as small as their covariance says.

    That is less than the noise where they were fitted, else more.
    """
    own_px2 = noise.own_px2 / count
    by_place = slopes[..., :3]
    half = (slopes.reshape(-1, 8) @ covariance).reshape(slopes.shape)
    sign = np.where(fitted, -1.0, 1.0)
    of_place = noise.place_m2 * (by_place * by_place).sum(axis=-1)
    variance = of_place + sign[..., None] * (half * slopes).sum(axis=-1)
    # A residual that has no freedom left says nothing.
    least = _LEAST * own_px2
    xx, yy = (np.maximum(own_px2 + variance[..., axis], least) for axis in (0, 1))
    xy = noise.place_m2 * (by_place[..., 0, :] * by_place[..., 1, :]).sum(axis=-1)
    xy += sign * (half[..., 0, :] * slopes[..., 1, :]).sum(axis=-1)
    x, y = off_px[..., 0], off_px[..., 1]
    square = (yy * x * x - 2 * xy * x * y + xx * y * y) / np.maximum(xx * yy - xy * xy, least * least)
    # Satterthwaite's freedom of a sum of variances, and the gate of 2 F(2, freedom), which exceeds x with a probability
    # of (1 + x / freedom)^(-freedom / 2).
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
    """Logarithm of a density: of residuals whose variance is integrated out (Student's t), of the other corners, which
    may be anywhere, and of the poses that explain them (Laplace's approximation)."""
    count, prior_px2 = off_px.size, PRIOR_RESIDUALS * stated_px**2
    half = (PRIOR_RESIDUALS + count) / 2
    of_fitted = lgamma(half) - lgamma(PRIOR_RESIDUALS / 2) - count / 2 * log(pi * prior_px2)
    of_fitted -= half * log(1 + np.sum(off_px**2) / prior_px2)
    of_others = (num_corners - len(off_px)) * _LOG_ANYWHERE
    of_poses = 0.5 * (6 * log(2 * pi) + np.linalg.slogdet(covariance)[1])
    return float(of_fitted + of_others + of_poses)
