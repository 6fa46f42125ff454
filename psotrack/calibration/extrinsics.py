"""Where a camera stands, from points whose places in the world and in its image are known, in float64.

The perspective-n-point problem with a robust start (SQPnP of Terzakis & Lourakis, ECCV 2020, on sets of four points;
IPPE of Collins & Bartoli, IJCV 2014, where points are in a plane), least squares of the reprojection error with a
Cauchy loss, and once more without on the points that agree. The covariance is that of least squares,

    C = σ² (JᵀJ)⁻¹,

with σ as stated, or as the residuals say where they are larger than that σ explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.derivatives import centre_by_pose, reproject
from psotrack.calibration.pose_search import MIN_POINTS, Pose, distances_px, likely, refined, starts_of
from psotrack.calibration.residuals import GATE, inflation, spread_px
from psotrack.errors import InputError, check_positive
from psotrack.geometry import Camera

#: Times the stated σ that half of the points may be off, before nothing is believed.
_HOPELESS = 10.0
#: Of the largest extent, below which points have none in a direction.
_FLAT = 1e-3
#: Two poses are told apart where one is this many times as likely as the other.
_ODDS = 100.0


@dataclass(frozen=True)
class Located:
    """A camera's pose and how sure it is.

    Attributes:
        T_cam_world: (4, 4), world to camera, metres.
        covariance: (6, 6), of a small turn about the camera's axes, rad, and of the translation, m.
        centre_covariance_m2: (3, 3), of the camera's centre, world, m².
        residual_px: (points,), distances in the image, outliers too.
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
    name: str = "camera",
) -> Located:
    """The pose of a camera whose lens is known, from points of known places.

    Args:
        points_m: (points, 3), world, metres; at least four, not on one line. They may be in a plane.
        points_px: (points, 2), where the camera sees them.
        K: (3, 3), intrinsics in pixels.
        dist: (coefficients,), of the lens, in OpenCV's order.
        noise_px: standard deviation of `points_px`, along x and along y.
        name: of the camera, for messages.

    Raises:
        InputError: there are too few points, they are on one line, two poses fit them as well, their axes are
            mirrored, or no pose fits them.
        SettingsError: the noise is not above 0.
    """
    check_positive("noise_px", noise_px)
    extent_m = _check_points(points_m, points_px, name)
    lens = Camera(np.eye(4), K, dist, np.zeros(2))
    pose, *others = likely(points_m, points_px, lens, noise_px, extent_m, name)
    residual_px = distances_px(points_m, points_px, pose, lens)
    _check_fit(points_m, points_px, lens, noise_px, extent_m, residual_px, name)
    _check_alone(pose, others, name)
    used = np.ones(len(points_m), bool)
    # The gate moves with the fit and the fit with the gate; what swings to and fro ends somewhere.
    for _ in range(10):
        within = residual_px <= GATE * max(noise_px, spread_px(residual_px[used], 6))
        before, used = used, within if within.sum() >= MIN_POINTS else used
        pose = refined(points_m[used], points_px[used], pose, lens, noise_px, loss="linear")
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
            name, expected=f"at least {MIN_POINTS} points of known place", found=f"{len(points_m)}"
        )
    if not (np.isfinite(points_m).all() and np.isfinite(points_px).all()):
        raise InputError(name, expected="points with finite coordinates", found="NaN or infinity")
    extent_m = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    if extent_m[1] <= _FLAT * extent_m[0]:
        raise InputError(
            name,
            expected="points that are not all on one line",
            found=f"{len(points_m)} that are",
            remedy="mark some beside it",
        )
    return extent_m


def _check_alone(pose: Pose, others: list[Pose], name: str) -> None:
    """Refuse a pose where another one, far from it, is about as likely."""
    for other in others:
        if other.cost - pose.cost < log(_ODDS):
            apart_m = np.linalg.norm(pose.R.T @ pose.t_m - other.R.T @ other.t_m)
            raise InputError(
                name,
                expected="points that only one pose fits",
                found=f"two poses, {apart_m:.2g} m apart, that fit as well",
                remedy="mark more points, some of them off the plane of the others",
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
    """Refuse what no camera can have seen, and say why where it can be told."""
    typical_px = float(np.median(residual_px))
    if typical_px <= _HOPELESS * noise_px:
        return
    if extent_m[2] > _FLAT * extent_m[0]:
        mirrored = points_m * np.array([1.0, 1.0, -1.0])
        twin = min(starts_of(mirrored, points_px, lens, noise_px, extent_m), key=lambda one: one.cost)
        twin = refined(mirrored, points_px, twin, lens, noise_px, loss="cauchy")
        if np.median(distances_px(mirrored, points_px, twin, lens)) < 0.2 * typical_px:
            raise InputError(
                name,
                expected="points in right-handed axes",
                found="a mirrored world, which they fit",
                remedy="one axis points the wrong way, or two are swapped",
            )
    raise InputError(
        name,
        expected=f"a pose that most points fit to about {noise_px:g} px",
        found=f"{typical_px:.0f} px for half of them",
        remedy="are points mixed up, or is it another camera's lens?",
    )


def _covariance(
    points_m: Float[np.ndarray, "points 3"],
    pose: Pose,
    lens: Camera,
    noise_px: float,
    residual_px: Float[np.ndarray, " points"],
    name: str,
) -> Float[np.ndarray, "6 6"]:
    _, by_turn, by_shift = reproject(points_m, pose.R, pose.t_m, lens)
    slopes = np.concatenate([by_turn, by_shift], axis=-1).reshape(-1, 6) / noise_px
    # A QR instead of JᵀJ, which would square the condition; columns of like length.
    scale = np.linalg.norm(slopes, axis=0)
    triangle = np.linalg.qr(slopes / scale, mode="r")
    if np.linalg.cond(triangle) > 1e10:
        raise InputError(name, expected="points that fix the camera's pose", found="some that leave it free")
    half = np.linalg.inv(triangle) / scale[:, None]
    factor = inflation(float(np.sum((residual_px / noise_px) ** 2)), 2 * len(points_m) - 6)
    return factor * half @ half.T
