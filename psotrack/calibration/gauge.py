"""The gauge of a rig: position, orientation and scale of the world, which pixels do not determine.

Of all rigs that fit equally well, the rig that is moved least from the given rig is chosen: the sum over the cameras of
their squared shifts, in units of `SHIFT_M`, and squared turns, in units of `TURN_RAD`, has no slope along the seven
common motions (inner constraints; Triggs et al. 2000, section 9).

A rig's unknowns are six per camera, a small turn about its axes (rad) and a change of its translation (m), and last the
logarithm of the factor of all focal lengths, which common motions do not change.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.calibration.derivatives import centre_by_pose
from psotrack.geometry import cross_matrices

#: Shift of a camera's centre, metres, and turn of a camera, radians, that count equally when a rig is moved.
SHIFT_M = 0.05
TURN_RAD = np.deg2rad(0.5)


def common_motions(T_cam_world: Float[np.ndarray, "cameras 4 4"]) -> Float[np.ndarray, "unknowns 7"]:
    """Derivatives of the cameras' poses by turns (3), shifts (3) and growth (1) of the world about its middle."""
    centre = _centres(T_cam_world)
    middle = centre.mean(axis=0)
    blocks = []
    for T, c in zip(T_cam_world, centre, strict=True):
        R, from_middle = T[:3, :3], c - middle
        # Camera to world turns by w: R becomes R exp(-w), a turn of -R w about the camera's axes.
        by_turn, by_centre = np.zeros((3, 7)), np.zeros((3, 7))
        by_turn[:, :3] = -R
        by_centre[:, :3], by_centre[:, 3:6], by_centre[:, 6] = (
            -cross_matrices(from_middle),
            np.eye(3),
            from_middle,
        )
        # t = -R c, so its change is -R dc, and -[dθ] R c = [R c] dθ.
        blocks.append(np.vstack([by_turn, -R @ by_centre + cross_matrices(R @ c) @ by_turn]))
    return np.vstack([*blocks, np.zeros((1, 7))])


def pose_changes(
    given: Float[np.ndarray, "cameras 4 4"], now: Float[np.ndarray, "cameras 4 4"]
) -> Float[np.ndarray, " unknowns"]:
    """Change of each camera's pose in the rig's unknowns: a turn about its axes, and a change of its translation."""
    parts = []
    for T, c, T_now, c_now in zip(given, _centres(given), now, _centres(now), strict=True):
        R = T[:3, :3]
        turn = cv2.Rodrigues(T_now[:3, :3] @ R.T)[0].ravel()
        parts += [turn, -R @ (c_now - c) + cross_matrices(R @ c) @ turn]
    return np.concatenate([*parts, [0.0]])


def _centres(T_cam_world: Float[np.ndarray, "cameras 4 4"]) -> Float[np.ndarray, "cameras 3"]:
    return -np.einsum("cji,cj->ci", T_cam_world[:, :3, :3], T_cam_world[:, :3, 3])


def pose_change_metric(given: Float[np.ndarray, "cameras 4 4"]) -> Float[np.ndarray, "unknowns unknowns"]:
    """Metric of the poses' changes: turns count in units of `TURN_RAD`, shifts of the centres in units of `SHIFT_M`."""
    squared = np.zeros((6 * len(given) + 1, 6 * len(given) + 1))
    for index, T in enumerate(given):
        by_pose = centre_by_pose(T[:3, :3], T[:3, 3]) / SHIFT_M
        block = by_pose.T @ by_pose
        block[:3, :3] += np.eye(3) / TURN_RAD**2
        squared[6 * index : 6 * index + 6, 6 * index : 6 * index + 6] = block
    return squared
