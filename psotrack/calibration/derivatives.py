"""Pixels of known points in a camera, and derivatives of the pixels and of the camera's centre by its pose, float64."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, cross_matrices


def reproject(
    points_m: Float[np.ndarray, "points 3"],
    R: Float[np.ndarray, "3 3"],
    t_m: Float[np.ndarray, "3"],
    lens: Camera,
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 3"], Float[np.ndarray, "points 2 3"]]:
    """Pixels of points, and their derivatives by a small turn about the camera's axes (rad) and by its translation.

    The derivatives are OpenCV's for normalised coordinates, multiplied by K, so that they are valid for skew too.

    Returns:
        (points, 2), pixels; (points, 2, 3), derivatives by the turn; and (points, 2, 3), by the translation in metres.
    """
    turned = np.ascontiguousarray(points_m @ R.T)
    pixels, slopes = pixel_slopes(turned, np.zeros(3), t_m, lens)
    return pixels, slopes[..., :3], slopes[..., 3:6]


def pixel_slopes(
    points_m: Float[np.ndarray, "points 3"],
    turn: Float[np.ndarray, "3"],
    t_m: Float[np.ndarray, "3"],
    lens: Camera,
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 unknowns"]]:
    """Pixels of points, and their derivatives by OpenCV's unknowns: Rodrigues vector, translation and intrinsics."""
    K, dist = np.asarray(lens.K), np.asarray(lens.dist)
    bent, by = cv2.projectPoints(points_m[:, None], turn, t_m, np.eye(3), dist if dist.size else None)
    pixels = np.asarray(bent).reshape(-1, 2) @ K[:2, :2].T + K[:2, 2]
    return pixels, K[:2, :2] @ np.asarray(by).reshape(-1, 2, by.shape[-1])


def centre_by_pose(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 6"]:
    """(3, 6), derivative of a camera's centre, -Rᵀ t, by a small turn about its axes and by its translation."""
    return np.hstack([-R.T @ cross_matrices(t_m), -R.T])
