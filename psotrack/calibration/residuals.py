"""What the residuals of a least-squares fit say of the noise, and of what fits badly."""

from __future__ import annotations

from math import log

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

#: Standard deviations from where it should be that make a point an outlier: 4 in a million good ones.
GATE = 5.0
#: Residuals that are this unlikely tell that σ is larger than stated.
UNLIKELY = 0.01


def spread_px(distance_px: Float[np.ndarray, " residuals"], unknowns: int) -> float:
    """σ along x and along y from distances in the image that some outliers are among: by their median.

    Args:
        distance_px: (residuals,), of a fit; 0 is returned where they are no more than the unknowns.
        unknowns: that were fitted to them.
    """
    equations = 2 * len(distance_px)
    if equations <= unknowns:
        return 0.0
    # The median of a Rayleigh distribution is σ √(2 ln 2); a fit takes the unknowns' share of the squares away.
    return float(np.median(distance_px) / np.sqrt(2 * log(2) * (1 - unknowns / equations)))


def inflation(sum_of_squares: float, freedom: int) -> float:
    """What a covariance is multiplied with, because the residuals are larger than their σ explains; else 1.

    Args:
        sum_of_squares: of residuals in units of their σ.
        freedom: number of residuals less that of the unknowns.
    """
    if freedom < 1 or sum_of_squares <= chi2.ppf(1 - UNLIKELY, freedom):
        return 1.0
    return sum_of_squares / freedom
