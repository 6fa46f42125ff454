"""How well a mean over time is known when neighbouring frames err alike, as those of a tracker do.

C. J. Geyer, Practical Markov Chain Monte Carlo, Statistical Science 7 (4), 1992, section 3.3 (the initial positive
sequence estimator).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def standard_error(
    values: Float[np.ndarray, "frames parts"], frame: Int[np.ndarray, "frames"]
) -> Float[np.ndarray, "parts"]:
    """Standard error of the mean over frames of each column, which counts correlated frames as fewer.

    For independent frames it is s / √n, and it is never taken to be less. For others the variance of the sum is that of
    n values and twice their autocovariances at all lags, summed in pairs until a pair is no longer positive.

    Args:
        values: (frames, parts); rows with a NaN are not there.
        frame: (frames,), numbers of the frames, increasing.

    Returns:
        (parts,), in the unit of the values; NaN where fewer than two rows are there.
    """
    there = np.isfinite(values).all(axis=-1)
    n = int(there.sum())
    if n < 2:
        return np.full(values.shape[1], np.nan)
    centred, row = values[there] - values[there].mean(axis=0), frame[there] - frame[there][0]
    # Frames may be every fourth: lags are counted in the steps that there are.
    row = row // np.diff(row).min()
    # Zeros, the mean, in frames that are missing, and behind the end so that no lag wraps around.
    series = np.zeros((2 * (row[-1] + 1), values.shape[1]))
    series[row] = centred
    power = np.abs(np.fft.rfft(series, axis=0)) ** 2
    covariance = np.fft.irfft(power, n=len(series), axis=0)[: len(series) // 2]
    if len(covariance) % 2:
        covariance = np.vstack([covariance, np.zeros_like(covariance[:1])])
    pairs = covariance[0::2] + covariance[1::2]
    kept = np.logical_and.accumulate(pairs > 0, axis=0)
    of_sum = 2 * np.where(kept, pairs, 0.0).sum(axis=0) - covariance[0]
    return np.sqrt(np.maximum(of_sum, covariance[0]) / (n * (n - 1)))
