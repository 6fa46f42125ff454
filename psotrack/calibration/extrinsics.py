"""The pose of a camera, from points whose positions in the world and in the image are known, in float64.

The perspective-n-point problem is solved in three steps. Random sampling and OpenCV's solvers in closed form give first
poses, both poses of IPPE among them. They take rays, the directions x / z, y / z in which points are seen without
distortion (`psotrack.geometry.undistort`), so every lens of ours is served; a ray is NaN where a point is not seen, and
no random number of OpenCV is used or changed. Least squares of the reprojection error with a Cauchy loss finds the
outliers. Least squares without the outliers gives the pose and its covariance,

    C = σ² (JᵀJ)⁻¹,

with the residuals' σ. Residuals that a slightly different lens explains (an F test) are not noise but the lens's error,
which moves the camera by more than C says. C is then that of a camera whose lens is open, and contains the step from
the one pose to the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

from psotrack.calibration.bundle import GATE, Bundle, BundleState, KnownLens, centre_by_pose, spread_px
from psotrack.calibration.lens_models import known_lenses
from psotrack.errors import InputError, check_positive
from psotrack.geometry import FISHEYE_COEFFICIENTS, NEAR_M, Camera, make_rig, undistort
from psotrack.geometry.estimation import covariance_from_information

#: Solvers in closed form: SQPnP (Terzakis & Lourakis, ECCV 2020) of any points; IPPE (Collins & Bartoli, IJCV 2014) of
#: points in a plane, both poses; AP3P (Ke & Roumeliotis, CVPR 2017) of four points, with up to four poses.
Solver = Literal["sqpnp", "ippe", "ap3p"]
_FLAGS = {"sqpnp": cv2.SOLVEPNP_SQPNP, "ippe": cv2.SOLVEPNP_IPPE, "ap3p": cv2.SOLVEPNP_AP3P}
#: A pose has six unknowns and a point gives two equations; the fourth point selects one of P3P's four solutions.
MIN_POINTS = 4
#: Largest median residual of a usable pose, in units of the stated σ; points within it may be inliers.
_MAX_MEDIAN_SIGMAS = 10.0
#: Standard deviations of a lens that is open: the focal lengths as a fraction, the optical axis in image widths, and
#: the first two coefficients of the distortion. They are wide, and matter where the points leave the lens undetermined.
_LENS_STD = np.array([0.1, 0.1, 0.05, 0.05, 0.3, 0.3])
#: Residuals are not noise if an open lens explains as much by chance in fewer than this fraction of cases; smallest
#: number of residuals that are left to tell.
_BY_CHANCE, _LEAST_FREEDOM = 0.01, 4
#: Points have no extent in a direction if the extent is below this fraction of the largest extent.
_FLAT = 1e-3
#: A pose is unique if it is this many times as likely as every other pose.
_ODDS = 100.0
#: Poses are the same if the camera's orientations differ by less than this, radians.
_SAME_RAD = np.deg2rad(2.0)
#: Largest ratio of an unknown's variance to its variance if the others were known: 1e5 standard deviations of rounding.
_MAX_INFLATION = 1e12


def solve_pnp(
    points_m: Float[np.ndarray, "points 3"], rays: Float[np.ndarray, "points 2"], solver: Solver = "sqpnp"
) -> Float[np.ndarray, "poses 4 4"]:
    """Find all poses that a solver in closed form gives for points, with every point in front of the camera.

    Args:
        points_m: (points, 3), positions in the world, metres. IPPE moves them into their plane first.
        rays: (points, 2), directions in which they are seen.
        solver: the solver; AP3P takes four points.

    Returns:
        (poses, 4, 4), the pose of smallest reprojection error first; none of fewer than four points, or of points that
        determine no pose, such as points on a line.
    """
    points_m, rays, _ = _seen(points_m, rays)
    if len(rays) < MIN_POINTS:
        return np.zeros((0, 4, 4))
    to_solve = _flattened(points_m) if solver == "ippe" else points_m
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(to_solve, rays, np.eye(3), None, flags=_FLAGS[solver])
    except cv2.error:
        # OpenCV fails for degenerate points, such as points on a line.
        return np.zeros((0, 4, 4))
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    for T, turn, shift in zip(poses, turns, shifts, strict=True):
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    distance = ray_distances(points_m, rays, poses)
    is_ahead = np.isfinite(distance).all(axis=1)
    poses, distance = poses[is_ahead], distance[is_ahead]
    return poses[np.argsort(np.sum(distance**2, axis=1))]


def ray_distances(
    points_m: Float[np.ndarray, "points 3"],
    rays: Float[np.ndarray, "points 2"],
    T_cam_world: Float[np.ndarray, "*poses 4 4"],
) -> Float[np.ndarray, "*poses points"]:
    """Distances of points' projections from the rays, at a focal length of 1; infinite behind the camera.

    Args:
        points_m: (points, 3), positions in the world, metres.
        rays: (points, 2), directions in which they are seen; the distance is NaN where one is NaN.
        T_cam_world: (..., 4, 4), poses.
    """
    in_camera = points_m @ T_cam_world[..., :3, :3].swapaxes(-1, -2) + T_cam_world[..., None, :3, 3]
    is_ahead = in_camera[..., 2] > NEAR_M
    depth_m = np.where(is_ahead, in_camera[..., 2], 1.0)[..., None]
    distance = np.linalg.norm(in_camera[..., :2] / depth_m - rays, axis=-1)
    return np.where(is_ahead | np.isnan(distance), distance, np.inf)


def solve_pnp_ransac(
    points_m: Float[np.ndarray, "points 3"],
    rays: Float[np.ndarray, "points 2"],
    gate: float,
    *,
    tries: int = 300,
) -> tuple[Float[np.ndarray, "4 4"], Bool[np.ndarray, " points"]] | None:
    """Find the pose that most points fit: AP3P of random samples of four (RANSAC), then SQPnP of the points that fit.

    Args:
        points_m: (points, 3), positions in the world, metres.
        rays: (points, 2), directions in which they are seen.
        gate: largest distance of a ray from its point's projection, at a focal length of 1: pixels over the focal
            length.
        tries: largest number of samples.

    Returns:
        the pose; and (points,), True for the points that fit. None if no pose fits four points.
    """
    seen_m, seen_rays, is_seen = _seen(points_m, rays)
    if len(seen_rays) < MIN_POINTS:
        return None
    try:
        _, _, _, inliers = cv2.solvePnPRansac(
            seen_m,
            seen_rays,
            np.eye(3),
            None,
            iterationsCount=tries,
            reprojectionError=gate,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_AP3P,
        )
    except cv2.error:
        # OpenCV refuses points that nearly coincide.
        return None
    if inliers is None:
        return None
    used = np.zeros(len(points_m), bool)
    used[np.flatnonzero(is_seen)[np.ravel(inliers)]] = True
    poses = solve_pnp(points_m[used], rays[used])
    return (poses[0], used) if len(poses) else None


def _seen(
    points_m: Float[np.ndarray, "points 3"], rays: Float[np.ndarray, "points 2"]
) -> tuple[Float[np.ndarray, "seen 3"], Float[np.ndarray, "seen 2"], Bool[np.ndarray, " points"]]:
    """The points that are seen, as OpenCV wants them in memory, and which these are."""
    is_seen = np.isfinite(rays).all(axis=-1)
    return np.ascontiguousarray(points_m[is_seen]), np.ascontiguousarray(rays[is_seen]), is_seen


def _flattened(points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Points moved into the plane that is nearest to them."""
    centred_m = points_m - points_m.mean(axis=0)
    normal = np.linalg.svd(centred_m, full_matrices=False)[2][2]
    return points_m - (centred_m @ normal)[:, None] * normal


