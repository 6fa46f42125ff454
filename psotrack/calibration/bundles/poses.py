"""Steps of poses, which both bundle adjustments take in the same way."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float


def move_poses(
    T: Float[np.ndarray, "poses 4 4"], change: Float[np.ndarray, "poses 6"]
) -> Float[np.ndarray, "poses 4 4"]:
    """Turn poses by small turns about the target's axes, rad, and shift them, metres: (poses, 6), turns first."""
    moved = T.copy()
    for index, (turn, shift) in enumerate(zip(change[:, :3], change[:, 3:], strict=True)):
        moved[index, :3, :3] = cv2.Rodrigues(turn)[0] @ T[index, :3, :3]
        moved[index, :3, 3] += shift
    return moved
