"""Where a camera stands, from points whose places in the world and in its image are known, in float64.

The perspective-n-point problem with a robust start (SQPnP of Terzakis & Lourakis, ECCV 2020, on sets of four points;
IPPE of Collins & Bartoli, IJCV 2014, where points are in a plane), least squares of the reprojection error with a
Cauchy loss, and once more without on the points that agree. The covariance is that of least squares,

    C = σ² (JᵀJ)⁻¹,

with σ as stated, or as the residuals say where they are larger than that σ explains.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from math import comb, log
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.stats import chi2

from psotrack.cameras import NEAR_M, Camera, project, undistort
from psotrack.errors import InputError, check_positive

#: A pose has six unknowns and a point gives two equations; the fourth point picks one of P3P's four answers.
MIN_POINTS = 4
#: Standard deviations from where it should be that make a point an outlier: 4 in a million good ones.
GATE = 5.0
#: Residuals that are this unlikely tell that σ is larger than stated.
UNLIKELY = 0.01
#: Times the stated σ that half of the points may be off, before nothing is believed.
_HOPELESS = 10.0
#: Of the largest extent, below which points have none in a direction.
_FLAT = 1e-3
#: Of the largest extent, below which a second pose, turned over, is looked for.
_NEARLY_FLAT = 0.1
#: Sets of four that the start is sought among; with 40 % outliers 13 in 100 of them are clean.
_MOST_SETS = 100
#: Starts that are refined.
_MOST_STARTS = 4
#: Two poses are told apart where one is this many times as likely as the other.
_ODDS = 100.0
#: Poses that differ by less are the same.
_SAME_RAD = np.deg2rad(2.0)


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


@dataclass(frozen=True)
class _Pose:
    R: Float[np.ndarray, "3 3"]
    t_m: Float[np.ndarray, "3"]
    #: The robust cost: minus the logarithm of the likelihood.
    cost: float = np.inf

    def turned_like(self, other: _Pose) -> bool:
        # The trace of a rotation by an angle is 1 + 2 cos(angle).
        return bool(np.sum(self.R * other.R) > 1 + 2 * np.cos(_SAME_RAD))


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
    pose, *others = _likely(points_m, points_px, lens, noise_px, extent_m, name)
    residual_px = _residual_px(points_m, points_px, pose, lens)
    _check_fit(points_m, points_px, lens, noise_px, extent_m, residual_px, name)
    _check_alone(pose, others, name)
    used = np.ones(len(points_m), bool)
    # The gate moves with the fit and the fit with the gate; what swings to and fro ends somewhere.
    for _ in range(10):
        within = residual_px <= GATE * max(noise_px, spread_px(residual_px[used], 6))
        before, used = used, within if within.sum() >= MIN_POINTS else used
        pose = _refined(points_m[used], points_px[used], pose, lens, noise_px, loss="linear")
        residual_px = _residual_px(points_m, points_px, pose, lens)
        if (used == before).all():
            break
    covariance = _covariance(points_m[used], pose, lens, noise_px, residual_px[used], name)
    by_pose = centre_by_pose(pose.R, pose.t_m)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3], T_cam_world[:3, 3] = pose.R, pose.t_m
    return Located(T_cam_world, covariance, by_pose @ covariance @ by_pose.T, residual_px, used)


def reproject(
    points_m: Float[np.ndarray, "points 3"],
    R: Float[np.ndarray, "3 3"],
    t_m: Float[np.ndarray, "3"],
    lens: Camera,
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 3"], Float[np.ndarray, "points 2 3"]]:
    """Pixels of points, and their derivatives by a small turn about the camera's axes (rad) and by its translation.

    They are OpenCV's, of normalised coordinates, so that they hold for a K with skew too.
    """
    turned = np.ascontiguousarray(points_m @ R.T)
    pixels, slopes = _slopes(turned, np.zeros(3), t_m, lens)
    return pixels, slopes[..., :3], slopes[..., 3:6]


def _slopes(
    points_m: Float[np.ndarray, "points 3"],
    turn: Float[np.ndarray, "3"],
    t_m: Float[np.ndarray, "3"],
    lens: Camera,
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 unknowns"]]:
    """Pixels, and their derivatives by a Rodrigues vector, a translation, and more that OpenCV knows."""
    K, dist = np.asarray(lens.K), np.asarray(lens.dist)
    bent, by = cv2.projectPoints(points_m[:, None], turn, t_m, np.eye(3), dist if dist.size else None)
    pixels = np.asarray(bent).reshape(-1, 2) @ K[:2, :2].T + K[:2, 2]
    return pixels, K[:2, :2] @ np.asarray(by).reshape(-1, 2, by.shape[-1])


def centre_by_pose(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 6"]:
    """Derivative of a camera's centre, -Rᵀ t, by a small turn about its axes and by its translation."""
    return np.hstack([-R.T @ cross_matrix(t_m), -R.T])


