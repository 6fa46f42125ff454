"""What the cameras see in one frame, as arrays, and what is known of drones before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import SettingsError
from psotrack.geometry import NEAR_M, Camera, projection_equations, undistort, viewpoints


@dataclass(frozen=True)
class Sight:
    """The detections of all cameras, padded. The last column is no detection, so that index -1 is none.

    Attributes:
        straight: cameras without K and lens, whose pixels are `x`.
        x: (cameras, padded, 2), normalised image coordinates with the lens undone.
        variance: (cameras, padded), of these, infinite for no detection. Pixels are taken to be square.
        normal, right: (cameras, padded, 3, 3) and (..., 3), the normal equations of each at a depth of 1 m.
        at: (cameras, viewpoints), 1 where a camera stands at a viewpoint.
    """

    straight: Camera
    x: Float[np.ndarray, "cameras padded 2"]
    variance: Float[np.ndarray, "cameras padded"]
    normal: Float[np.ndarray, "cameras padded 3 3"]
    right: Float[np.ndarray, "cameras padded 3"]
    at: Float[np.ndarray, "cameras viewpoints"]

    @property
    def T(self) -> Float[np.ndarray, "cameras 3 4"]:
        """World to camera."""
        return np.asarray(self.straight.T_cam_world)[:, :3]

    def depth(self, point: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*points cameras"]:
        """Depth of points in the cameras, `NEAR_M` at least."""
        T = self.T
        return np.maximum(point @ T[:, 2, :3].T + T[:, 2, 3], NEAR_M)

    def num_viewpoints(self, seen: Bool[np.ndarray, "*groups cameras"]) -> Int[np.ndarray, "*groups"]:
        """From how many viewpoints something is seen."""
        return (seen @ self.at > 0).sum(axis=-1)


def sight_of(
    cameras: Camera, points_px: list[Float[np.ndarray, "_ 2"]], noise_px: list[Float[np.ndarray, "_"]]
) -> Sight:
    """Arguments and errors are those of `match`; a point that is not finite is no detection."""
    counts = list(map(len, points_px))
    pixels = np.full((max(counts, default=0) + 1, len(counts), 2), np.nan)
    variance = np.full((len(counts), len(pixels)), np.inf)
    focal_px = np.sqrt(cameras.K[:, 0, 0] * cameras.K[:, 1, 1])
    for camera, count in enumerate(counts):
        pixels[:count, camera] = np.where(np.isfinite(points_px[camera]), points_px[camera], np.nan)
        variance[camera, :count] = (noise_px[camera] / focal_px[camera]) ** 2
    if not (variance > 0).all():
        raise SettingsError("noise_px", expected="numbers above 0", found="0, NaN, or below")
    straight = Camera(
        cameras.T_cam_world,
        np.broadcast_to(np.eye(3), cameras.K.shape),
        cameras.dist[:, :0],
        cameras.image_size_wh,
    )
    x = undistort(cameras, pixels)
    rows, right, there = projection_equations(straight, x)
    variance[~there.T] = np.inf
    rows, right = rows.swapaxes(0, 1), right.swapaxes(0, 1)
    weighted = rows.swapaxes(-1, -2) / variance[..., None, None]
    label = viewpoints(cameras)
    return Sight(
        straight=straight,
        x=np.nan_to_num(x.swapaxes(0, 1)),
        variance=variance,
        normal=weighted @ rows,
        right=(weighted @ right[..., None])[..., 0],
        at=(label[:, None] == np.unique(label)).astype(float),
    )


@dataclass(frozen=True)
class Priors:
    """What is known of drones before they are seen: those that are expected, and the room for all others.

    The room is the last, so that its index is -1.

    Attributes:
        normal: (priors, 3, 3), information, the inverse of the covariance.
        mean: (priors, 3).
        least: (priors,), viewpoints that a drone must be seen from.
    """

    normal: Float[np.ndarray, "priors 3 3"]
    mean: Float[np.ndarray, "priors 3"]
    least: Int[np.ndarray, "priors"]

    @property
    def known(self) -> int:
        """How many drones are expected."""
        return len(self.mean) - 1

    def equations(
        self, prior: Int[np.ndarray, "groups"]
    ) -> tuple[Float[np.ndarray, "groups 3 3"], Float[np.ndarray, "groups 3"]]:
        """Left and right side of their normal equations."""
        normal = self.normal[prior]
        return normal, (normal @ self.mean[prior][..., None])[..., 0]


def priors_of(
    bounds_m: Float[np.ndarray, "2 3"],
    expected_m: Float[np.ndarray, "known 3"],
    covariance_m2: Float[np.ndarray, "known 3 3"],
    min_views: int,
) -> Priors:
    """Arguments are those of `match`; two viewpoints are enough for what is expected."""
    # The room is so vague that it moves nothing, but no equations are singular.
    room = np.diag((bounds_m[1] - bounds_m[0]) ** -2.0)
    return Priors(
        np.concatenate([np.linalg.inv(covariance_m2), room[None]]),
        np.concatenate([expected_m, bounds_m.mean(axis=0)[None]]),
        np.append(np.full(len(expected_m), 2), min_views),
    )
