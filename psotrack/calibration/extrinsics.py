"""The pose of a camera, from points whose positions in the world and in the image are known, in float64.

The perspective-n-point problem is solved in three steps. Closed-form solvers give initial poses (SQPnP of Terzakis &
Lourakis, ECCV 2020, on sets of four points; IPPE of Collins & Bartoli, IJCV 2014, for points in a plane). Least squares
of the reprojection error with a Cauchy loss finds the outliers. Least squares without the outliers gives the pose and
its covariance,

    C = σ² (JᵀJ)⁻¹,

with the stated σ, or with the residuals' σ if the residuals are larger than the stated σ explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.derivatives import centre_by_pose, reproject
from psotrack.calibration.pose_search import (
    MIN_POINTS,
    Pose,
    distances_px,
    find_likely_poses,
    initial_poses,
    refine_pose,
)
from psotrack.calibration.residuals import GATE, inflation, spread_px
from psotrack.errors import InputError, check_positive
from psotrack.geometry import Camera

#: Largest median residual of a usable pose, in units of the stated σ.
_MAX_MEDIAN_SIGMAS = 10.0
#: Points have no extent in a direction if the extent is below this share of the largest extent.
_FLAT = 1e-3
#: A pose is unique if it is this many times as likely as every other pose.
_ODDS = 100.0


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
    pose, *others = find_likely_poses(points_m, points_px, lens, noise_px, extent_m, name)
    residual_px = distances_px(points_m, points_px, pose, lens)
    _check_fit(points_m, points_px, lens, noise_px, extent_m, residual_px, name)
    _check_unique(pose, others, name)
    used = np.ones(len(points_m), bool)
    # The gate depends on the fit and the fit on the gate. The number of rounds is limited in case they oscillate.
    for _ in range(10):
        within = residual_px <= GATE * max(noise_px, spread_px(residual_px[used], 6))
        before, used = used, within if within.sum() >= MIN_POINTS else used
        pose = refine_pose(points_m[used], points_px[used], pose, lens, noise_px, loss="linear")
        residual_px = distances_px(points_m, points_px, pose, lens)
        if (used == before).all():
            break
    covariance = _covariance(points_m[used], pose, lens, noise_px, residual_px[used], name)
    by_pose = centre_by_pose(pose.R, pose.t_m)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = pose.R, pose.t_m
    return Located(T_cam_world, covariance, by_pose @ covariance @ by_pose.T, residual_px, used)


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


def _check_unique(pose: Pose, others: list[Pose], name: str) -> None:
    """Raise an error if another pose, far from the found pose, is about as likely."""
    for other in others:
        if other.cost - pose.cost < log(_ODDS):
            apart_m = np.linalg.norm(pose.R.T @ pose.t_m - other.R.T @ other.t_m)
            raise InputError(
                name,
                expected="points that only one pose fits",
                found=f"two poses, {apart_m:.2g} m apart, that fit equally well",
                remedy="mark more points that are not in the plane of the others",
            )


def _check_fit(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
    extent_m: Float[np.ndarray, "3"],
    residual_px: Float[np.ndarray, " points"],
    name: str,
) -> None:
    """Raise an error if the pose does not fit most points, and name the cause if it is a mirrored world."""
    typical_px = float(np.median(residual_px))
    if typical_px <= _MAX_MEDIAN_SIGMAS * noise_px:
        return
    if extent_m[2] > _FLAT * extent_m[0]:
        mirrored = points_m * np.array([1.0, 1.0, -1.0])
        twin = min(initial_poses(mirrored, points_px, lens, noise_px, extent_m), key=lambda pose: pose.cost)
        twin = refine_pose(mirrored, points_px, twin, lens, noise_px, loss="cauchy")
        if np.median(distances_px(mirrored, points_px, twin, lens)) < 0.2 * typical_px:
            raise InputError(
                name,
                expected="points in right-handed axes",
                found="points that fit a mirrored world",
                remedy="reverse the axis that has the wrong sign, or swap back two axes",
            )
    raise InputError(
        name,
        expected=f"a pose that most points fit to about {noise_px:g} px",
        found=f"a median distance of {typical_px:.0f} px",
        remedy="check for points that are mixed up, and for the lens of another camera",
    )


def _covariance(
    points_m: Float[np.ndarray, "points 3"],
    pose: Pose,
    lens: Camera,
    noise_px: float,
    residual_px: Float[np.ndarray, " points"],
    name: str,
) -> Float[np.ndarray, "6 6"]:
    """Covariance of a small turn about the camera's axes (rad) and of the translation (m)."""
    _, by_turn, by_shift = reproject(points_m, pose.R, pose.t_m, lens)
    slopes = np.concatenate([by_turn, by_shift], axis=-1).reshape(-1, 6) / noise_px
    # QR keeps the condition number that JᵀJ would square. Columns are scaled to the same length.
    scale = np.linalg.norm(slopes, axis=0)
    triangle = np.linalg.qr(slopes / scale, mode="r")
    if np.linalg.cond(triangle) > 1e10:
        raise InputError(
            name,
            expected="points that determine the camera's pose",
            found="points that leave it undetermined",
        )
    half = np.linalg.inv(triangle) / scale[:, None]
    factor = inflation(float(np.sum((residual_px / noise_px) ** 2)), 2 * len(points_m) - 6)
    return factor * half @ half.T
