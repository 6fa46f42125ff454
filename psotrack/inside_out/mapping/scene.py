"""Markers of a room and views of these markers, with residuals of the corners and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration import reproject
from psotrack.geometry import NEAR_M
from psotrack.inside_out.mapping.sightings import SQUARE, MarkerSightings


@dataclass(frozen=True)
class MappedScene:
    """Poses of views and markers.

    Attributes:
        R_cam_world: (views, 3, 3), world to camera.
        t_m: (views, 3), translation from world to camera, metres.
        ids: (markers,), increasing.
        R_world_marker: (markers, 3, 3), from a marker's own axes (see `sightings.SQUARE`) to the world's.
        centre_m: (markers, 3), world, metres.
        side_m: (markers,), sides, metres.
        inset_px: (videos,), distance by which the sides of squares are found too far inside, pixels.
        motion: (views, 6), motion during a frame of a rolling shutter: turn rate about the camera's axes (rad/s) and
            velocity of the world's points along these axes (m/s); None is no motion.
    """

    R_cam_world: Float[np.ndarray, "views 3 3"]
    t_m: Float[np.ndarray, "views 3"]
    ids: Int[np.ndarray, " markers"]
    R_world_marker: Float[np.ndarray, "markers 3 3"]
    centre_m: Float[np.ndarray, "markers 3"]
    side_m: Float[np.ndarray, " markers"]
    inset_px: Float[np.ndarray, " videos"]
    motion: Float[np.ndarray, "views 6"] | None = None

    def rows(self, sightings: MarkerSightings) -> Int[np.ndarray, " sightings"]:
        """(sightings,), index of each sighting's marker."""
        return np.searchsorted(self.ids, sightings.marker)

    @property
    def corners_m(self) -> Float[np.ndarray, "markers 4 3"]:
        """(markers, 4, 3), corners, world, metres."""
        return self.centre_m[:, None] + self.arms_m

    @property
    def arms_m(self) -> Float[np.ndarray, "markers 4 3"]:
        """(markers, 4, 3), vectors from the centres to the corners, along the world's axes, metres."""
        return (self.side_m[:, None, None] * SQUARE) @ self.R_world_marker.swapaxes(-1, -2)


def residuals_px(sightings: MarkerSightings, scene: MappedScene) -> Float[np.ndarray, "sightings 4"]:
    """Distances in the image between corners and their projections, after the inset; infinite behind the camera."""
    return np.linalg.norm(linearised(sightings, scene).off, axis=-1)


def outward(sightings: MarkerSightings) -> Float[np.ndarray, "sightings 4 2"]:
    """Shift of each corner in the image, along the bisector, when each side of the square moves outwards by 1 px."""
    ahead = _unit(np.roll(sightings.corners_px, -1, axis=1) - sightings.corners_px)
    behind = np.roll(-ahead, 1, axis=1)
    # Two sides with an angle a between them give 1 / sin(a / 2). Markers seen too obliquely are not recognised.
    sine = np.maximum(np.linalg.norm(ahead - behind, axis=-1, keepdims=True) / 2, 0.1)
    return -_unit(ahead + behind) / sine


def _unit(vectors: Float[np.ndarray, "*vectors 2"]) -> Float[np.ndarray, "*vectors 2"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class LinearisedScene:
    """Residuals of corners, and derivatives of the projected corners, pixels.

    Attributes:
        off: (sightings, 4, 2), corner less its projection; infinite behind the camera.
        by_view: (sightings, 4, 2, 6), by a small turn about the camera's axes (rad) and by its translation (m); where
            a shutter rolls (sightings, 4, 2, 12), also by the motion.
        by_rest: (sightings, 4, 2, 8), by the marker's centre (m), a small turn about the world's axes (rad), the
            logarithm of its side, and by the video's inset.
    """

    off: Float[np.ndarray, "sightings 4 2"]
    by_view: Float[np.ndarray, "sightings 4 2 unknowns"]
    by_rest: Float[np.ndarray, "sightings 4 2 8"]


def linearised(sightings: MarkerSightings, scene: MappedScene) -> LinearisedScene:
    """Residuals and derivatives of all sightings; the scene has all their markers and views."""
    row, view = scene.rows(sightings), sightings.view
    video = sightings.lens[view]
    R = scene.R_cam_world[view]
    arm = scene.arms_m[row]
    turned = (scene.centre_m[row][:, None] + arm) @ R.swapaxes(-1, -2)
    points_cam = turned + scene.t_m[view][:, None]
    time_s = sightings.row_times_s[..., None]
    if sightings.rolls and scene.motion is not None:
        # The pose at a row: the turn and the shift since the middle row follow the pose of the middle row.
        turn, shift = (time_s * part[:, None] for part in np.split(scene.motion[view], 2, axis=-1))
        R_row = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape, 3)
        points_cam = (R_row @ points_cam[..., None])[..., 0] + shift
    off, by_shift = np.empty((len(row), 4, 2)), np.empty((len(row), 4, 2, 3))
    for index, lens in enumerate(sightings.lenses):
        of_lens = np.flatnonzero(video == index)
        if not len(of_lens):
            continue
        # A translation of the camera moves points in its axes by the same vector.
        pixels, _, slopes = reproject(points_cam[of_lens].reshape(-1, 3), np.eye(3), np.zeros(3), lens)
        off[of_lens] = sightings.corners_px[of_lens] - pixels.reshape(-1, 4, 2)
        by_shift[of_lens] = slopes.reshape(-1, 4, 2, 3)
    off[points_cam[..., 2] <= NEAR_M] = np.inf
    # A turn by w moves a point q by w x q, so the derivative is q x slope; a larger side moves q along the arm.
    by_turn = np.cross(turned[:, :, None], by_shift)
    by_view = np.concatenate([by_turn, by_shift], axis=-1)
    if sightings.rolls:
        by_rate = np.cross(points_cam[:, :, None], by_shift)
        by_motion = time_s[..., None] * np.concatenate([by_rate, by_shift], axis=-1)
        by_view = np.concatenate([by_view, by_motion], axis=-1)
    by_point, arm = by_shift @ R[:, None], arm[:, :, None]
    inward = -outward(sightings)
    off = off - scene.inset_px[video][:, None, None] * inward
    rest = [
        by_point,
        np.cross(arm, by_point),
        (by_point * arm).sum(axis=-1, keepdims=True),
        inward[..., None],
    ]
    return LinearisedScene(off, by_view, np.concatenate(rest, axis=-1))
