"""The motion that brings points nearest to others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def similarity(
    from_m: Float[np.ndarray, "points 3"],
    to_m: Float[np.ndarray, "points 3"],
    *,
    with_scale: bool = True,
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Scale s, rotation R and shift t for which s R x + t is nearest to y for the pairs (x, y) of points.

    Least squares: S. Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point Patterns, IEEE
    Transactions on Pattern Analysis and Machine Intelligence 13 (4), 1991, equations 38 to 43.

    Args:
        from_m: (points, 3), points x, metres.
        to_m: (points, 3), points y, metres.
        with_scale: whether s is found; else it is 1.
    """
    from_middle_m, to_middle_m = from_m.mean(axis=0), to_m.mean(axis=0)
    a, b = from_m - from_middle_m, to_m - to_middle_m
    U, strength, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U * signs @ Vt
    scale = float(strength @ signs / max(np.sum(a**2), 1e-300)) if with_scale else 1.0
    return scale, R, to_middle_m - scale * R @ from_middle_m
