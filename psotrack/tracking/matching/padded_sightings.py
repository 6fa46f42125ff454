"""Sightings of one frame as padded arrays, and prior knowledge of the drones' positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import (
    NEAR_M,
    Camera,
    in_images,
    projection_equations,
    undistort,
    undistortion_stretch,
    viewpoints,
)

#: Value of `Priors.min_viewpoints`: three viewpoints must see the drone, or two where the place is in view of no third.
BY_PLACE = 0


@dataclass(frozen=True)
class PaddedSightings:
    """Detections of all cameras, padded to one length. The last column is padding, so that index -1 is no detection.

    Attributes:
        cameras: the cameras.
        straight: the cameras with K = 1 and without lens distortion; `x` are their pixels.
        x: (cameras, padded, 2), normalised undistorted image coordinates.
        variance: (cameras, padded), variances of `x` along each axis; infinite for padding. Pixels are assumed square.
        normal, right: (cameras, padded, 3, 3) and (cameras, padded, 3), left and right sides of each detection's
            normal equations for a depth of 1 m.
        at: (cameras, viewpoints), 1 where a camera stands at a viewpoint, else 0.
    """

    cameras: Camera
    straight: Camera
    x: Float[np.ndarray, "cameras padded 2"]
    variance: Float[np.ndarray, "cameras padded"]
    normal: Float[np.ndarray, "cameras padded 3 3"]
    right: Float[np.ndarray, "cameras padded 3"]
    at: Float[np.ndarray, "cameras viewpoints"]

    @property
    def T(self) -> Float[np.ndarray, "cameras 3 4"]:
        """(cameras, 3, 4), transforms from world to camera."""
        return np.asarray(self.straight.T_cam_world)[:, :3]

    def depth(self, point: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*points cameras"]:
        """Depths of points in the cameras, at least `NEAR_M`, metres."""
        T = self.T
        return np.maximum(point @ T[:, 2, :3].T + T[:, 2, 3], NEAR_M)

    def num_viewpoints(self, seen: Bool[np.ndarray, "*groups cameras"]) -> Int[np.ndarray, "*groups"]:
        """Number of viewpoints from which each group is seen."""
        return (seen @ self.at > 0).sum(axis=-1)

    def required_viewpoints(
        self, point: Float[np.ndarray, "groups 3"], min_viewpoints: Int[np.ndarray, "groups"]
    ) -> Int[np.ndarray, "groups"]:
        """Numbers of viewpoints that must see points, with `BY_PLACE` replaced by the number for the place."""
        by_place = min_viewpoints == BY_PLACE
        if not by_place.any():
            return min_viewpoints
        num_in_view = self.num_viewpoints(in_images(self.cameras, point))
        return np.where(by_place, np.clip(num_in_view, 2, 3), min_viewpoints)


def pad_sightings(
    cameras: Camera,
    points_px: Float[np.ndarray, "cameras boxes 2"],
    noise_px: Float[np.ndarray, "cameras boxes"],
) -> PaddedSightings:
    """The detections of all cameras, with one column of padding at least. Arguments: see `match`."""
    detected = np.isfinite(points_px).all(axis=-1) & np.isfinite(noise_px)
    # Columns without a detection at the end cost time.
    count = int(np.flatnonzero(detected.any(axis=0)).max(initial=-1)) + 1
    pixels = np.full((count + 1, len(detected), 2), np.nan)
    pixels[:count] = np.where(detected[..., None], points_px, np.nan)[:, :count].swapaxes(0, 1)
    variance = np.full((len(detected), count + 1), np.inf)
    focal_px = np.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1])
    variance[:, :count] = np.where(detected, (noise_px / focal_px[:, None]) ** 2, np.inf)[:, :count]
    straight = replace(
        cameras, K=np.broadcast_to(np.eye(3), cameras.K.shape), dist=cameras.dist[:, :0], fisheye=None
    )
    x = undistort(cameras, pixels)
    if cameras.dist.shape[-1]:
        variance *= np.nan_to_num(undistortion_stretch(cameras, x), nan=1.0).T ** 2
    rows, right, there = projection_equations(straight, x)
    variance[~there.T] = np.inf
    rows, right = rows.swapaxes(0, 1), right.swapaxes(0, 1)
    weighted = rows.swapaxes(-1, -2) / variance[..., None, None]
    label = viewpoints(cameras)
    return PaddedSightings(
        cameras=cameras,
        straight=straight,
        x=np.nan_to_num(x.swapaxes(0, 1)),
        variance=variance,
        normal=weighted @ rows,
        right=(weighted @ right[..., None])[..., 0],
        at=(label[:, None] == np.unique(label)).astype(float),
    )


@dataclass(frozen=True)
class Priors:
    """Prior knowledge of the drones' positions: one prior per expected drone, and the room for a new drone.

    The room is the last prior, so that its index is -1.

    Attributes:
        normal: (priors, 3, 3), information matrices, the inverses of the covariances.
        mean: (priors, 3), expected positions in the world, metres.
        min_viewpoints: (priors,), smallest number of viewpoints that must see the drone, or `BY_PLACE`.
    """

    normal: Float[np.ndarray, "priors 3 3"]
    mean: Float[np.ndarray, "priors 3"]
    min_viewpoints: Int[np.ndarray, "priors"]

    def equations(
        self, prior: Int[np.ndarray, "groups"]
    ) -> tuple[Float[np.ndarray, "groups 3 3"], Float[np.ndarray, "groups 3"]]:
        """Left and right sides of the normal equations of these priors."""
        normal = self.normal[prior]
        return normal, (normal @ self.mean[prior][..., None])[..., 0]


def make_priors(
    bounds_m: Float[np.ndarray, "2 3"],
    expected_m: Float[np.ndarray, "known 3"],
    covariance_m2: Float[np.ndarray, "known 3 3"],
    min_views: int,
) -> Priors:
    """Priors of the expected drones and of the room. Arguments: see `match`; `min_views` may be `BY_PLACE`.

    Two viewpoints are enough for an expected drone.
    """
    # The room's prior is too weak to move a point, and keeps the normal equations from being singular.
    room = np.diag((bounds_m[1] - bounds_m[0]) ** -2.0)
    return Priors(
        np.concatenate([np.linalg.inv(covariance_m2), room[None]]),
        np.concatenate([expected_m, bounds_m.mean(axis=0)[None]]),
        np.append(np.full(len(expected_m), 2), min_views),
    )
