"""Scale of images: how large small objects appear."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry.cameras import NEAR_M, Camera
from psotrack.geometry.image_fit import to_pixels_with_jacobian


def sizes_m(
    cameras: Camera, points_cam: Float[np.ndarray, "*#points 3"], size_px: Float[np.ndarray, "*#points 2"]
) -> Float[np.ndarray, "*#points 2"]:
    """Widths and heights in metres of small objects at points, from the sides of their boxes.

    In a pinhole camera an object is flat and parallel to the image: depth / focal length. In a fisheye, where the
    optical axis may be far away, the object is a sphere.

    Args:
        cameras: cameras with leading axes (*batch).
        points_cam: (..., 3), camera coordinates, metres, broadcast against the cameras.
        size_px: (..., 2), widths and heights of boxes, pixels.
    """
    flat = size_px * points_cam[..., 2:] / _focal_px(cameras)
    if cameras.fisheye is None:
        return np.asarray(flat)
    return np.where(np.asarray(cameras.fisheye)[..., None], size_px / _of_spheres(cameras, points_cam), flat)


def sizes_px(
    cameras: Camera, points_cam: Float[np.ndarray, "*#points 3"], size_m: Float[np.ndarray, "*#points 2"]
) -> Float[np.ndarray, "*#points 2"]:
    """Inverse of `sizes_m`: sides of the boxes of objects with given widths and heights."""
    flat = size_m * _focal_px(cameras) / np.maximum(points_cam[..., 2:], NEAR_M)
    if cameras.fisheye is None:
        return np.asarray(flat)
    return np.where(np.asarray(cameras.fisheye)[..., None], size_m * _of_spheres(cameras, points_cam), flat)


def _focal_px(cameras: Camera) -> Float[np.ndarray, "*cameras 2"]:
    return np.stack([cameras.K[..., 0, 0], cameras.K[..., 1, 1]], axis=-1)


def _of_spheres(
    cameras: Camera, points_cam: Float[np.ndarray, "*#points 3"]
) -> Float[np.ndarray, "*#points 2"]:
    """Width and height in pixels, per metre of its diameter, of a small sphere at a point."""
    _, jacobian = to_pixels_with_jacobian(cameras, points_cam)
    return np.linalg.norm(jacobian, axis=-1)
