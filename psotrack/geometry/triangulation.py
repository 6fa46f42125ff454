"""Triangulation: points in space from the pixels of several cameras, in float64 (paper, equations 1-6).

Each camera that sees a point adds two linear equations in the point's three coordinates. The overdetermined system is
solved by least squares. Pixels are undistorted first, so that the equations are linear.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry.cameras import Camera, undistort
from psotrack.geometry.lenses import undistortion_stretch

#: Largest condition number of the normal equations; beyond this number the rays count as parallel.
MAX_CONDITION = 1e12
#: Cameras that are nearer to each other are one viewpoint, metres.
_NEAREST_M = 0.3


def triangulate_linearly(
    cameras: Camera,
    points_px: Float[np.ndarray, "*points cameras 2"],
    weights: Float[np.ndarray, "*points cameras"] | None = None,
) -> Float[np.ndarray, "*points 3"]:
    """World points from pixels, by the normal equations of (3)-(6) in normalised image coordinates.

    One wrong view spoils a point: `triangulate` leaves wrong views out.

    Args:
        cameras: cameras with one leading axis.
        points_px: (..., cameras, 2), pixels; NaN if a camera does not see the point.
        weights: (..., cameras), weight of each camera's two equations; None: 1.

    Returns:
        (..., 3), positions in the world, metres; NaN if fewer than two cameras see the point, or if all rays are
        parallel.
    """
    rows, right, seen = projection_equations(cameras, points_px)
    scale = seen * np.sqrt(1.0 if weights is None else weights)
    return np.where(seen.sum(axis=-1, keepdims=True) >= 2, solve_equations(rows, right, scale), np.nan)


def projection_equations(
    cameras: Camera, points_px: Float[np.ndarray, "*points cameras 2"]
) -> tuple[
    Float[np.ndarray, "*points cameras 2 3"],
    Float[np.ndarray, "*points cameras 2"],
    Bool[np.ndarray, "*points cameras"],
]:
    """Linear equations L X = B of the paper (3) in normalised coordinates: (x r3 - r1) X = t1 - x t3, likewise for y.

    Args:
        cameras: cameras with one leading axis.
        points_px: (..., cameras, 2), pixels; NaN if a camera does not see the point. A pixel where the camera's lens
            shows no point counts as not seen.

    Returns:
        L (..., cameras, 2, 3), B (..., cameras, 2), and a mask (..., cameras) of the cameras that see the points. The
        rows of the other cameras are finite but have no meaning. A fisheye's equations are divided by the stretch of
        its undistorted image, so that their errors are in proportion to errors of the pixels.
    """
    normalised = undistort(cameras, points_px)
    seen = np.isfinite(normalised).all(axis=-1)
    normalised = np.where(seen[..., None], normalised, 0.0)
    T = np.asarray(cameras.T_cam_world)
    rows = normalised[..., :, None] * T[:, 2, None, :3] - T[:, :2, :3]
    right = T[:, :2, 3] - normalised * T[:, 2, None, 3]
    if cameras.fisheye is not None:
        # Far from a fisheye's axis a pixel is a large step of the normalised coordinates.
        weight = np.where(cameras.fisheye, 1 / undistortion_stretch(cameras, normalised), 1.0)[..., None]
        rows, right = weight[..., None] * rows, weight * right
    return rows, right, seen


def solve_equations(
    rows: Float[np.ndarray, "*points cameras 2 3"],
    right: Float[np.ndarray, "*points cameras 2"],
    scale: Float[np.ndarray, "*points cameras"],
) -> Float[np.ndarray, "*points 3"]:
    """Least-squares solutions of linear equations of points.

    Args:
        rows, right: equations from `projection_equations`.
        scale: (..., cameras), factor of each camera's two equations; 0 for views that are not used.

    Returns:
        (..., 3), positions, metres; NaN if the used views do not determine a point.
    """
    flat = (*scale.shape[:-1], 2 * scale.shape[-1])
    A = (rows * scale[..., None, None]).reshape(*flat, 3)
    normal = A.swapaxes(-1, -2) @ A
    right_side = np.matvec(A.swapaxes(-1, -2), (right * scale[..., None]).reshape(flat))
    values = np.linalg.eigvalsh(normal)
    solvable = values[..., -1] < MAX_CONDITION * values[..., 0]
    point = np.linalg.solve(np.where(solvable[..., None, None], normal, np.eye(3)), right_side[..., None])
    return np.where(solvable[..., None], point[..., 0], np.nan)


def viewpoints(cameras: Camera) -> Int[np.ndarray, "cameras"]:
    """Viewpoint number of each camera, (cameras,): cameras nearer to each other than 0.3 m share a number.

    Two cameras beside each other locate a drone hardly better than one camera.
    """
    centre = cameras.centre_world
    label = np.arange(len(centre))
    apart_m = np.linalg.norm(centre[:, None] - centre, axis=-1)
    for a, b in np.argwhere(np.triu(apart_m < _NEAREST_M, 1)).tolist():
        label[label == label[b]] = label[a]
    return label
