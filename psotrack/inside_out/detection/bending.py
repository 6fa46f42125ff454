"""What a lens bends, made straight, and back; in pixels both."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, distort, undistort


def straight(
    points_px: Float[np.ndarray, "*points 2"], lens: Camera | None
) -> Float[np.ndarray, "*points 2"]:
    """Pixels of the same points if the lens did not distort; None is a lens that does not."""
    if lens is None:
        return points_px
    return undistort(lens, points_px) @ lens.K[:2, :2].T + lens.K[:2, 2]


def bent(points_px: Float[np.ndarray, "*points 2"], lens: Camera | None) -> Float[np.ndarray, "*points 2"]:
    """What `straight` made straight, as the lens shows it."""
    if lens is None:
        return points_px
    rays = (points_px - lens.K[:2, 2]) @ np.linalg.inv(lens.K[:2, :2]).T
    return np.stack(distort(lens, rays[..., 0], rays[..., 1]), axis=-1) @ lens.K[:2, :2].T + lens.K[:2, 2]
