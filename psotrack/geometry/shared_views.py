"""What is in the images of cameras, and whether their views meet: two cameras that share no view locate nothing."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry.cameras import NEAR_M, Camera, project_visible, undistort

#: Depths at which places are looked for, metres; wide, because the unit of a rig may be wrong by a factor of 1000.
_NEAREST_M, _FARTHEST_M = 0.01, 1e5
#: Columns, rows and depths of the places before a camera: the few that nearly always suffice, and the many that find a
#: common view as narrow as a sixteenth of the images, too.
_GRIDS = ((7, 5, 40), (17, 13, 300))


def in_images(
    cameras: Camera, position_m: Float[np.ndarray, "*points 3"]
) -> Bool[np.ndarray, "*points cameras"]:
    """Which points are inside of the cameras' images: (..., cameras)."""
    pixels, depth = project_visible(cameras, position_m[..., None, :])
    inside = (pixels >= -0.5) & (pixels <= cameras.image_size_wh - 0.5)
    return np.asarray(inside.all(axis=-1) & (depth > NEAR_M))


def looking_depths_m(cameras: Camera) -> Float[np.ndarray, "cameras"]:
    """Distance from each camera, along its optical axis, of the point at which all cameras look, metres.

    The point is the one nearest to all optical axes. Parallel axes have none: the distances are a quarter to twice the
    largest spread of the cameras' centres; 0 for a single camera.

    Args:
        cameras: cameras with one leading axis.
    """
    axis, centre = cameras.T_cam_world[:, 2, :3], cameras.centre_world
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    focus = np.linalg.lstsq(across.sum(axis=0), (across @ centre[..., None]).sum(axis=0)[:, 0])[0]
    spread = np.linalg.norm(np.ptp(centre, axis=0))
    return np.clip(((focus - centre) * axis).sum(axis=-1), spread / 4, 2 * spread)


def views_meet(cameras: Camera) -> bool:
    """Whether there is a place, at any distance, that two cameras have in view.

    Args:
        cameras: cameras with one leading axis.
    """
    count = len(cameras.K)
    for columns, rows, depths in _GRIDS:
        depth_m = np.geomspace(_NEAREST_M, _FARTHEST_M, depths)
        places_m = [_places_before(cameras[index], columns, rows, depth_m) for index in range(count)]
        if any(in_images(cameras[[b]], places_m[a]).any() for a, b in permutations(range(count), 2)):
            return True
    return False


def _places_before(
    camera: Camera, columns: int, rows: int, depth_m: Float[np.ndarray, " depths"]
) -> Float[np.ndarray, "places 3"]:
    """Places that a camera has in view, on a grid of its pixels and at several depths, in the world."""
    width, height = np.asarray(camera.image_size_wh, np.float64)
    u, v = np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows))
    rays = undistort(camera, np.stack([u.ravel(), v.ravel()], axis=-1))
    rays = np.column_stack([rays, np.ones(len(rays))])[np.isfinite(rays).all(axis=-1)]
    R, t_m = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
    places_m: Float[np.ndarray, "places 3"] = ((rays[:, None] * depth_m[:, None]).reshape(-1, 3) - t_m) @ R
    return places_m
