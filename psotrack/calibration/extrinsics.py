"""The pose of a camera, from points whose positions in the world and in the image are known, in float64.

The perspective-n-point problem is solved in three steps. Random sampling and solvers in closed form give first poses
(`pnp`), both poses of IPPE among them. Least squares of the reprojection error with a Cauchy
loss finds the outliers. Least squares without the outliers gives the pose and its covariance,

    C = σ² (JᵀJ)⁻¹,

with the stated σ, or with the residuals' σ if the residuals are larger than the stated σ explains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import log

import cv2
import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.derivatives import centre_by_pose, reproject
from psotrack.calibration.pnp import MIN_POINTS, Solver, solve_pnp, solve_pnp_ransac
from psotrack.calibration.residuals import GATE, inflation, spread_px
from psotrack.errors import InputError, check_positive
from psotrack.geometry import NEAR_M, Camera, undistort
from psotrack.geometry.estimation import (
    NormalEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    covariance_from_information,
    levenberg_marquardt,
)

#: Largest median residual of a usable pose, in units of the stated σ; points within it may be inliers.
_MAX_MEDIAN_SIGMAS = 10.0
#: Points have no extent in a direction if the extent is below this fraction of the largest extent.
_FLAT = 1e-3
#: A pose is unique if it is this many times as likely as every other pose.
_ODDS = 100.0
#: Poses are the same if the camera's orientations differ by less than this, radians.
_SAME_RAD = np.deg2rad(2.0)
#: Step that ends the search, in standard deviations.
_SETTLED = 1e-6
#: Largest ratio of an unknown's variance to its variance if the others were known: 1e5 standard deviations of rounding.
_MAX_INFLATION = 1e12


@dataclass(frozen=True)
class Located:
    """A camera's pose and its covariance.

    Attributes:
        T_cam_world: (4, 4), transform from world to camera, metres.
        covariance: (6, 6), covariance of a small turn about the camera's axes (rad) and of the translation (m).
        centre_covariance_m2: (3, 3), covariance of the camera's centre in the world, square metres.
        residual_px: (points,), distances of all points, outliers included, from their projections, pixels.
        used: (points,), False for outliers.
    """

    T_cam_world: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    centre_covariance_m2: Float[np.ndarray, "3 3"]
    residual_px: Float[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]


def locate_camera(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    K: Float[np.ndarray, "3 3"],
    dist: Float[np.ndarray, " coefficients"],
    noise_px: float = 1.0,
    *,
    fisheye: bool = False,
    name: str = "camera",
) -> Located:
    """Find the pose of a camera with a known lens, from points of known positions.

    Args:
        points_m: (points, 3), positions in the world, metres; at least four points, not on one line. All points may be
            in a plane.
        points_px: (points, 2), positions in the image, pixels.
        K: (3, 3), intrinsics in pixels.
        dist: (coefficients,), distortion coefficients in OpenCV's order.
        noise_px: standard deviation of `points_px` along each axis, pixels.
        fisheye: the lens has OpenCV's fisheye model.
        name: name of the camera in error messages.

    Raises:
        InputError: there are too few points, the points are on one line, two poses fit equally well, the points' axes
            are mirrored, or no pose fits.
        SettingsError: `noise_px` is not above 0.
    """
    check_positive("noise_px", noise_px)
    extent_m = _check_points(points_m, points_px, name)
    lens = Camera(np.eye(4), K, dist, np.zeros(2), np.array(True) if fisheye else None)
    fits = _likely_poses(points_m, points_px, lens, noise_px)
    typical_px = float(np.median(fits[0].distance_px)) if fits else np.inf
    if typical_px > _MAX_MEDIAN_SIGMAS * noise_px:
        mirrored_m = points_m * np.array([1.0, 1.0, -1.0])
        is_flat = extent_m[2] <= _FLAT * extent_m[0]
        twins = [] if is_flat else _likely_poses(mirrored_m, points_px, lens, noise_px)
        is_mirrored = any(np.median(twin.distance_px) < 0.2 * typical_px for twin in twins[:1])
        raise _no_pose(typical_px, noise_px, name, is_mirrored=is_mirrored)
    _check_unique(fits, name)
    fit = fits[0]
    # The gate depends on the fit and the fit on the gate. The number of rounds is limited in case they oscillate.
    for _ in range(10):
        within = fit.distance_px <= GATE * max(noise_px, spread_px(fit.distance_px[fit.used], 6))
        before, used = fit.used, within if within.sum() >= MIN_POINTS else fit.used
        fit = replace(fit, used=used, is_robust=False).solved()
        if (used == before).all():
            break
    try:
        covariance = covariance_from_information(fit.equations().information, _MAX_INFLATION)
    except np.linalg.LinAlgError:
        expected, found = "points that determine the camera's pose", "points that leave it undetermined"
        raise InputError(name, expected=expected, found=found) from None
    covariance = covariance * inflation(fit.cost, 2 * int(fit.used.sum()) - 6)
    by_pose = centre_by_pose(fit.T[:3, :3], fit.T[:3, 3])
    return Located(fit.T, covariance, by_pose @ covariance @ by_pose.T, fit.distance_px, fit.used)


@dataclass(frozen=True)
class _Fit:
    """A pose with its residuals, `estimation.least_squares.Linearised`.

    Attributes:
        points_m, points_px, lens, noise_px: see `locate_camera`.
        T: (4, 4), the pose, from world to camera.
        used: (points,), False for outliers.
        is_robust: whether the loss is Cauchy's instead of the squared residual.
    """

    points_m: Float[np.ndarray, "points 3"]
    points_px: Float[np.ndarray, "points 2"]
    lens: Camera
    noise_px: float
    T: Float[np.ndarray, "4 4"]
    used: Bool[np.ndarray, " points"]
    is_robust: bool = True

    @cached_property
    def _linear(self) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 6"]]:
        """Residuals, measured minus projected, and derivatives by turn and shift, in standard deviations."""
        pixels, by_turn, by_shift = reproject(self.points_m, self.T[:3, :3], self.T[:3, 3], self.lens)
        slopes = np.concatenate([by_turn, by_shift], axis=-1)
        return (self.points_px - pixels) / self.noise_px, slopes / self.noise_px

    @cached_property
    def squares(self) -> Float[np.ndarray, " points"]:
        """Squared residuals in variances; 0 of outliers."""
        return np.where(self.used, np.sum(self._linear[0] ** 2, axis=-1), 0.0)

    @cached_property
    def depth_m(self) -> Float[np.ndarray, " points"]:
        """Depths of the points along the optical axis."""
        return self.points_m @ self.T[2, :3] + self.T[2, 3]

    @cached_property
    def distance_px(self) -> Float[np.ndarray, " points"]:
        """Distances of points from their projections, pixels; infinite for points behind the camera."""
        distance = self.noise_px * np.linalg.norm(self._linear[0], axis=-1)
        return np.where(self.depth_m > NEAR_M, distance, np.inf)

    @cached_property
    def cost(self) -> float:
        """Sum of the losses: minus twice the logarithm of the likelihood."""
        return float(np.sum(cauchy_loss(self.squares) if self.is_robust else self.squares))

    def equations(self) -> NormalEquations:
        """Normal equations of a small turn about the camera's axes (rad) and of the translation (m)."""
        weight = self.used * (cauchy_weight(self.squares) if self.is_robust else 1.0)
        residuals, slopes = self._linear
        weighted = (weight[:, None, None] * slopes).reshape(-1, 6)
        return NormalEquations(weighted.T @ slopes.reshape(-1, 6), weighted.T @ residuals.ravel())

    def moved(self, step: Step) -> _Fit:
        """Turn and shift the camera."""
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(step.shared[:3])[0] @ self.T[:3, :3]
        T[:3, 3] = self.T[:3, 3] + step.shared[3:]
        return replace(self, T=T)

    def solved(self) -> _Fit:
        """Lower the cost from this pose."""
        return levenberg_marquardt(self, max_steps=100, least_length=_SETTLED)


