"""Pixels of known points in a camera, and derivatives of the pixels and of the camera's centre by its pose, float64."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, cross_matrices, to_pixels_with_jacobian


def reproject(
    points_m: Float[np.ndarray, "points 3"],
    R: Float[np.ndarray, "3 3"],
    t_m: Float[np.ndarray, "3"],
    lens: Camera,
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 3"], Float[np.ndarray, "points 2 3"]]:
    """Pixels of points, and their derivatives by a small turn about the camera's axes (rad) and by its translation.

    Returns:
        (points, 2), pixels; (points, 2, 3), derivatives by the turn; and (points, 2, 3), by the translation in metres.
    """
    turned = points_m @ R.T
    pixels, by_shift = to_pixels_with_jacobian(lens, turned + t_m)
    # A small turn w moves a point Y by w x Y = -[Y] w.
    return pixels, -by_shift @ cross_matrices(turned), by_shift


def centre_by_pose(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 6"]:
    """(3, 6), derivative of a camera's centre, -Rᵀ t, by a small turn about its axes and by its translation."""
    return np.hstack([-R.T @ cross_matrices(t_m), -R.T])
