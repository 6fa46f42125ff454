"""Initial poses of a camera, by closed-form solvers: for all markers, for pairs of markers, and turned over.

The pose of all markers together is by SQPnP (Terzakis & Lourakis, ECCV 2020). Poses of pairs of markers, by AP3P (Ke &
Roumeliotis, CVPR 2017), are for frames in which some markers are wrong, as in random sample consensus (Fischler &
Bolles, CACM 24(6), 1981). Markers in a plane have a second, mirrored pose (IPPE; Collins & Bartoli, IJCV 2014).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry import NEAR_M
from psotrack.inside_out.pose.equations import SeenCorners
from psotrack.inside_out.pose.fit import MIN_CORNERS, Fit

#: Position of the camera and rotation from camera to world.
InitialPose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]

#: Largest distance of a corner from its projection, in stated standard deviations of a corner, at which an initial
#: pose of few markers still explains the corner.
LOOSE = 15.0
#: Largest number of pairs of markers from which poses are computed. With 40 % wrong markers a third of the pairs is
#: right.
_MOST_PAIRS = 55
#: Largest number of markers in a frame for which poses of single markers are computed too.
_FEW_MARKERS = 3
#: Largest number of initial poses that are fitted.
_MOST_INITIAL_POSES = 4
#: Ratio of the smallest to the largest extent of markers below which they may have a second, mirrored pose.
_NEARLY_FLAT = 0.1
#: Angle to a known pose below which an initial pose would end at the known pose, radians.
_SAME_ANGLE_RAD = np.deg2rad(1.0)


def pose_of_all(corners: SeenCorners, rays: Float[np.ndarray, "markers 4 2"]) -> list[InitialPose]:
    """Poses of all markers together: at most one, if all markers are right."""
    return _solve(corners.corners_m, rays, cv2.SOLVEPNP_SQPNP)


def poses_of_pairs(
    corners: SeenCorners, rays: Float[np.ndarray, "markers 4 2"]
) -> list[tuple[InitialPose, Bool[np.ndarray, "markers 4"]]]:
    """Poses of pairs of markers that explain most corners, with these corners; each pose explains other markers."""
    poses = list(_poses_of_few(corners, rays))
    if not poses:
        return []
    distance = projection_distances_px(corners, rays, poses) / (LOOSE * corners.noise_px)
    fits = (distance < 1).sum(axis=-1) >= MIN_CORNERS
    cost = np.minimum(distance, 10.0).sum(axis=(1, 2))
    chosen: list[tuple[InitialPose, Bool[np.ndarray, "markers 4"]]] = []
    for index in np.argsort(cost, kind="stable"):
        if len(chosen) == _MOST_INITIAL_POSES:
            break
        used = fits[index][:, None] & (distance[index] < 1)
        if used.any() and not any((used.any(axis=1) == other.any(axis=1)).all() for _, other in chosen):
            chosen.append((poses[index], used))
    return chosen


def mirrored_poses(
    corners: SeenCorners, rays: Float[np.ndarray, "markers 4 2"], best: Fit
) -> list[InitialPose]:
    """Second poses of markers that lie nearly in a plane, without those that equal the best pose."""
    corners_m = corners.corners_m[best.used]
    middle_m = corners_m.mean(axis=(0, 1))
    _, extent_m, axes = np.linalg.svd((corners_m - middle_m).reshape(-1, 3), full_matrices=False)
    if extent_m[2] > _NEARLY_FLAT * extent_m[0]:
        return []
    flat_m = corners_m - ((corners_m - middle_m) @ axes[2])[..., None] * axes[2]
    poses = _solve(flat_m, rays[best.used], cv2.SOLVEPNP_IPPE)
    if not poses:
        return []
    distance_px = projection_distances_px(corners, rays, poses)[:, best.fits]
    near_px = LOOSE * max(corners.noise_px, best.reprojection_px)
    return [
        pose
        for pose, pose_distance_px in zip(poses, distance_px, strict=True)
        if np.sqrt(np.mean(pose_distance_px**2)) < near_px and not _is_same(pose, best)
    ]


def projection_distances_px(
    corners: SeenCorners, rays: Float[np.ndarray, "markers 4 2"], poses: list[InitialPose]
) -> Float[np.ndarray, "poses markers 4"]:
    """Distance of each corner from its projection, pixels of an image without distortion; infinite behind the camera.

    Args:
        corners: markers of the frame.
        rays: (markers, 4, 2), normalised image coordinates of the corners.
        poses: initial poses of the camera.
    """
    position_m, R = (np.array(part) for part in zip(*poses, strict=True))
    x_cam = (corners.corners_m.reshape(-1, 3) - position_m[:, None]) @ R
    ahead = x_cam[..., 2] > NEAR_M
    projected = x_cam[..., :2] / np.where(ahead, x_cam[..., 2], 1.0)[..., None]
    off_px = (projected - rays.reshape(-1, 2)) * np.diag(corners.lens.K)[:2]
    return np.where(ahead, np.linalg.norm(off_px, axis=-1), np.inf).reshape(len(poses), *rays.shape[:2])


def _poses_of_few(corners: SeenCorners, rays: Float[np.ndarray, "markers 4 2"]) -> Iterator[InitialPose]:
    """Poses of pairs of markers, from two opposite corners of each; in frames of few markers, of single markers too."""
    count = len(rays)
    pairs = list(combinations(range(count), 2))
    if len(pairs) > _MOST_PAIRS:
        chosen = np.random.default_rng(0).permutation(len(pairs))[:_MOST_PAIRS]
        pairs = [pairs[index] for index in chosen]
    for pair in pairs:
        opposite = [[marker] for marker in pair], [[0, 2], [1, 3]]
        yield from _solve(corners.corners_m[opposite], rays[opposite], cv2.SOLVEPNP_AP3P)
    for marker in range(count if count <= _FEW_MARKERS else 0):
        yield from _solve(corners.corners_m[marker], rays[marker], cv2.SOLVEPNP_IPPE)


def _solve(
    corners_m: Float[np.ndarray, "*corners 3"], rays: Float[np.ndarray, "*corners 2"], method: int
) -> list[InitialPose]:
    """Finite poses that a solver of OpenCV finds for corners on rays."""
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            corners_m.reshape(-1, 3), rays.reshape(-1, 2), np.eye(3), None, flags=method
        )
    except cv2.error:
        # OpenCV fails for degenerate corners, such as corners on one line.
        return []
    poses = [
        (np.asarray(cv2.Rodrigues(turn)[0]).T, shift.ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return [(-R @ t_m, R) for R, t_m in poses if np.isfinite(R).all() and np.isfinite(t_m).all()]


def _is_same(pose: InitialPose, best: Fit) -> bool:
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    return bool(np.sum(pose[1] * best.R_world_cam) > 1 + 2 * np.cos(_SAME_ANGLE_RAD))