@dataclass(frozen=True)
class Located:
    """A camera's pose and its covariance.

    Attributes:
        T_cam_world: (4, 4), transform from world to camera, metres.
        covariance: (6, 6), covariance of a small turn about the camera's axes (rad) and of the translation (m).
        centre_covariance_m2: (3, 3), covariance of the camera's centre in the world, square metres.
        residual_px: (points,), distances of all points, outliers included, from their projections, pixels.
        used: (points,), False for outliers.
        noise_px: standard deviation of a point along each axis, as the residuals show it, pixels.
        lens_shift_m: how far away the camera is by a lens that explains the residuals far better, metres; 0 where
            they are noise.
    """

    T_cam_world: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    centre_covariance_m2: Float[np.ndarray, "3 3"]
    residual_px: Float[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]
    noise_px: float
    lens_shift_m: float


def locate_camera(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float = 1.0,
    *,
    name: str = "camera",
) -> Located:
    """Find the pose of a camera with a known lens, from points of known positions.

    Args:
        points_m: (points, 3), positions in the world, metres; at least four points, not on one line. All points may be
            in a plane.
        points_px: (points, 2), positions in the image, pixels.
        lens: the camera's lens; the pose in it is ignored.
        noise_px: a guess of the standard deviation of `points_px` along each axis, pixels, which counts as one point
            beside the residuals.
        name: name of the camera in error messages.

    Raises:
        InputError: there are too few points, the points are on one line, two poses fit equally well, or
            no pose fits.
        SettingsError: `noise_px` is not above 0.
    """
    check_positive("noise_px", noise_px)
    _check_points(points_m, points_px, name)
    fits = _likely_poses(points_m, points_px, lens, noise_px)
    typical_px = _typical_px(fits[0]) if fits else np.inf
    if typical_px > _MAX_MEDIAN_SIGMAS * noise_px:
        raise InputError(
            name,
            expected=f"a pose that most points fit to about {noise_px:g} px",
            found="none" if np.isinf(typical_px) else f"a median distance of {typical_px:.0f} px",
            remedy="check for mirrored axes, for points that are mixed up, and for the lens of another camera",
        )
    _check_unique(fits, name)
    fit = fits[0]
    # The gate depends on the fit and the fit on the gate. The number of rounds is limited in case they oscillate.
    for _ in range(10):
        distance_px, before = fit.distance_px, fit.used
        within = distance_px <= GATE * max(noise_px, spread_px(distance_px[before], 6))
        used = within if within.sum() >= MIN_POINTS else before
        fit = replace(fit, used=used, is_robust=False).solved()
        if (used == before).all():
            break
    try:
        covariance = _covariance(fit)
    except np.linalg.LinAlgError:
        expected, found = "points that determine the camera's pose", "points that leave it undetermined"
        raise InputError(name, expected=expected, found=found) from None
    T, opened = fit.state.T_cam_world[0], _with_open_lens(fit, lens)
    by_pose, shift_m = centre_by_pose(T[:3, :3], T[:3, 3]), 0.0
    if opened is not None:
        other = opened.state.T_cam_world[0]
        turn = Rotation.from_matrix(other[:3, :3] @ T[:3, :3].T).as_rotvec()
        step = np.concatenate([turn, other[:3, 3] - T[:3, 3]])
        covariance = _covariance(opened) + np.outer(step, step)
        shift_m = float(np.linalg.norm(by_pose @ step))
    learned_px = noise_px * np.sqrt(_variance(fit))
    centre_m2 = by_pose @ covariance @ by_pose.T
    return Located(T, covariance, centre_m2, fit.distance_px[0], fit.used[0], learned_px, shift_m)