def cross_matrix(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """[v] with [v] w = v x w."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def spread_px(distance_px: Float[np.ndarray, " residuals"], unknowns: int) -> float:
    """σ along x and along y from distances in the image that some outliers are among: by their median.

    Args:
        distance_px: (residuals,), of a fit; 0 is returned where they are no more than the unknowns.
        unknowns: that were fitted to them.
    """
    equations = 2 * len(distance_px)
    if equations <= unknowns:
        return 0.0
    # The median of a Rayleigh distribution is σ √(2 ln 2); a fit takes the unknowns' share of the squares away.
    return float(np.median(distance_px) / np.sqrt(2 * log(2) * (1 - unknowns / equations)))


def inflation(sum_of_squares: float, freedom: int) -> float:
    """What a covariance is multiplied with, because the residuals are larger than their σ explains; else 1.

    Args:
        sum_of_squares: of residuals in units of their σ.
        freedom: number of residuals less that of the unknowns.
    """
    if freedom < 1 or sum_of_squares <= chi2.ppf(1 - UNLIKELY, freedom):
        return 1.0
    return sum_of_squares / freedom


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


def _likely(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
    extent_m: Float[np.ndarray, "3"],
    name: str,
) -> list[_Pose]:
    """Poses that no small change makes better, the most likely first."""
    started = _distinct(_starts(points_m, points_px, lens, noise_px, extent_m))
    found = _distinct(
        _refined(points_m, points_px, start, lens, noise_px, loss="cauchy") for start in started
    )
    if not found:
        raise InputError(
            name, expected="points that some pose fits", found="none that has them in front of it"
        )
    return found


def _check_alone(pose: _Pose, others: list[_Pose], name: str) -> None:
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


def _distinct(poses: Iterable[_Pose]) -> list[_Pose]:
    """The cheapest, without those that are much like a cheaper one."""
    found: list[_Pose] = []
    for pose in sorted(poses, key=lambda pose: pose.cost):
        if len(found) < _MOST_STARTS and np.isfinite(pose.cost) and not any(map(pose.turned_like, found)):
            found.append(pose)
    return found


def _starts(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
    extent_m: Float[np.ndarray, "3"],
) -> list[_Pose]:
    """Poses from all points, and from sets of four of which some have no outlier."""
    normalised = undistort(lens, points_px)
    count = len(points_m)
    if comb(count, MIN_POINTS) <= _MOST_SETS:
        sets = [list(four) for four in combinations(range(count), MIN_POINTS)]
    else:
        rng = np.random.default_rng(0)
        sets = [rng.permutation(count)[:MIN_POINTS].tolist() for _ in range(_MOST_SETS)]
    middle_m = points_m.mean(axis=0)
    axes = np.linalg.svd(points_m - middle_m)[2]
    flat = points_m - ((points_m - middle_m) @ axes[2])[:, None] * axes[2]
    methods = [(points_m, cv2.SOLVEPNP_SQPNP)]
    if extent_m[2] < _NEARLY_FLAT * extent_m[0]:
        methods.append((flat, cv2.SOLVEPNP_IPPE))
    if count == MIN_POINTS:
        # With more, some other set of four has a better start.
        methods.append((points_m, cv2.SOLVEPNP_AP3P))
    solved = [
        pose
        for rows in [list(range(count)), *sets]
        for places_m, method in methods
        for pose in _solved(places_m[rows], normalised[rows], method)
    ]
    if not solved:
        return []
    T = np.tile(np.eye(4), (len(solved), 1, 1))
    T[:, :3] = [np.column_stack(pose) for pose in solved]
    costs = _costs(points_m, points_px, T, lens, noise_px)
    return [_Pose(R, t_m, cost) for (R, t_m), cost in zip(solved, costs.tolist(), strict=True)]


def _solved(
    points_m: Float[np.ndarray, "points 3"], normalised: Float[np.ndarray, "points 2"], method: int
) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(points_m, normalised, np.eye(3), None, flags=method)
    except cv2.error:
        # Four points on a line, or the like.
        return []
    poses = [(cv2.Rodrigues(turn)[0], shift.ravel()) for turn, shift in zip(turns, shifts, strict=True)]
    return [(R, t_m) for R, t_m in poses if np.isfinite(R).all() and np.isfinite(t_m).all()]


def _costs(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    T_cam_world: Float[np.ndarray, "poses 4 4"],
    lens: Camera,
    noise_px: float,
) -> Float[np.ndarray, " poses"]:
    """The Cauchy loss of each pose; infinite where most points are behind the camera."""
    shape = (len(T_cam_world), 1)
    K, dist = (np.broadcast_to(value, shape + value.shape) for value in (lens.K, lens.dist))
    cameras = Camera(T_cam_world[:, None], K, dist, np.zeros((*shape, 2)))
    pixels, depth = project(cameras, points_m)
    loss = 0.5 * np.log1p(((pixels - points_px) / noise_px) ** 2).sum(axis=(-2, -1))
    return np.where(np.median(depth, axis=-1) > NEAR_M, loss, np.inf)


def _refined(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    start: _Pose,
    lens: Camera,
    noise_px: float,
    *,
    loss: Literal["linear", "cauchy"],
) -> _Pose:
    """The pose that minimises the loss of the reprojection error, from a start."""
    turned = np.ascontiguousarray(points_m @ start.R.T)

    def off(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, " equations"]:
        return ((_slopes(turned, x[:3], x[3:], lens)[0] - points_px) / noise_px).ravel()

    def slopes(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "equations 6"]:
        return _slopes(turned, x[:3], x[3:], lens)[1][..., :6].reshape(-1, 6) / noise_px

    result = least_squares(off, np.concatenate([np.zeros(3), start.t_m]), slopes, loss=loss, x_scale="jac")
    R = np.asarray(cv2.Rodrigues(result.x[:3])[0]) @ start.R
    T = np.eye(4)[None]
    T[0, :3] = np.column_stack([R, result.x[3:]])
    return _Pose(R, result.x[3:], float(_costs(points_m, points_px, T, lens, noise_px)[0]))


def _residual_px(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    pose: _Pose,
    lens: Camera,
) -> Float[np.ndarray, " points"]:
    """Distances in the image; infinite behind the camera."""
    distance = np.linalg.norm(reproject(points_m, pose.R, pose.t_m, lens)[0] - points_px, axis=-1)
    return np.where(points_m @ pose.R[2] + pose.t_m[2] > NEAR_M, distance, np.inf)


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
        twin = min(_starts(mirrored, points_px, lens, noise_px, extent_m), key=lambda one: one.cost)
        twin = _refined(mirrored, points_px, twin, lens, noise_px, loss="cauchy")
        if np.median(_residual_px(mirrored, points_px, twin, lens)) < 0.2 * typical_px:
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
    pose: _Pose,
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
