"""Drones that one camera alone sees: this camera's detection corrects the track across the line of sight.

One camera does not show how far a drone is, so the drone is not found and its track goes on coasting. But the track of
a drone that turns while it is hidden from all other cameras would err by metres without the detection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.geometry import NEAR_M, Camera, project_with_jacobian
from psotrack.tracking.matching import Expected, Sightings

#: A detection is taken for a drone's if this is at least as many times as probable as a detection of anything else at
#: the same place.
LEAST_ODDS = 1000.0


@dataclass(frozen=True)
class SingleViews:
    """Detections of drones that too few cameras see for a position; one row for each drone and camera.

    Attributes:
        drone: (views,), index of the expected drone.
        jacobian: (views, 2, 3), derivative of the drone's pixel by the position, pixels per metre.
        off_px: (views, 2), detection minus expected pixel.
        noise_px: (views,), standard deviation of the detection along each axis.
    """

    drone: np.ndarray
    jacobian: Float[np.ndarray, "views 2 3"]
    off_px: Float[np.ndarray, "views 2"]
    noise_px: Float[np.ndarray, "views"]


def find_single_views(
    cameras: Camera,
    free: Sightings,
    density_px2: Float[np.ndarray, "cameras"],
    expected: Expected,
) -> SingleViews:
    """The most probable free detection of each drone in each camera, if it is probable enough (`LEAST_ODDS`).

    A detection is of one drone at most: of the drone for which it is most probable.

    Args:
        cameras: cameras with one leading axis.
        free: detections of the frame that are of no other drone.
        density_px2: (cameras,), mean number of detections per frame and square pixel.
        expected: where the drones are expected.
    """
    pixels, depth, jacobian = project_with_jacobian(cameras, expected.position_m[:, None])
    noise_px = free.noise_px * np.sqrt(np.maximum(expected.dispersion, 1.0))[:, None, None]
    off_px = free.centre_px - pixels[:, :, None]
    spread = jacobian @ expected.covariance_m2[:, None] @ jacobian.swapaxes(-1, -2)
    spread = spread[:, :, None] + noise_px[..., None, None] ** 2 * np.eye(2)
    usable = np.isfinite(off_px).all(axis=-1) & (depth >= NEAR_M)[..., None]
    usable &= np.isfinite(spread).all(axis=(-1, -2))
    spread = np.where(usable[..., None, None], spread, np.eye(2))
    off_px = np.where(usable[..., None], off_px, 0.0)
    distance2 = (off_px * np.linalg.solve(spread, off_px[..., None])[..., 0]).sum(axis=-1)
    density = np.exp(-distance2 / 2) / (2 * np.pi * np.sqrt(np.linalg.det(spread)))
    odds = np.where(usable, density / density_px2[:, None], 0.0)
    # (drones, cameras, boxes): the best detection of the drone, which has no better drone.
    best = odds >= np.maximum(odds.max(axis=-1, keepdims=True, initial=0.0), LEAST_ODDS)
    best &= odds >= odds.max(axis=0, initial=0.0)
    drone, camera, box = np.nonzero(best)
    return SingleViews(
        drone, jacobian[drone, camera], off_px[drone, camera, box], noise_px[drone, camera, box]
    )
