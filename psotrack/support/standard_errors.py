"""Standard errors of estimates from samples whose errors are correlated in time, by the block jackknife."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from scipy.special import stdtrit

#: Two-sided probability of a normal distribution outside of two standard deviations.
_OUTSIDE_TWO_STD = 0.0455
#: Number of stretches of time of each body, and smallest number of blocks. Measured on clocks of simulated flights of
#: two drones: with errors that turn with the drones, 3, 4 and 6 stretches hold 0.87, 0.82 and 0.73 of the truths in
#: 90 % intervals.
_STRETCHES, _LEAST_BLOCKS = 3, 6
#: Number of blocks of a mean over time.
_MEAN_BLOCKS = 20


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


def time_blocks(
    there: Bool[np.ndarray, "frames bodies"], num_stretches: int | None = None
) -> Int[np.ndarray, "frames bodies"]:
    """The block of each sample, for `block_jackknife`: one body in one of a few stretches of time.

    A stretch must be longer than errors are correlated. Errors that turn with a body, or that belong to its shape, last
    as long as the recording: they are seen in the differences between bodies.

    Args:
        there: (frames, bodies), whether a body has a sample in a frame.
        num_stretches: number of stretches, of about as many frames each; None: 3, or 6 blocks at least.

    Returns:
        (frames, bodies), number of the block from 0; -1 where there is no sample.
    """
    (_, bodies), some = there.shape, there.any(axis=1)
    count = int(some.sum())
    wanted = max(_STRETCHES, -(-_LEAST_BLOCKS // max(bodies, 1))) if num_stretches is None else num_stretches
    # A stretch has at least two frames, except that there are always two stretches.
    stretches = min(wanted, max(2, count // 2))
    stretch = (np.cumsum(some) - 1) * stretches // max(count, 1)
    return np.where(there, stretch[:, None] * bodies + np.arange(bodies), -1)


def standard_error(values: Float[np.ndarray, "frames parts"]) -> Float[np.ndarray, "parts"]:
    """Standard error of the mean of each column over frames, of which neighbouring ones are correlated.

    Args:
        values: (frames, parts), in the order of time; rows with a NaN are left out.

    Returns:
        (parts,), in the unit of the values; NaN for fewer than two rows without NaN.
    """
    known = values[np.isfinite(values).all(axis=-1)]
    if len(known) < 2:
        return np.full(values.shape[1], np.nan)
    block = time_blocks(np.ones((len(known), 1), bool), _MEAN_BLOCKS)[:, 0]
    size = np.bincount(block)[:, None]
    total = np.zeros((len(size), values.shape[1]))
    np.add.at(total, block, known)
    left_out = (known.sum(axis=0) - total) / (len(known) - size)
    return np.sqrt(np.diag(block_jackknife(known.mean(axis=0), left_out, size[:, 0])))
