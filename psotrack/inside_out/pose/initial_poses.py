"""Initial poses of a camera, by closed-form solvers: for all markers, for pairs of markers, and turned over.

The pose of all markers together is by SQPnP (Terzakis & Lourakis, ECCV 2020). Poses of pairs of markers, by AP3P (Ke &
Roumeliotis, CVPR 2017), are for frames in which some markers are wrong, as in random sample consensus (Fischler &
Bolles, CACM 24(6), 1981). Markers in a plane have a second, mirrored pose (IPPE; Collins & Bartoli, IJCV 2014).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration import Solver, solve_pnp
from psotrack.geometry import NEAR_M
from psotrack.inside_out.pose.equations import SeenMarkers
from psotrack.inside_out.pose.fit import MIN_CORNERS
from psotrack.inside_out.pose.records import MarkerPose

#: Position of the camera and rotation from camera to world.
InitialPose = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]

#: Largest distance of a corner from its projection, in standard deviations of a corner, and smallest value of it in
#: pixels, at which an initial pose of few markers still explains the corner.
_LOOSE, _LOOSE_PX = 15.0, 3.0
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


def near_px(seen: SeenMarkers) -> Float[np.ndarray, "markers"]:
    """(markers,), distance of a corner from its projection at which a pose still explains the corner, pixels."""
    return np.maximum(_LOOSE * seen.std_px, _LOOSE_PX)


def pose_of_all(seen: SeenMarkers) -> list[InitialPose]:
    """Poses of all markers together: at most one, if all markers are right."""
    return _solve(seen.corners_m, seen.rays, "sqpnp")


def poses_of_pairs(seen: SeenMarkers) -> list[tuple[InitialPose, Bool[np.ndarray, "markers 4"]]]:
    """Poses of pairs of markers that explain most corners, with these corners; each pose explains other markers."""
    poses = list(_poses_of_few(seen))
    if not poses:
        return []
    distance = _distances_px(seen, poses) / near_px(seen)[:, None]
    fits = (distance < 1).sum(axis=-1) >= MIN_CORNERS
    cost = np.minimum(distance, 10.0).sum(axis=(1, 2))
    chosen: list[tuple[InitialPose, Bool[np.ndarray, "markers 4"]]] = []
    for index in np.argsort(cost, kind="stable"):
        used = fits[index][:, None] & (distance[index] < 1)
        if used.any() and not any((used.any(axis=1) == other.any(axis=1)).all() for _, other in chosen):
            chosen.append((poses[index], used))
    return chosen[:_MOST_INITIAL_POSES]


def mirrored_poses(seen: SeenMarkers, best: MarkerPose) -> list[InitialPose]:
    """Second poses of markers that lie nearly in a plane, without those that equal the best pose."""
    corners_m = seen.corners_m[best.used]
    extent_m = np.linalg.svd((corners_m - corners_m.mean(axis=(0, 1))).reshape(-1, 3), compute_uv=False)
    if extent_m[2] > _NEARLY_FLAT * extent_m[0]:
        return []
    poses = _solve(corners_m, seen.rays[best.used], "ippe")
    if not poses:
        return []
    rms_px = np.sqrt(np.mean(_distances_px(seen, poses)[:, best.fits] ** 2, axis=1))
    near = rms_px < max(near_px(seen)[best.used].mean(), _LOOSE * best.reprojection_px)
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    least_trace = 1 + 2 * np.cos(_SAME_ANGLE_RAD)
    return [
        pose
        for pose, is_near in zip(poses, near, strict=True)
        if is_near and np.sum(pose[1] * best.R_world_cam) < least_trace
    ]


def _distances_px(seen: SeenMarkers, poses: list[InitialPose]) -> Float[np.ndarray, "poses markers 4"]:
    """Distance of each corner from its projection, pixels without distortion; infinite behind the camera."""
    position_m, R = (np.array(part) for part in zip(*poses, strict=True))
    x_cam = (seen.corners_m.reshape(-1, 3) - position_m[:, None]) @ R
    ahead = x_cam[..., 2] > NEAR_M
    projected = x_cam[..., :2] / np.where(ahead, x_cam[..., 2], 1.0)[..., None]
    off_px = (projected - seen.rays.reshape(-1, 2)) * np.diag(seen.lens.K)[:2]
    return np.where(ahead, np.linalg.norm(off_px, axis=-1), np.inf).reshape(len(poses), *seen.rays.shape[:2])


def _poses_of_few(seen: SeenMarkers) -> Iterator[InitialPose]:
    """Poses of pairs of markers, from two opposite corners of each; in frames of few markers, of single markers too."""
    count = len(seen.rays)
    pairs = list(combinations(range(count), 2))
    if len(pairs) > _MOST_PAIRS:
        chosen = np.random.default_rng(0).permutation(len(pairs))[:_MOST_PAIRS]
        pairs = [pairs[index] for index in chosen]
    for pair in pairs:
        opposite = [[marker] for marker in pair], [[0, 2], [1, 3]]
        yield from _solve(seen.corners_m[opposite], seen.rays[opposite], "ap3p")
    for marker in range(count if count <= _FEW_MARKERS else 0):
        yield from _solve(seen.corners_m[marker], seen.rays[marker], "ippe")


def _solve(
    corners_m: Float[np.ndarray, "*corners 3"], rays: Float[np.ndarray, "*corners 2"], solver: Solver
) -> list[InitialPose]:
    """Poses that a solver finds for corners on rays, the pose of smallest reprojection error first."""
    poses = solve_pnp(corners_m.reshape(-1, 3), rays.reshape(-1, 2), solver)
    return [(-T[:3, :3].T @ T[:3, 3], T[:3, :3].T) for T in poses]
