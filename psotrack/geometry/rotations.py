"""Rotation matrices from quaternions, and skew-symmetric matrices of cross products."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

#: Largest difference between 1 and the length of a quaternion in a file: far above the rounding of a few digits, far
#: below a mistake.
LENGTH_TOLERANCE = 1e-2


def rotation_matrices(orientation_wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), w first; NaN for a quaternion with NaN."""
    known = np.isfinite(orientation_wxyz).all(axis=-1)
    matrices = np.full((*known.shape, 3, 3), np.nan)
    matrices[known] = Rotation.from_quat(orientation_wxyz[known], scalar_first=True).as_matrix()
    return matrices


def cross_matrices(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Skew-symmetric matrices [v] of vectors v, with [v] w = v x w."""
    matrices = np.zeros((*vectors.shape, 3))
    matrices[..., [2, 0, 1], [1, 2, 0]] = vectors
    return matrices - matrices.swapaxes(-1, -2)
