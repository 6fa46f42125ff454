"""Epipolar lines: a pixel of one camera is a ray in space, and another camera sees this ray as a line."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, undistort
from psotrack.tracking.matching.padded_sightings import PaddedSightings


def epipolar_distance(
    first: Camera,
    second: Camera,
    first_px: Float[np.ndarray, "n 2"],
    second_px: Float[np.ndarray, "m 2"],
) -> Float[np.ndarray, "n m 2"]:
    """Distances of two cameras' detections from each other's epipolar lines, in undistorted pixels.

    Args:
        first, second: single cameras.
        first_px, second_px: (n, 2) and (m, 2), detections in the first and in the second camera, pixels.

    Returns:
        (n, m, 2), pixels. [..., 0]: distance of the second camera's detection from the epipolar line of the first
        camera's detection. [..., 1]: the reverse. Infinite or NaN if both cameras stand at the same place.
    """
    x = _homogeneous(undistort(first, first_px)), _homogeneous(undistort(second, second_px))
    E = _essential(np.stack([first.T_cam_world, second.T_cam_world])[:, :3])[0, 1]
    in_second, in_first = x[0] @ E.T, x[1] @ E
    product = np.abs(in_second @ x[1].T)
    # A line in pixels is the line in normalised coordinates times the inverse of K.
    norm_second, norm_first = (
        np.linalg.norm((line @ np.linalg.inv(cam.K))[:, :2], axis=-1)
        for cam, line in ((second, in_second), (first, in_first))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([product / norm_second[:, None], product / norm_first], axis=-1)


def squared_epipolar_distances(padded: PaddedSightings) -> Float[np.ndarray, "cameras cameras padded padded"]:
    """Squared Sampson distance of every pair of detections from their epipolar lines, in squared standard deviations.

    For two detections of one point the distance has a χ² distribution with one degree of freedom. Padding has an
    infinite distance.
    """
    x = _homogeneous(padded.x)
    lines = x[:, None] @ _essential(padded.T).swapaxes(-1, -2)
    squared_norm = (lines[..., 0] ** 2 + lines[..., 1] ** 2)[..., None]
    detected = np.isfinite(padded.variance)
    variance = np.where(detected, padded.variance, 1.0)
    across = squared_norm * variance[:, None]
    across = across + squared_norm.swapaxes(0, 1).swapaxes(-1, -2) * variance[:, None, :, None]
    squared = (lines @ x.swapaxes(-1, -2)) ** 2
    both = detected[:, None, :, None] & detected[:, None]
    return np.divide(squared, across, where=both & (across > 0), out=np.full(squared.shape, np.inf))


def _essential(T: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "cameras cameras 3 3"]:
    """Essential matrices: E[a, b] x is the epipolar line in camera b of the point x in camera a.

    Hartley and Zisserman, Multiple View Geometry, section 9.6.
    """
    R, t = T[..., :3], T[..., 3]
    R_ba = R @ R[:, None].swapaxes(-1, -2)
    t_ba = t - (R_ba @ t[:, None, :, None])[..., 0]
    return np.cross(t_ba[..., None], R_ba, axisa=-2, axisb=-2, axisc=-2)


def _homogeneous(x: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 3"]:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)
