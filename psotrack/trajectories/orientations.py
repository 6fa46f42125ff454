"""Orientations as roll, pitch and yaw."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import rotation_matrices as rotation_matrices  # also a name of this room

#: Columns: the axes of a body (x ahead, y left, z up) in the axes of a camera (x right, y down, z ahead).
_BODY_IN_CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def roll_pitch_yaw_deg(
    orientation_wxyz: Float[np.ndarray, "*frames 4"], *, is_camera: bool = True
) -> Float[np.ndarray, "*frames 3"]:
    """Angles of a camera's orientation, as of a body that faces the camera's viewing direction; NaN stays NaN.

    The body's axes are x ahead (the camera's z), y left, z up. It is turned about the world's z by yaw, then about its
    own y by pitch, then about its own x by roll: R = Rz(yaw) Ry(pitch) Rx(roll), as in ROS (REP 103). Yaw is counted
    from the world's x axis, counterclockwise seen from above. Pitch is positive with the nose down, roll with the right
    side down. Each angle is in (-180, 180], pitch in [-90, 90].

    Args:
        orientation_wxyz: (*frames, 4), unit quaternions, camera to world.
        is_camera: whether the axes are those of a camera (x right, y down, z ahead); otherwise those of the body.

    Returns:
        (*frames, 3): roll, pitch, yaw, degrees.
    """
    body = rotation_matrices(orientation_wxyz) @ (_BODY_IN_CAMERA if is_camera else np.eye(3))
    roll = np.arctan2(body[..., 2, 1], body[..., 2, 2])
    pitch = -np.arcsin(np.clip(body[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(body[..., 1, 0], body[..., 0, 0])
    return np.degrees(np.stack([roll, pitch, yaw], axis=-1))
