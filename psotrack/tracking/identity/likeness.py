"""Distinguish two drones by their apparent size.

The measured size depends on the views and on the drone's attitude, so its errors are correlated over many frames. What
an interval of time says is estimated from the scatter of the intervals' medians (batch means: G. S. Fishman, Grouping
observations in digital simulation, Management Science 24(5), 1978). The estimated sizes of equal drones differ by
chance, so the difference is shrunk by the amount that chance explains (W. James, C. Stein, Estimation with quadratic
loss, 1961, the positive-part estimator).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Length of an interval, seconds: longer than the errors are correlated.
_INTERVAL_S = 2.0

#: Smallest number of intervals of each drone from which the scatter can be estimated.
_MIN_INTERVALS = 4

#: Least variance of a size, m², for sizes that are exactly equal in all frames.
_LEAST_M2 = 1e-12

#: Factor on the average effect of chance, because few intervals give the effect only roughly.
_CHANCE = 4.0

#: Degrees of freedom of Student's t, whose long tails let a size that fits no drone decide little.
_TAIL = 4.0


def size_log_likelihoods(
    time_s: Float[np.ndarray, "frames"], size_m: Float[np.ndarray, "frames 2 3"], first: int
) -> Float[np.ndarray, "frames 2"]:
    """(frames, 2), log likelihood of both sizes if the labels are kept and if they are exchanged, up to a constant.

    Args:
        time_s: (frames,), times.
        size_m: (frames, 2, 3), measured sizes of the two drones; NaN where not known or unreliable, which gives 0.
        first: first frame of the encounter; the drones' sizes are learned from the frames before.
    """
    known = np.isfinite(size_m[:first]).all(axis=-1)
    one, other = (
        _interval_medians(time_s[:first][rows], size_m[:first][rows, drone])
        for drone, rows in enumerate(known.T)
    )
    if min(len(one), len(other)) < _MIN_INTERVALS:
        return np.zeros((len(time_s), 2))
    off_m = np.concatenate([one - one.mean(axis=0), other - other.mean(axis=0)])
    # One number for all axes, because few intervals do not give a whole matrix.
    scatter_m2 = (off_m**2).sum() / (3 * (len(off_m) - 2)) + _LEAST_M2
    middle_m, half_m = (one.mean(axis=0) + [[1], [-1]] * other.mean(axis=0)) / 2
    by_chance = _CHANCE * 3 * scatter_m2 * (1 / len(one) + 1 / len(other))
    half_m = half_m * max(1 - by_chance / ((2 * half_m) ** 2).sum(), 0.0)
    # The frames of an interval together say as much as the interval.
    variance_m2 = scatter_m2 * known.sum() / len(off_m)
    typical_m = middle_m + np.array([[half_m, -half_m], [-half_m, half_m]])
    distance = ((size_m[:, None] - typical_m) ** 2).sum(axis=-1) / variance_m2
    return np.nansum(-(_TAIL + 3) / 2 * np.log1p(distance / _TAIL), axis=-1)


def _interval_medians(
    time_s: Float[np.ndarray, "known"], size_m: Float[np.ndarray, "known 3"]
) -> Float[np.ndarray, "intervals 3"]:
    """Median of each interval's sizes. Intervals with few measurements scatter more, and are left out."""
    begins = np.flatnonzero(np.diff(time_s // _INTERVAL_S)) + 1
    parts = np.split(size_m, begins)
    usual = max(len(part) for part in parts)
    return np.array([np.median(part, axis=0) for part in parts if len(part) > usual / 2]).reshape(-1, 3)
