"""Ellipsoids that hold 90 % of a normal distribution in space, from covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.evaluation import INSIDE_90


@dataclass(frozen=True)
class Ellipsoids:
    """Ellipsoids about points.

    Attributes:
        half_axes_m: (..., 3), half lengths of the axes, from the shortest to the longest, metres; NaN if unknown.
        rotation: (..., 3, 3), rotation matrices whose columns are the directions of the axes in the world.
    """

    half_axes_m: Float[np.ndarray, "*points 3"]
    rotation: Float[np.ndarray, "*points 3 3"]


def ellipsoids_90(covariance_m2: Float[np.ndarray, "*points 3 3"]) -> Ellipsoids:
    """The 90 % ellipsoid of each covariance.

    Args:
        covariance_m2: (..., 3, 3), covariances, m²; NaN where unknown.
    """
    known = np.isfinite(covariance_m2).all(axis=(-2, -1))
    whole = np.where(known[..., None, None], covariance_m2, np.eye(3)).astype(np.float64)
    variance_m2, directions = np.linalg.eigh(whole)
    # Eigenvectors may form a left-handed system, which is no rotation.
    directions[..., :, 0] *= np.linalg.det(directions)[..., None]
    half_m = np.sqrt(np.maximum(variance_m2, 0.0) * INSIDE_90)
    return Ellipsoids(np.where(known[..., None], half_m, np.nan), directions)
