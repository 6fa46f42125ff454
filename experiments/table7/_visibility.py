"""Markers of a map that a camera could see from its pose, by geometry alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import NEAR_M, Camera, to_pixels
from psotrack.inside_out import MarkerMap

#: Shortest visible side, pixels: 2 pixels for each of the 6 cells across a 4 x 4 marker with its border, because fewer
#: do not distinguish neighbouring cells.
MIN_SIDE_PX = 12.0


def visible_markers(
    marker_map: MarkerMap,
    lens: Camera,
    position_m: Float[np.ndarray, "frames 3"],
    orientation_wxyz: Float[np.ndarray, "frames 4"],
    *,
    min_side_px: float = MIN_SIDE_PX,
) -> Bool[np.ndarray, "frames markers"]:
    """Markers that are in front of the camera, face it, lie wholly in its image, and are large enough in the image.

    Objects in between, such as other drones or pillars, are not considered. Where the pose is unknown, no marker is
    visible.

    Args:
        marker_map: map of the room.
        lens: intrinsics; the pose in it is ignored.
        position_m: (frames, 3), the camera's centre, world, metres.
        orientation_wxyz: (frames, 4), camera to world.
        min_side_px: smallest length of the shortest side in the image, pixels.

    Returns:
        (frames, markers), whether each marker is visible, in the order of `marker_map.ids`.
    """
    found = np.zeros((len(position_m), len(marker_map)), bool)
    known = np.isfinite(position_m).all(axis=-1) & np.isfinite(orientation_wxyz).all(axis=-1)
    if not known.any():
        return found
    R_world_cam = Rotation.from_quat(orientation_wxyz[known], scalar_first=True).as_matrix()
    centre_m = position_m[known][:, None]
    corners_m = marker_map.all_corners_m
    corners_cam = np.einsum("fji,fmkj->fmki", R_world_cam, corners_m - centre_m[:, :, None])
    faces = ((centre_m - marker_map.centres_m) * marker_map.normals).sum(axis=-1) > 0
    before = (corners_cam[..., 2] > NEAR_M).all(axis=-1)
    corners_px = to_pixels(lens, corners_cam)
    # Pixel centres are at whole numbers: the image ends half a pixel beyond the last centre.
    inside = ((corners_px >= -0.5) & (corners_px <= lens.image_size_wh - 0.5)).all(axis=(-2, -1))
    sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=-2) - corners_px, axis=-1)
    found[known] = faces & before & inside & (sides_px.min(axis=-1) >= min_side_px)
    return found
