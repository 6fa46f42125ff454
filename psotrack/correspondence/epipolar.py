"""Epipolar lines: where one camera sees what another sees in a pixel, whatever its depth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.correspondence.sight import Sight
from psotrack.geometry import Camera, undistort


def epipolar_distance(
    first: Camera,
    second: Camera,
    first_px: Float[np.ndarray, "n 2"],
    second_px: Float[np.ndarray, "m 2"],
) -> Float[np.ndarray, "n m 2"]:
    """How far detections of two cameras are from each other's epipolar lines, with the lenses undone, in pixels.

    Args:
        first, second: single cameras.
        first_px, second_px: (n, 2) and (m, 2).

    Returns:
        (n, m, 2): of the second camera's detections from the lines of the first's, and the reverse; infinite or NaN
        where the cameras stand at one spot.
    """
    x = _homogeneous(undistort(first, first_px)), _homogeneous(undistort(second, second_px))
    E = _essential(np.stack([first.T_cam_world, second.T_cam_world])[:, :3])[0, 1]
    in_second, in_first = x[0] @ E.T, x[1] @ E
    product = np.abs(in_second @ x[1].T)
    # A line in pixels is one in normalised coordinates times the inverse of K.
    steep_second, steep_first = (
        np.linalg.norm((line @ np.linalg.inv(cam.K))[:, :2], axis=-1)
        for cam, line in ((second, in_second), (first, in_first))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([product / steep_second[:, None], product / steep_first], axis=-1)


def line_distances(sight: Sight) -> Float[np.ndarray, "cameras cameras padded padded"]:
    """Squared distance of any two detections from each other's epipolar lines, in standard deviations.

    It is Sampson's: χ² with one degree of freedom for two of one point. Infinite for no detection.
    """
    x = _homogeneous(sight.x)
    lines = x[:, None] @ _essential(sight.T).swapaxes(-1, -2)
    steepness = (lines[..., 0] ** 2 + lines[..., 1] ** 2)[..., None]
    there = np.isfinite(sight.variance)
    variance = np.where(there, sight.variance, 1.0)
    across = steepness * variance[:, None]
    across = across + steepness.swapaxes(0, 1).swapaxes(-1, -2) * variance[:, None, :, None]
    squared = (lines @ x.swapaxes(-1, -2)) ** 2
    both = there[:, None, :, None] & there[:, None]
    return np.divide(squared, across, where=both & (across > 0), out=np.full(squared.shape, np.inf))


def _essential(T: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "cameras cameras 3 3"]:
    """E[a, b]: E x is the line in b of the point x in a (Hartley and Zisserman, section 9.6)."""
    R, t = T[..., :3], T[..., 3]
    R_ba = R @ R[:, None].swapaxes(-1, -2)
    t_ba = t - (R_ba @ t[:, None, :, None])[..., 0]
    return np.cross(t_ba[..., None], R_ba, axisa=-2, axisb=-2, axisc=-2)


def _homogeneous(x: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points 3"]:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)
