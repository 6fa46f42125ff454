"""Estimates of noise and of covariance factors from the residuals of a least-squares fit."""

from __future__ import annotations

from math import log

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from psotrack.geometry import cross_matrices

#: A point is an outlier beyond this number of standard deviations: 4 in a million good points are.
GATE = 5.0
#: σ is larger than stated if the residuals' sum of squares has a smaller probability than this.
UNLIKELY = 0.01


def spread_px(distance_px: Float[np.ndarray, " residuals"], unknowns: int) -> float:
    """Estimate σ along each axis from the median of distances in the image, which may contain outliers.

    Args:
        distance_px: (residuals,), distances of a fit, pixels. With no more equations than unknowns the result is 0.
        unknowns: number of fitted unknowns.
    """
    equations = 2 * len(distance_px)
    if equations <= unknowns:
        return 0.0
    # The median of a Rayleigh distribution is σ √(2 ln 2); a fit takes the unknowns' part of the squares away.
    return float(np.median(distance_px) / np.sqrt(2 * log(2) * (1 - unknowns / equations)))


def inflation(sum_of_squares: float, freedom: int) -> float:
    """Factor of a covariance: above 1 if the residuals are larger than their σ explains, else 1.

    Args:
        sum_of_squares: sum of squared residuals, each in units of its σ.
        freedom: degrees of freedom: number of residuals minus number of unknowns.
    """
    if freedom < 1 or sum_of_squares <= chi2.ppf(1 - UNLIKELY, freedom):
        return 1.0
    return sum_of_squares / freedom


def centre_by_pose(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 6"]:
    """(3, 6), derivative of a camera's centre, -Rᵀ t, by a small turn about its axes and by its translation."""
    return np.hstack([-R.T @ cross_matrices(t_m), -R.T])
