"""Rows of arrays: those from files of others that are wrong, and a few of many, evenly spread."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

#: Shortest time between two samples, seconds. Times in files are whole nanoseconds at the finest, and a change divided
#: by a much shorter time overflows.
LEAST_STEP_S = 0.5e-9
#: Largest size of an eigenvalue below zero that is a rounding error, as a fraction of the largest eigenvalue: sums in
#: float32 and files with six digits have such errors.
_ROUNDING = 1e-5


def first_true(wrong: Bool[np.ndarray, "rows"]) -> int | None:
    """Index of the first row that is wrong; None if there is none."""
    return int(np.argmax(wrong)) if wrong.any() else None


def first_repeated(keys: Int[np.ndarray, "rows"]) -> int | None:
    """Index of the first row whose key a row before has; None if there is none."""
    repeated = np.ones(len(keys), bool)
    repeated[np.unique(keys, return_index=True)[1]] = False
    return first_true(repeated)


def first_repeat(time_s: Float[np.ndarray, "samples"]) -> int | None:
    """Index of the first time that is not at least `LEAST_STEP_S` after the time before it; None if there is none.

    Args:
        time_s: (samples,), seconds. Steps from or to NaN are not judged.
    """
    repeats = np.flatnonzero(np.diff(time_s) < LEAST_STEP_S)
    return int(repeats[0]) + 1 if len(repeats) else None


def has_negative_eigenvalue(covariance: Float[np.ndarray, "*rows n n"]) -> Bool[np.ndarray, "*rows"]:
    """Say which matrices are no covariances, because an eigenvalue is further below zero than rounding explains.

    Args:
        covariance: (*rows, n, n), symmetric. A matrix with NaN is unknown, and is not judged.
    """
    known = ~np.isnan(covariance).any(axis=(-2, -1))
    eigenvalues = np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0))
    return eigenvalues[..., 0] < -_ROUNDING * np.abs(eigenvalues).max(axis=-1)


def evenly_spread(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """(chosen,), indices of at most `most` of `count` things, evenly spread from the first to the last one."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)
