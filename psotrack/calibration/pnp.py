"""The perspective-n-point problem: poses of a camera from known points and where they are seen, by OpenCV.

All functions take rays, the directions x / z, y / z in which points are seen without distortion
(`psotrack.geometry.undistort`), so every lens of ours is served. A ray is NaN where a point is not seen; such a point
does not count. Poses are T_cam_world, (4, 4): x_cam = R x + t. No function uses or changes OpenCV's random numbers.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry import NEAR_M

#: Solvers in closed form: SQPnP (Terzakis & Lourakis, ECCV 2020) of any points; IPPE (Collins & Bartoli, IJCV 2014) of
#: points in a plane, both poses; AP3P (Ke & Roumeliotis, CVPR 2017) of four points, with up to four poses.
Solver = Literal["sqpnp", "ippe", "ap3p"]
_FLAGS = {"sqpnp": cv2.SOLVEPNP_SQPNP, "ippe": cv2.SOLVEPNP_IPPE, "ap3p": cv2.SOLVEPNP_AP3P}
#: A pose has six unknowns and a point gives two equations; the fourth point selects one of P3P's four solutions.
MIN_POINTS = 4


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
    poses = np.array([_pose(turn, shift) for turn, shift in zip(turns, shifts, strict=True)])
    poses = poses.reshape(-1, 4, 4)
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


def _pose(turn: np.ndarray, shift: np.ndarray) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T
