"""Covariances in files of others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

#: Largest size of an eigenvalue below zero that is a rounding error, as a fraction of the largest eigenvalue: sums in
#: float32 and files with six digits have such errors.
_ROUNDING = 1e-5


def has_negative_eigenvalue(covariance: Float[np.ndarray, "*rows n n"]) -> Bool[np.ndarray, "*rows"]:
    """Say which matrices are no covariances, because an eigenvalue is further below zero than rounding explains.

    Args:
        covariance: (*rows, n, n), symmetric. A matrix with NaN is unknown, and is not judged.
    """
    known = ~np.isnan(covariance).any(axis=(-2, -1))
    eigenvalues = np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0))
    return eigenvalues[..., 0] < -_ROUNDING * np.abs(eigenvalues).max(axis=-1)
