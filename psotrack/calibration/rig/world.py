"""The world of a rig: its unit, axes and origin, from a known length or from points and where they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.geometry import Rig
from psotrack.support import similarity

#: Points are on a line if their second extent is below this fraction of the first one.
_FLAT = 0.01
#: Smallest number of points that fix a world.
LEAST_POINTS = 3


@dataclass(frozen=True)
class Similarity:
    """A change of the world: x becomes scale * R x + t.

    Attributes:
        R: (3, 3), rotation.
        t_m: (3,), shift, metres.
        scale: factor of all lengths.
    """

    R: Float[np.ndarray, "3 3"]
    t_m: Float[np.ndarray, "3"]
    scale: float = 1.0

    def points(self, points_m: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*points 3"]:
        """Points in the new world."""
        return self.scale * points_m @ self.R.T + self.t_m

    def rig(self, rig: Rig) -> Rig:
        """The rig in the new world."""
        T = np.asarray(rig.cameras.T_cam_world).copy()
        R_cam = T[:, :3, :3] @ self.R.T
        T[:, :3, 3] = self.scale * T[:, :3, 3] - R_cam @ self.t_m
        T[:, :3, :3] = R_cam
        return Rig(rig.names, replace(rig.cameras, T_cam_world=T))

    def covariance_m2(
        self, covariance_m2: Float[np.ndarray, "*points 3 3"]
    ) -> Float[np.ndarray, "*points 3 3"]:
        """Covariances of positions in the new world."""
        return self.scale**2 * self.R @ covariance_m2 @ self.R.T


def world_of_camera(rig: Rig, index: int, factor: float = 1.0) -> Similarity:
    """The world whose axes and origin are a camera's, with another unit of length."""
    T = np.asarray(rig.cameras.T_cam_world)[index]
    return Similarity(T[:3, :3], factor * T[:3, 3], factor)


def align(
    found_m: Float[np.ndarray, "points 3"], given_m: Float[np.ndarray, "points 3"], *, with_scale: bool
) -> tuple[Similarity, Float[np.ndarray, " points"]]:
    """The change of the world that brings points nearest to where they are (see `support.similarity`).

    Args:
        found_m: (points, 3), points in the rig's world.
        given_m: (points, 3), where they are.
        with_scale: whether the unit of length is open too.

    Returns:
        the change; and (points,), distances that are left, metres.

    Raises:
        InputError: there are fewer than three points, or they are on one line.
    """
    if len(found_m) < LEAST_POINTS:
        raise InputError("world", expected="three or more points that the rig knows", found=f"{len(found_m)}")
    first, second = found_m - found_m.mean(axis=0), given_m - given_m.mean(axis=0)
    causes = (
        (second, "", ""),
        (
            first,
            ", as the rig knows them",
            "check the lenses and the sightings, which may not determine the rig",
        ),
    )
    for points_m, as_known, remedy in causes:
        extent = np.linalg.svd(points_m, compute_uv=False)
        if extent[1] < _FLAT * extent[0]:
            raise InputError(
                "world",
                expected="points that are not on one line",
                found=f"{len(found_m)} on a line{as_known}",
                remedy=remedy,
            )
    scale, R, shift_m = similarity(found_m, given_m, with_scale=with_scale)
    change = Similarity(R, shift_m, scale)
    return change, np.linalg.norm(change.points(found_m) - given_m, axis=-1)