def _squares(fit: Bundle) -> tuple[float, int]:
    """Sum of squared residuals in units of the stated σ, and degrees of freedom."""
    squares = (fit.distance_px[fit.used] / fit.problem.noise_px[0]) ** 2
    return float(squares.sum()), 2 * len(squares) - fit.problem.size


def _variance(fit: Bundle) -> float:
    """Variance of the residuals in units of the stated one, which counts as one point's two residuals."""
    total, freedom = _squares(fit)
    return (2 + total) / (2 + freedom)


def _covariance(fit: Bundle) -> Float[np.ndarray, "6 6"]:
    """Covariance of the pose, whose unknowns come after those of the lens."""
    covariance = covariance_from_information(fit.equations().information, _MAX_INFLATION)
    return covariance[-6:, -6:] * _variance(fit)


def _with_open_lens(fit: Bundle, lens: Camera) -> Bundle | None:
    """The fit by a lens of another focal length, axis and distortion; None where this is no certain gain."""
    total, freedom = _squares(fit)
    if freedom - len(_LENS_STD) < _LEAST_FREEDOM or lens.K[0, 1]:
        return None
    padded = replace(lens, dist=np.pad(lens.dist, (0, max(0, FISHEYE_COEFFICIENTS - len(lens.dist)))))
    ((model, vector),) = known_lenses(make_rig({"": padded})).values()
    free = np.arange(len(vector)) < len(_LENS_STD)
    scale = np.array([lens.K[0, 0], lens.K[1, 1], *np.full(2, lens.image_size_wh.max()), 1.0, 1.0])
    information = np.zeros((len(vector), len(vector)))
    information[free, free] = (_LENS_STD * scale) ** -2.0
    problem = replace(fit.problem, models=(model,), priors=((vector, information),), free_lens=(free,))
    opened = replace(fit, problem=problem, state=replace(fit.state, lenses=(vector,))).solved()
    left, left_freedom = _squares(opened)
    gain = (total - left) / len(_LENS_STD) / (left / left_freedom)
    return opened if gain > f_distribution.ppf(1 - _BY_CHANCE, len(_LENS_STD), left_freedom) else None


