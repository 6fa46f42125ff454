"""Standard error of a mean over time when the errors of neighbouring frames are correlated.

C. J. Geyer, Practical Markov Chain Monte Carlo, Statistical Science 7 (4), 1992, section 3.3 (the initial positive
sequence estimator).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


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
