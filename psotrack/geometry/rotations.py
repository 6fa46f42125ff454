"""Rotation matrices of quaternions, and the matrices of small turns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def rotation_matrices(orientation_wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The matrices of quaternions; NaN where one is not known."""
    known = np.isfinite(orientation_wxyz).all(axis=-1)
    matrices = np.full((*known.shape, 3, 3), np.nan)
    matrices[known] = Rotation.from_quat(orientation_wxyz[known], scalar_first=True).as_matrix()
    return matrices


def cross_matrices(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """[v] with [v] w = v x w."""
    matrices = np.zeros((*vectors.shape, 3))
    matrices[..., [2, 0, 1], [1, 2, 0]] = vectors
    return matrices - matrices.swapaxes(-1, -2)