def _likely_poses(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
) -> list[Bundle]:
    """Local minima of the robust cost, the most likely pose first."""
    # A pixel at which the lens shows nothing starts no pose, and counts as an outlier.
    rays = undistort(lens, points_px)
    gate = _MAX_MEDIAN_SIGMAS * noise_px / float(np.sqrt(lens.K[0, 0] * lens.K[1, 1]))
    sampled = solve_pnp_ransac(points_m, rays, gate)
    near = np.ones(len(rays), bool) if sampled is None else sampled[1]
    # Points that are nearly in a plane may fit a second pose, which IPPE finds; four points may fit four.
    solvers: list[Solver] = ["sqpnp", "ippe"]
    if len(rays) == MIN_POINTS:
        solvers.append("ap3p")
    poses = [T for solver in solvers for T in solve_pnp(points_m[near], rays[near], solver)]
    states = [BundleState((np.zeros(0),), T[None], np.eye(4)[None], np.ones(1)) for T in poses]
    # The points are the corners of one target that stands still.
    free, seen_px = (np.ones(1, bool), np.zeros(1, bool)), points_px[None, None]
    fits = [
        Bundle.of_views((KnownLens(lens),), state, points_m, seen_px, free=free, noise_px=noise_px).solved()
        for state in states
    ]
    found: list[Bundle] = []
    for fit in sorted(fits, key=lambda fit: fit.cost):
        # The trace of a rotation by an angle is 1 + 2 cos(angle).
        traces = [np.sum((fit.state.T_cam_world * one.state.T_cam_world)[0, :3, :3]) for one in found]
        if all(trace <= 1 + 2 * np.cos(_SAME_RAD) for trace in traces) and np.isfinite(_typical_px(fit)):
            found.append(fit)
    return found


def _typical_px(fit: Bundle) -> float:
    """Median distance of the points from their projections."""
    return float(np.median(fit.distance_px))


def _check_points(
    points_m: Float[np.ndarray, "points 3"], points_px: Float[np.ndarray, "points 2"], name: str
) -> None:
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


def _check_unique(fits: list[Bundle], name: str) -> None:
    """Raise an error if another pose, far from the best one, is about as likely."""
    for other in fits[1:]:
        if other.cost - fits[0].cost < 2 * log(_ODDS):
            first, second = (np.linalg.inv(fit.state.T_cam_world[0])[:3, 3] for fit in (fits[0], other))
            raise InputError(
                name,
                expected="points that only one pose fits",
                found=f"two poses, {np.linalg.norm(first - second):.2g} m apart, that fit equally well",
                remedy="mark more points that are not in the plane of the others",
            )