def _likely_poses(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
) -> list[_Fit]:
    """Local minima of the robust cost, the most likely pose first."""
    # A pixel at which the lens shows nothing starts no pose, and counts as an outlier.
    rays = undistort(lens, points_px)
    gate = _MAX_MEDIAN_SIGMAS * noise_px / float(np.sqrt(lens.K[0, 0] * lens.K[1, 1]))
    sampled = solve_pnp_ransac(points_m, rays, gate)
    everything = np.ones(len(rays), bool)
    near = everything if sampled is None else sampled[1]
    # Points that are nearly in a plane may fit a second pose, which IPPE finds; four points may fit four.
    solvers: list[Solver] = ["sqpnp", "ippe"]
    if len(rays) == MIN_POINTS:
        solvers.append("ap3p")
    fits = [
        _Fit(points_m, points_px, lens, noise_px, T, everything).solved()
        for solver in solvers
        for T in solve_pnp(points_m[near], rays[near], solver)
    ]
    found: list[_Fit] = []
    for fit in sorted(fits, key=lambda fit: fit.cost):
        # The trace of a rotation by an angle is 1 + 2 cos(angle).
        is_new = all(np.sum(fit.T[:3, :3] * one.T[:3, :3]) <= 1 + 2 * np.cos(_SAME_RAD) for one in found)
        if is_new and np.median(fit.depth_m) > NEAR_M:
            found.append(fit)
    return found


def _check_points(
    points_m: Float[np.ndarray, "points 3"], points_px: Float[np.ndarray, "points 2"], name: str
) -> Float[np.ndarray, "3"]:
    """The extents of the points along their principal axes, largest first."""
    if len(points_m) != len(points_px) or len(points_m) < MIN_POINTS:
        raise InputError(
            name, expected=f"at least {MIN_POINTS} points of known position", found=f"{len(points_m)}"
        )
    if not (np.isfinite(points_m).all() and np.isfinite(points_px).all()):
        raise InputError(name, expected="points with finite coordinates", found="NaN or infinity")
    extent_m = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    if extent_m[1] <= _FLAT * extent_m[0]:
        raise InputError(
            name,
            expected="points that are not all on one line",
            found=f"{len(points_m)} points on one line",
            remedy="mark points beside this line",
        )
    return extent_m


def _check_unique(fits: list[_Fit], name: str) -> None:
    """Raise an error if another pose, far from the best one, is about as likely."""
    for other in fits[1:]:
        if other.cost - fits[0].cost < 2 * log(_ODDS):
            first, second = (-fit.T[:3, :3].T @ fit.T[:3, 3] for fit in (fits[0], other))
            raise InputError(
                name,
                expected="points that only one pose fits",
                found=f"two poses, {np.linalg.norm(first - second):.2g} m apart, that fit equally well",
                remedy="mark more points that are not in the plane of the others",
            )


def _no_pose(typical_px: float, noise_px: float, name: str, *, is_mirrored: bool) -> InputError:
    """Error of points that no pose fits, which names the cause if it is a mirrored world."""
    if is_mirrored:
        return InputError(
            name,
            expected="points in right-handed axes",
            found="points that fit a mirrored world",
            remedy="reverse the axis that has the wrong sign, or swap back two axes",
        )
    return InputError(
        name,
        expected=f"a pose that most points fit to about {noise_px:g} px",
        found="none" if np.isinf(typical_px) else f"a median distance of {typical_px:.0f} px",
        remedy="check for points that are mixed up, and for the lens of another camera",
    )
