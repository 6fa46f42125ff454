"""Standard errors of estimates from samples whose errors are correlated in time.

C. J. Geyer, Practical Markov Chain Monte Carlo, Statistical Science 7 (4), 1992, section 3.3 (the initial positive
sequence estimator of `standard_error`).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Real
from scipy.special import stdtrit

#: Two-sided probability of a normal distribution outside of two standard deviations.
_OUTSIDE_TWO_STD = 0.0455


def block_jackknife(
    estimate: Float[np.ndarray, "parameters"],
    left_out: Float[np.ndarray, "blocks parameters"],
    weight: Real[np.ndarray, "blocks"] | None = None,
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of an estimate, from the estimates that leave out one block of the data each.

    Samples within a block may be correlated in any way; blocks are taken as independent. With blocks of one weight the
    covariance is (g - 1) / g times the sum of squares of the left-out estimates about their mean, for g blocks.

    Source: F. M. T. A. Busing, E. Meijer, R. van der Leeden, Delete-m jackknife for unequal m, Statistics and
    Computing 9, 1999, equation 4.

    Args:
        estimate: (parameters,), the estimate from all data.
        left_out: (blocks, parameters), the estimates without each block, in the same units.
        weight: (blocks,), how much each block counts: its number of samples, or its information; above 0. None: all
            the same.

    Returns:
        (parameters, parameters), covariance of the estimate, in products of the parameters' units; NaN for fewer than
        two blocks. Few blocks know it badly: see `widening`.
    """
    if len(left_out) < 2:
        return np.full((len(estimate), len(estimate)), np.nan)
    weight = np.ones(len(left_out)) if weight is None else weight
    ratio = (weight.sum() / weight)[:, None]
    pseudo = ratio * estimate - (ratio - 1) * left_out
    spread = pseudo - (pseudo / ratio).sum(axis=0)
    return (spread / (ratio - 1)).T @ spread / len(left_out)


def widening(freedom: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Factors of standard deviations that were themselves estimated from few independent errors.

    With the factor, an interval of two standard deviations is as wide as that of Student's t distribution. For blocks
    of weights w, the degrees of freedom are about (sum of w)² / (sum of w²) - 1, by F. E. Satterthwaite, Biometrics
    Bulletin 2 (6), 1946.

    Args:
        freedom: degrees of freedom; for blocks of one weight, their number less 1.
    """
    # The quantile of scipy.stats, which takes 0.3 s to import.
    return np.asarray(-stdtrit(freedom, _OUTSIDE_TWO_STD / 2) / 2)


def standard_error(
    values: Float[np.ndarray, "frames parts"], frame: Int[np.ndarray, "frames"]
) -> Float[np.ndarray, "parts"]:
    """Standard error of the mean of each column over correlated frames.

    For independent frames the standard error is s / √n; smaller results are replaced by this value. For correlated
    frames, twice the autocovariance at each lag is added to the variance of the sum. The lags are added in pairs, until
    the sum of a pair is not positive.

    Args:
        values: (frames, parts); rows with a NaN are left out.
        frame: (frames,), numbers of the frames, increasing.

    Returns:
        (parts,), in the unit of the values; NaN for fewer than two rows without NaN.
    """
    finite = np.isfinite(values).all(axis=-1)
    n = int(finite.sum())
    if n < 2:
        return np.full(values.shape[1], np.nan)
    centred, row = values[finite] - values[finite].mean(axis=0), frame[finite] - frame[finite][0]
    # The recording may use every fourth frame only: lags are counted in steps between used frames.
    row = row // np.diff(row).min()
    # Missing frames have the mean, 0. The series is padded with zeros to twice its length, so that no lag wraps around.
    series = np.zeros((2 * (row[-1] + 1), values.shape[1]))
    series[row] = centred
    power = np.abs(np.fft.rfft(series, axis=0)) ** 2
    covariance = np.fft.irfft(power, n=len(series), axis=0)[: len(series) // 2]
    if len(covariance) % 2:
        covariance = np.vstack([covariance, np.zeros_like(covariance[:1])])
    pairs = covariance[0::2] + covariance[1::2]
    used = np.logical_and.accumulate(pairs > 0, axis=0)
    variance_of_sum = 2 * np.where(used, pairs, 0.0).sum(axis=0) - covariance[0]
    return np.sqrt(np.maximum(variance_of_sum, covariance[0]) / (n * (n - 1)))
