"""Pixels with the distortion of a lens removed, and pixels with the distortion applied."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, distort, undistort


def undistort_pixels(
    points_px: Float[np.ndarray, "*points 2"], lens: Camera | None
) -> Float[np.ndarray, "*points 2"]:
    """Pixels at which the same points would appear through a lens without distortion.

    Args:
        points_px: (*points, 2), pixels in the image of the lens.
        lens: intrinsics and distortion; None for a lens without distortion, which returns the points unchanged.

    Returns:
        (*points, 2), pixels; NaN where the lens model shows nothing.
    """
    if lens is None:
        return points_px
    return undistort(lens, points_px) @ lens.K[:2, :2].T + lens.K[:2, 2]


def distort_pixels(
    points_px: Float[np.ndarray, "*points 2"], lens: Camera | None
) -> Float[np.ndarray, "*points 2"]:
    """Inverse of `undistort_pixels`: pixels at which the lens shows undistorted points."""
    if lens is None:
        return points_px
    rays = (points_px - lens.K[:2, 2]) @ np.linalg.inv(lens.K[:2, :2]).T
    return np.stack(distort(lens, rays[..., 0], rays[..., 1]), axis=-1) @ lens.K[:2, :2].T + lens.K[:2, 2]
