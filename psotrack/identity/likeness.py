"""Telling drones apart by their apparent size, as far as that is possible.

The size that a frame shows depends on the views and on the drone's attitude, and so is off in the same way for many
frames. The frames of a second are no independent looks; what a stretch of time is worth is learned from how far the
means of stretches scatter (batch means: G. S. Fishman, Grouping observations in digital simulation, Management Science
24(5), 1978). Drones that are alike differ in what was learned of them, too: what they differ by is shrunk by what
chance alone would make of it (W. James, C. Stein, Estimation with quadratic loss, 1961, its positive part).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

#: Longer than most errors last.
_STRETCH_S = 2.0

#: With fewer stretches, of all drones together and of any one of them, nothing is known of how sizes scatter.
_MIN_STRETCHES = 8
_MIN_STRETCHES_EACH = 3

#: What chance is taken to do, in terms of what it does on average; of the few stretches it is not well known.
_CHANCE = 4.0

#: Sizes farther off than so many times the median deviation are drawn in to there before they are learned from.
_FARTHEST = 4.0

#: Degrees of freedom of Student's t: a size that fits no drone decides nothing.
_TAIL = 4.0


@dataclass(frozen=True)
class Likeness:
    """What the drones of a group look like.

    Attributes:
        typical_m: (drones, 3), the size that each usually has.
        precision_m2: (3, 3), inverse covariance of the size in a frame, if frames were independent; m^-2.
    """

    typical_m: Float[np.ndarray, "drones 3"]
    precision_m2: Float[np.ndarray, "3 3"]


def learn(
    time_s: Float[np.ndarray, "frames"], size_m: Float[np.ndarray, "frames drones 3"]
) -> Likeness | None:
    """What sizes (NaN where not known, or not to be trusted) say of the drones; None if that is too little."""
    known = np.isfinite(size_m).all(axis=-1)
    if not known.any(axis=0).all():
        return None
    typical_m = np.stack([np.median(size_m[rows, drone], axis=0) for drone, rows in enumerate(known.T)])
    off_m = np.where(known[..., None], size_m - typical_m, 0.0)
    # Of drones that always look the same to the last bit, a thousandth of a millimetre is still not trusted.
    usual_m = np.maximum(1.4826 * np.median(np.abs(off_m[known]), axis=0), 1e-6)
    off_m = np.clip(off_m, -_FARTHEST * usual_m, _FARTHEST * usual_m)
    shift_m = off_m.sum(axis=0) / known.sum(axis=0)[:, None]
    off_m = np.where(known[..., None], off_m - shift_m, 0.0)

    stretch = np.floor((time_s - time_s[0]) / _STRETCH_S).astype(np.int64)
    counts = np.zeros((stretch[-1] + 1, known.shape[1]))
    np.add.at(counts, stretch, known)
    sums_m = np.zeros((*counts.shape, 3))
    np.add.at(sums_m, stretch, off_m)
    # Stretches that are hardly seen scatter more, and would pass for what all do.
    full = counts > 0.5 * counts.max()
    number = full.sum(axis=0)
    if number.sum() < _MIN_STRETCHES or number.min() < _MIN_STRETCHES_EACH:
        return None
    means_m = sums_m[full] / counts[full][:, None]
    within_m2 = off_m[known].T @ off_m[known] / known.sum() + 1e-12 * np.eye(3)
    # One number for all axes: of a few stretches no whole matrix can be learned.
    squares = np.einsum("si,is->", means_m, np.linalg.solve(within_m2, means_m.T))
    share = squares / (3 * (number.sum() - len(number)))
    precision_m2 = np.linalg.inv((1 + counts[full].mean() * share) * within_m2)
    return Likeness(_shrunk(typical_m + shift_m, share * within_m2, number), precision_m2)


def _shrunk(
    typical_m: Float[np.ndarray, "drones 3"],
    between_m2: Float[np.ndarray, "3 3"],
    number: Int[np.ndarray, "drones"],
) -> Float[np.ndarray, "drones 3"]:
    """Sizes drawn in to their mean, all the way if they differ by no more than chance.

    Args:
        between_m2: covariance of the mean of a stretch.
        number: (drones,), of stretches.
    """
    mean_m = np.average(typical_m, axis=0, weights=number)
    apart_m = typical_m - mean_m
    found = (number * np.einsum("di,id->d", apart_m, np.linalg.solve(between_m2, apart_m.T))).sum()
    by_chance = _CHANCE * 3 * (len(number) - 1)
    return mean_m + apart_m * (1 - by_chance / max(found, by_chance))


def log_likelihood(
    likeness: Likeness | None, size_m: Float[np.ndarray, "drones 3"], clear: Bool[np.ndarray, "drones"]
) -> Float[np.ndarray, "drones drones"]:
    """(drones, tracks), of the size of each track if it is that drone; up to a constant, and 0 where nothing is said.

    Args:
        size_m: (tracks, 3), of one frame; NaN where not known.
        clear: (tracks,), whether the size is to be trusted.
    """
    if likeness is None:
        return np.zeros((len(size_m),) * 2)
    clear = clear & np.isfinite(size_m).all(axis=-1)
    off_m = np.where(clear[:, None], size_m - likeness.typical_m[:, None], 0.0)
    distance = np.einsum("dti,ij,dtj->dt", off_m, likeness.precision_m2, off_m)
    return -(_TAIL + 3) / 2 * np.log1p(distance / _TAIL)
