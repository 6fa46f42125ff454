"""Autocorrelation of errors over time, for the standard deviations of clock offsets."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

#: Largest share of the errors' variance that a fit is taken to remove.
_MAX_SHARE = 0.5
#: Two-sided probability of a normal distribution outside of two standard deviations.
_OUTSIDE_TWO_STD = 0.0455


def widening(share: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Factors of standard deviations that few independent errors have shown.

    A fitted parameter follows the errors and removes a share of their variance, so 1 / share is the effective number of
    independent errors. The factor corrects the removed share, and makes an interval of two standard deviations as wide
    as that of Student's t distribution (C. Satterthwaite, Biometrics Bulletin 2 (6), 1946).

    Args:
        share: shares of the errors' variance that the parameters remove, from 0 to 1.
    """
    share = np.minimum(share, _MAX_SHARE)
    freedom = 1 / np.maximum(share, 1e-9) - 1
    # The quantile of scipy.stats, which takes 0.3 s to import.
    return np.asarray(-stdtrit(freedom, _OUTSIDE_TWO_STD / 2) / 2 / (1 - share))


def autocorrelation(values: Float[np.ndarray, "frames *rest"]) -> Float[np.ndarray, "frames *rest"]:
    """Sums over t of values[t] values[t + lag] for each lag, by the fast Fourier transform.

    Args:
        values: (frames, ...), at least one frame; 0 where a value is missing.

    Returns:
        (lags, ...), one lag per frame, from lag 0.
    """
    # Zeros behind the end keep a lag from wrapping around.
    length = 2 * len(values)
    power = np.abs(np.fft.rfft(values, n=length, axis=0)) ** 2
    return np.fft.irfft(power, n=length, axis=0)[: len(values)]
