"""Distinguish drones by their apparent size.

The measured size depends on the views and on the drone's attitude, so its errors are correlated over many frames. The
information of an interval of time is estimated from the scatter of the intervals' means (batch means: G. S. Fishman,
Grouping observations in digital simulation, Management Science 24(5), 1978). The estimated sizes of equal drones differ
by chance, so the differences are shrunk by the amount that chance explains (W. James, C. Stein, Estimation with
quadratic loss, 1961, the positive-part estimator).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

#: Length of an interval, seconds: longer than the errors are correlated.
_INTERVAL_S = 2.0

#: Smallest number of intervals of all drones together, and of each drone, from which the scatter can be estimated.
_MIN_INTERVALS = 8
_MIN_INTERVALS_EACH = 3

#: Factor on the average effect of chance, because few intervals give the effect only roughly.
_CHANCE = 4.0

#: Deviations are clipped to this number of standard deviations, which are estimated from the median deviation.
_MAX_DEVIATION = 4.0

#: Degrees of freedom of Student's t, whose long tails let a size that fits no drone decide little.
_TAIL = 4.0


@dataclass(frozen=True)
class Likeness:
    """Sizes of a group's drones.

    Attributes:
        typical_m: (drones, 3), typical measured size of each drone.
        precision_m2: (3, 3), m^-2, inverse covariance of the size in one frame that treats frames as independent.
    """

    typical_m: Float[np.ndarray, "drones 3"]
    precision_m2: Float[np.ndarray, "3 3"]


def learn_likeness(
    time_s: Float[np.ndarray, "frames"], size_m: Float[np.ndarray, "frames drones 3"]
) -> Likeness | None:
    """Learn the sizes of drones from measured sizes, NaN where not known or unreliable; None if there are too few."""
    known = np.isfinite(size_m).all(axis=-1)
    if not known.any(axis=0).all():
        return None
    typical_m = np.stack([np.median(size_m[rows, drone], axis=0) for drone, rows in enumerate(known.T)])
    off_m = np.where(known[..., None], size_m - typical_m, 0.0)
    # At least a thousandth of a millimetre, for sizes that are exactly equal in all frames.
    usual_m = np.maximum(1.4826 * np.median(np.abs(off_m[known]), axis=0), 1e-6)
    off_m = np.clip(off_m, -_MAX_DEVIATION * usual_m, _MAX_DEVIATION * usual_m)
    shift_m = off_m.sum(axis=0) / known.sum(axis=0)[:, None]
    off_m = np.where(known[..., None], off_m - shift_m, 0.0)

    interval = np.floor((time_s - time_s[0]) / _INTERVAL_S).astype(np.int64)
    counts = np.zeros((interval[-1] + 1, known.shape[1]))
    np.add.at(counts, interval, known)
    sums_m = np.zeros((*counts.shape, 3))
    np.add.at(sums_m, interval, off_m)
    # Intervals with few measurements scatter more than the others.
    full = counts > 0.5 * counts.max()
    number = full.sum(axis=0)
    if number.sum() < _MIN_INTERVALS or number.min() < _MIN_INTERVALS_EACH:
        return None
    means_m = sums_m[full] / counts[full][:, None]
    within_m2 = off_m[known].T @ off_m[known] / known.sum() + 1e-12 * np.eye(3)
    # One number for all axes, because few intervals do not give a whole matrix.
    squares = np.einsum("si,is->", means_m, np.linalg.solve(within_m2, means_m.T))
    share = squares / (3 * (number.sum() - len(number)))
    precision_m2 = np.linalg.inv((1 + counts[full].mean() * share) * within_m2)
    return Likeness(_shrink(typical_m + shift_m, share * within_m2, number), precision_m2)


def _shrink(
    typical_m: Float[np.ndarray, "drones 3"],
    between_m2: Float[np.ndarray, "3 3"],
    number: Int[np.ndarray, "drones"],
) -> Float[np.ndarray, "drones 3"]:
    """Shrink sizes towards their mean, completely if their differences are no larger than chance explains.

    Args:
        typical_m: (drones, 3), sizes.
        between_m2: covariance of the mean of an interval.
        number: (drones,), number of intervals.
    """
    mean_m = np.average(typical_m, axis=0, weights=number)
    apart_m = typical_m - mean_m
    found = (number * np.einsum("di,id->d", apart_m, np.linalg.solve(between_m2, apart_m.T))).sum()
    by_chance = _CHANCE * 3 * (len(number) - 1)
    return mean_m + apart_m * (1 - by_chance / max(found, by_chance))


def log_likelihood(
    likeness: Likeness | None, size_m: Float[np.ndarray, "drones 3"], clear: Bool[np.ndarray, "drones"]
) -> Float[np.ndarray, "drones drones"]:
    """(drones, tracks), log likelihood of each track's size if the track is the drone, up to a constant.

    Args:
        likeness: sizes of the drones; None gives 0.
        size_m: (tracks, 3), measured sizes in one frame; NaN where not known, which gives 0.
        clear: (tracks,), whether the measured size is reliable; False gives 0.
    """
    if likeness is None:
        return np.zeros((len(size_m),) * 2)
    clear = clear & np.isfinite(size_m).all(axis=-1)
    off_m = np.where(clear[:, None], size_m - likeness.typical_m[:, None], 0.0)
    distance = np.einsum("dti,ij,dtj->dt", off_m, likeness.precision_m2, off_m)
    return -(_TAIL + 3) / 2 * np.log1p(distance / _TAIL)
