"""Search for poses that fit known points: initial poses from sets of four points are refined by least squares."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Literal

import cv2
import jax
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from psotrack.calibration.derivatives import pixel_slopes, reproject
from psotrack.errors import InputError
from psotrack.geometry import NEAR_M, Camera, project_visible, undistort

#: A pose has six unknowns and a point gives two equations; the fourth point selects one of P3P's four solutions.
MIN_POINTS = 4
#: Points are nearly in a plane if their smallest extent is below this share of the largest extent. Nearly planar points
#: often fit a second pose, which is searched too.
_NEARLY_FLAT = 0.1
#: Largest number of sets of four points for initial poses; with 40 % outliers 13 of 100 sets contain no outlier.
_MOST_SETS = 100
#: Largest number of initial poses that are refined.
_MOST_STARTS = 4
#: Distance in the image of a point that the lens does not show at all from its measured pixel, pixels.
_NO_IMAGE_PX = 1e4
#: Poses are the same if the camera's orientations differ by less than this, radians.
_SAME_RAD = np.deg2rad(2.0)


@dataclass(frozen=True)
class Pose:
    """A pose, from world to camera: x_cam = R X + t.

    Attributes:
        R: (3, 3), rotation from world to camera.
        t_m: (3,), translation, metres.
        cost: robust cost: minus the logarithm of the likelihood.
    """

    R: Float[np.ndarray, "3 3"]
    t_m: Float[np.ndarray, "3"]
    cost: float = np.inf

    def has_orientation_of(self, other: Pose) -> bool:
        """Whether the orientations of both poses are almost the same."""
        # The trace of a rotation by an angle is 1 + 2 cos(angle).
        return bool(np.sum(self.R * other.R) > 1 + 2 * np.cos(_SAME_RAD))


def find_likely_poses(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
    extent_m: Float[np.ndarray, "3"],
    name: str,
) -> list[Pose]:
    """Find poses that are local minima of the robust cost, at most `_MOST_STARTS`, the most likely pose first."""
    started = _distinct(initial_poses(points_m, points_px, lens, noise_px, extent_m))
    found = _distinct(
        refine_pose(points_m, points_px, start, lens, noise_px, loss="cauchy") for start in started
    )
    if not found:
        raise InputError(
            name,
            expected="points that a pose fits",
            found="no pose with most points in front of the camera",
        )
    return found


def _distinct(poses: Iterable[Pose]) -> list[Pose]:
    """Keep the poses of smallest cost, without poses that are nearly the same as a pose of smaller cost."""
    found: list[Pose] = []
    for pose in sorted(poses, key=lambda pose: pose.cost):
        if (
            len(found) < _MOST_STARTS
            and np.isfinite(pose.cost)
            and not any(map(pose.has_orientation_of, found))
        ):
            found.append(pose)
    return found


def initial_poses(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    lens: Camera,
    noise_px: float,
    extent_m: Float[np.ndarray, "3"],
) -> list[Pose]:
    """Compute poses from all points, and from many sets of four points, so that some sets contain no outlier."""
    normalised = undistort(lens, points_px)
    shown = np.isfinite(normalised).all(axis=-1)
    all_m, all_px = points_m, points_px
    # A point at a pixel where the lens shows nothing starts no pose, and counts as an outlier below.
    points_m, points_px, normalised = points_m[shown], points_px[shown], normalised[shown]
    count = len(points_m)
    if count < MIN_POINTS:
        return []
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
        # With more points, another set of four points gives a better initial pose.
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
    costs = _costs(all_m, all_px, T, lens, noise_px)
    return [Pose(R, t_m, cost) for (R, t_m), cost in zip(solved, costs.tolist(), strict=True)]


def _solved(
    points_m: Float[np.ndarray, "points 3"], normalised: Float[np.ndarray, "points 2"], method: int
) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(points_m, normalised, np.eye(3), None, flags=method)
    except cv2.error:
        # OpenCV fails for degenerate sets, such as four points on a line.
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
    lenses = jax.tree.map(lambda leaf: np.broadcast_to(leaf, shape + np.shape(leaf)), lens)
    pixels, depth = project_visible(replace(lenses, T_cam_world=T_cam_world[:, None]), points_m)
    off = np.nan_to_num(pixels - points_px, nan=_NO_IMAGE_PX) / noise_px
    loss = 0.5 * np.log1p(off**2).sum(axis=(-2, -1))
    return np.where(np.median(depth, axis=-1) > NEAR_M, loss, np.inf)


def refine_pose(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    start: Pose,
    lens: Camera,
    noise_px: float,
    *,
    loss: Literal["linear", "cauchy"],
) -> Pose:
    """Minimise the loss of the reprojection error, starting from an initial pose."""
    turned = np.ascontiguousarray(points_m @ start.R.T)

    def off(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, " equations"]:
        return ((pixel_slopes(turned, x[:3], x[3:], lens)[0] - points_px) / noise_px).ravel()

    def slopes(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "equations 6"]:
        return pixel_slopes(turned, x[:3], x[3:], lens)[1].reshape(-1, 6) / noise_px

    result = least_squares(off, np.concatenate([np.zeros(3), start.t_m]), slopes, loss=loss, x_scale="jac")
    R = np.asarray(cv2.Rodrigues(result.x[:3])[0]) @ start.R
    T = np.eye(4)[None]
    T[0, :3] = np.column_stack([R, result.x[3:]])
    return Pose(R, result.x[3:], float(_costs(points_m, points_px, T, lens, noise_px)[0]))


def distances_px(
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points 2"],
    pose: Pose,
    lens: Camera,
) -> Float[np.ndarray, " points"]:
    """Distances of points from their projections, pixels; infinite for points behind the camera."""
    distance = np.linalg.norm(reproject(points_m, pose.R, pose.t_m, lens)[0] - points_px, axis=-1)
    return np.where(points_m @ pose.R[2] + pose.t_m[2] > NEAR_M, distance, np.inf)
