"""A map from a table of centres alone: how each marker is turned, and how large the marker is, from a video.

Frames that show at least four centres give poses of the camera (AP3P in a random sample consensus). In these poses the
four corners of each marker are seen from several sides; the rotation and the side that fit best make the marker's
corners, about the centre in the table (least squares with Cauchy's loss). Poses by corners then are better than poses
by centres, and the rotations are fitted once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import NEAR_M, Camera, undistort
from psotrack.inside_out.mapping.sightings import SQUARE, FrameMarkers, collect_sightings, square_poses
from psotrack.inside_out.marker_map import MarkerCentres, MarkerMap
from psotrack.inside_out.pose import PoseSettings, estimate_pose

#: Smallest number of centres for a pose. Three centres have up to four poses.
_LEAST_CENTRES = 4
#: Largest angle between a centre and its projection, radians: 4 cm at 4 m, for centres that were measured by hand.
_NEAR_RAD = 0.01
#: Smallest and largest number of frames from which a marker is turned.
_LEAST_FRAMES, _MOST_FRAMES = 3, 40
#: Scale of Cauchy's loss, radians: about a pixel.
_LOSS_RAD = 1e-3
#: Largest median distance of corners from their projections, radians, of a marker that is used.
_FITTING_RAD = 0.01

#: Position of the camera in the world, metres, and rotation from camera to world.
_Pose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]


@dataclass(frozen=True)
class MapFromCentres:
    """A map that a video completes.

    Attributes:
        marker_map: markers whose corners were found.
        left_out: ids of markers that are seen, but in too few frames with a pose, or that do not fit.
    """

    marker_map: MarkerMap
    left_out: tuple[int, ...]


def complete_map(
    frames: Sequence[DetectedMarkers],
    centres: MarkerCentres,
    lens: Camera,
    *,
    side_m: float | None = None,
    name: str = "video",
) -> MapFromCentres:
    """Find the corners of markers whose centres are known, from the frames of a video.

    Args:
        frames: detected markers of each frame.
        centres: centres of the markers.
        lens: intrinsics of the camera.
        side_m: side of all markers, metres; None estimates each marker's side.
        name: name of the video, for messages.

    Raises:
        InputError: too few frames show four markers of the table, or no marker fits.
    """
    seen = [FrameMarkers(0, 0.0, one.ids, np.asarray(one.corners_px, np.float64)) for one in frames]
    sightings = collect_sightings(seen, [lens], name)
    rays = undistort(lens, sightings.corners_px)
    views = [np.flatnonzero(sightings.view == view) for view in range(sightings.num_views)]
    middles = [_middles(rays[rows]) for rows in views]
    poses = [
        _pose_by_centres(np.array([centres.centres_m[int(each)] for each in sightings.marker[rows]]), middle)
        for rows, middle in zip(views, middles, strict=True)
    ]
    if sum(pose is not None for pose in poses) < _LEAST_FRAMES:
        raise InputError(
            name,
            expected=f"{_LEAST_FRAMES} frames that show {_LEAST_CENTRES} markers where the table has their centres",
            found=f"{sum(pose is not None for pose in poses)}",
            remedy="a table of corners needs fewer markers in sight",
        )
    R_cam_marker, t_unit = square_poses(sightings, 1.0)
    marker_map: MarkerMap | None = None
    for _ in range(2):
        if marker_map is not None:
            poses = [
                _pose_by_corners(sightings.marker[rows], sightings.corners_px[rows], marker_map, lens) or pose
                for rows, pose in zip(views, poses, strict=True)
            ]
        corners = {}
        for marker in sightings.ids:
            rows = np.flatnonzero(sightings.marker == marker)
            rows = np.array([row for row in rows if poses[sightings.view[row]] is not None], int)
            rows = rows[np.isfinite(rays[rows]).all(axis=(1, 2)) & np.isfinite(t_unit[rows, 0, 0])]
            found = _corners(
                centres.centres_m[marker],
                [poses[view] for view in sightings.view[rows]],
                rays[rows],
                R_cam_marker[rows],
                np.linalg.norm(t_unit[rows], axis=-1),
                side_m,
            )
            if found is not None:
                corners[marker] = found
        if not corners:
            raise InputError(
                name,
                expected="markers where the table has their centres",
                found="none that fits",
                remedy="check --markers",
            )
        marker_map = MarkerMap(corners)
    assert marker_map is not None
    left_out = tuple(marker for marker in sightings.ids if marker not in corners)
    return MapFromCentres(marker_map, left_out)


def _middles(rays: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 2"]:
    """Where the diagonals of each marker cross: the projection of its centre."""
    start, across = rays[:, 0], rays[:, 2] - rays[:, 0]
    other, along = rays[:, 1], rays[:, 3] - rays[:, 1]
    turned = across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]
    off = other - start
    share = (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / np.where(
        np.abs(turned) > 1e-12, turned, np.nan
    )
    return start + share[:, None] * across


def _pose_by_centres(
    centres_m: Float[np.ndarray, "markers 3"], middles: Float[np.ndarray, "markers 2"]
) -> _Pose | None:
    """The pose in which most centres are where they are seen, of at least four."""
    known = np.isfinite(middles).all(axis=1)
    centres_m, middles = centres_m[known], middles[known]
    if len(centres_m) < _LEAST_CENTRES:
        return None
    cv2.setRNGSeed(0)
    try:
        there, turn, shift, inside = cv2.solvePnPRansac(
            centres_m,
            middles,
            np.eye(3),
            None,
            None,
            None,
            False,
            300,
            _NEAR_RAD,
            0.9999,
            None,
            cv2.SOLVEPNP_AP3P,
        )
        if not there or inside is None or len(inside) < _LEAST_CENTRES:
            return None
        rows = inside.ravel()
        turn, shift = cv2.solvePnPRefineLM(centres_m[rows], middles[rows], np.eye(3), None, turn, shift)
    except cv2.error:
        return None
    R = np.asarray(cv2.Rodrigues(turn)[0]).T
    position_m = -R @ shift.ravel()
    ahead = ((centres_m[rows] - position_m) @ R)[:, 2] > NEAR_M
    return (position_m, R) if ahead.all() and np.isfinite(position_m).all() else None


def _pose_by_corners(
    ids: Int[np.ndarray, " markers"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    marker_map: MarkerMap,
    lens: Camera,
) -> _Pose | None:
    inside = np.array([int(marker) in marker_map for marker in ids])
    if inside.sum() < 2:
        return None
    corners_m = marker_map.corners_of(ids[inside].tolist())
    pose = estimate_pose(corners_px[inside], corners_m, lens, PoseSettings(min_markers=2))
    return None if pose is None else (pose.position_m, pose.R_world_cam)


def _corners(
    centre_m: Float[np.ndarray, "3"],
    poses: Sequence[_Pose | None],
    rays: Float[np.ndarray, "views 4 2"],
    R_cam_marker: Float[np.ndarray, "views 2 3 3"],
    units: Float[np.ndarray, "views 2"],
    side_m: float | None,
) -> Float[np.ndarray, "4 3"] | None:
    """Corners of a marker in the world, metres; None where too few views show the marker, or it does not fit.

    Args:
        centre_m: (3,), the marker's centre, metres.
        poses: the camera's pose in each view.
        rays: (views, 4, 2), normalised image coordinates of the corners.
        R_cam_marker: (views, 2, 3, 3), the two rotations of a square that look almost the same.
        units: (views, 2), distance of the marker in sides, in each of the two.
        side_m: the side; None estimates it.
    """
    if len(poses) < _LEAST_FRAMES:
        return None
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _MOST_FRAMES)).astype(int))
    position_m, R = (
        np.array(part) for part in zip(*(pose for pose in poses if pose is not None), strict=True)
    )
    position_m, R, rays = position_m[chosen], R[chosen], rays[chosen]
    sides = np.linalg.norm(centre_m - position_m, axis=1)[:, None] / units[chosen]
    side = float(np.median(sides[:, 0])) if side_m is None else side_m
    candidates = (R[:, None] @ R_cam_marker[chosen]).reshape(-1, 3, 3)

    def off(turn: Float[np.ndarray, "3 3"], length_m: float) -> Float[np.ndarray, "views 4 2"]:
        x_cam = np.einsum("vik,vci->vck", R, centre_m + length_m * SQUARE @ turn.T - position_m[:, None])
        return x_cam[..., :2] / np.maximum(x_cam[..., 2:], NEAR_M) - rays

    def shape_off(turn: Float[np.ndarray, "3 3"], length_m: float) -> Float[np.ndarray, "views 4 2"]:
        """Without the shift of the whole marker, which an error of its centre or of the pose makes."""
        whole = off(turn, length_m)
        return whole - whole.mean(axis=1, keepdims=True)

    losses = [
        np.log1p((shape_off(turn, side) ** 2).sum(axis=(1, 2)) / _LOSS_RAD**2).sum() for turn in candidates
    ]
    start = candidates[int(np.argmin(losses))]

    def moved(step: Float[np.ndarray, " unknowns"]) -> tuple[Float[np.ndarray, "3 3"], float]:
        length_m = side * float(np.exp(step[3])) if len(step) > 3 else side
        return Rotation.from_rotvec(step[:3]).as_matrix() @ start, length_m

    def residuals(step: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " residuals"]:
        return shape_off(*moved(step)).ravel()

    fitted = least_squares(residuals, np.zeros(3 if side_m else 4), loss="cauchy", f_scale=_LOSS_RAD)
    turn, length_m = moved(fitted.x)
    if np.median(np.linalg.norm(off(turn, length_m), axis=-1)) > _FITTING_RAD:
        return None
    return centre_m + length_m * SQUARE @ turn.T
