"""Error models of two sources of positions: scales of their stated covariances, and how long their errors last.

The covariances that a source states may be too small or too large, and do not say how long errors last. The two sources
share no errors. Their difference therefore contains no motion, has the sum of their variances, and its change over
time shows how long errors last. Noise that is new in every frame is estimated from each source's own scatter. The
smoothness of a track shows nothing else: the output of a smoother is smooth, whether right or wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.special import gammaincinv

from psotrack.inside_out.fusing.joint_filter import (
    OUTSIDE,
    Arm,
    ErrorModel,
    Readings,
    log_likelihood,
    select_frames,
)

#: Median of the chi-square distribution with 3 degrees of freedom.
CHI2_3_MEDIAN = 2.0 * float(gammaincinv(3 / 2, 0.5))

#: Number of frames from which the jerk density is estimated; more frames only take longer.
_MOST_FRAMES = 500
#: Decimal logarithms of the jerk densities that are tried first, and the steps of the same number of values about the
#: best one.
_JERK_DECADES, _FINER = np.arange(-3.0, 6.0), 0.25
#: Values before any estimation: share of the variance that lasts, its duration (s), and the drone's jerk density.
_LASTING, _LASTING_S, _JERK_M2_S5 = 0.5, 0.4, 10.0
#: Shortest and longest duration of errors, and the time with both sources that is needed to estimate it, seconds.
_LEAST_S, _MOST_S, _LEAST_BOTH_S = 0.1, 5.0, 2.0
#: Prior standard deviations of logarithms: of the scale of both stated variances, of the ratio of the two scales, and
#: of this ratio where a source shows its own scatter. The differences determine only the sum of the variances.
_BOTH_PRIOR, _RATIO_PRIOR, _RATIO_SHOWN_PRIOR = 3.0, 0.5, 2.0
#: Smallest ratio of the lasting to the new variance, and smallest new share of a stated variance.
_LEAST_LASTING, _LEAST_WHITE = 0.1, 1e-6
#: Weights of fifth differences, which contain hardly any motion.
_FIFTH = np.array([-1.0, 5.0, -10.0, 10.0, -5.0, 1.0])
#: A source with independent frames has lasting errors about as large as its new ones, within a factor of e; exceptions
#: have the probability of e to the power of minus this.
_SURPRISE = 4.0
#: Share of the independent frames with which the differences count for the scales. The differences determine the sum of
#: the variances and seem to determine its parts better than they do, because stated covariances have wrong shapes too.
_TRUST = 0.25


def expected_model(scale: float) -> ErrorModel:
    """The model before any estimation, with variances that are `scale` times the stated ones."""
    shares = np.full((1, 2), scale)
    return ErrorModel(
        white=(1 - _LASTING) * shares,
        lasting=_LASTING * shares,
        time_s=np.full((1, 2), _LASTING_S),
        jerk_density_m2_s5=np.array([_JERK_M2_S5]),
    )


def fit_error_model(
    readings: Readings, difference_m: Float[np.ndarray, "frames 3"], arm: Arm
) -> tuple[Float[np.ndarray, "frames 2 3 3"], ErrorModel]:
    """Fit an error model, and correct the shape of the stated covariances.

    Args:
        readings: readings of both sources, partly in the same frames, without gross errors.
        difference_m: (frames, 3), outside less inside at the same time, without the arm, metres; NaN where either is
            unknown.
        arm: prior of the arm.

    Returns:
        (frames, 2, 3, 3), stated covariances with corrected shapes, m²; and the model, whose scales refer to them.
    """
    both = np.asarray(readings.known.all(axis=1))
    apart_m = np.where(both[:, None], difference_m, np.nan)
    step_s = float(np.median(np.diff(readings.time_s)))
    time_s, rounder, white = _LASTING_S, readings, np.zeros(2)
    # Twice, because the duration of errors determines how many frames are independent for the scales.
    for _ in range(2):
        independent = min(1.0, step_s / (2 * time_s))
        least, own = np.array([_white_noise(rounder, source) for source in (0, 1)]).T
        scales, roundness = _scales(apart_m, readings, least, own, independent)
        rounder = replace(readings, covariance_m2=_equalise_axes(readings.covariance_m2, roundness))
        white = np.minimum(least, (1 - _LEAST_LASTING) * scales)
        time_s = _lasting_s(apart_m, rounder, scales, white, step_s)
    model = ErrorModel(white[None], (scales - white)[None], np.full((1, 2), time_s), np.array([_JERK_M2_S5]))
    return rounder.covariance_m2, replace(
        model, jerk_density_m2_s5=_jerk(_densest_stretch(rounder), model, arm)
    )


def _white_noise(readings: Readings, source: int) -> tuple[float, float]:
    """Variance that is new in every frame, per stated variance, and the whiteness of a source's scatter, 0 to 1.

    Fifth differences of white noise are equally large between neighbouring and between every second frames. In the
    output of a filter the latter are much larger.
    """
    near, far = (_scatter(readings, source, step) for step in (1, 2))
    if near is None or far is None:
        return 1 - _LASTING, 0.0
    return near, min(near / far, 1.0)


def _scatter(readings: Readings, source: int, step: int) -> float | None:
    """Squared fifth differences of frames `step` apart, divided by their expected value; None without such frames."""
    known, time_s = readings.known[:, source], readings.time_s
    rows = np.arange(max(len(known) - 5 * step, 0))[:, None] + step * np.arange(6)
    steps_s = np.diff(time_s[rows], axis=1)
    evenly_spaced = (np.abs(steps_s - step * np.median(np.diff(time_s))) < 0.1 * steps_s).all(axis=1)
    rows = rows[known[rows].all(axis=1) & evenly_spaced]
    if not len(rows):
        return None
    fifth_m = np.einsum("r,fri->fi", _FIFTH, readings.position_m[rows, source])
    variance_m2 = np.einsum("r,frij->fij", _FIFTH**2, readings.covariance_m2[rows, source])
    # A lower limit, because no track is exact.
    return max(float(np.median(_normalised(fifth_m, variance_m2))) / CHI2_3_MEDIAN, _LEAST_WHITE)


def _scales(
    apart_m: Float[np.ndarray, "frames 3"],
    readings: Readings,
    white: Float[np.ndarray, "2"],
    whiteness: Float[np.ndarray, "2"],
    independent: float,
) -> tuple[Float[np.ndarray, "2"], float]:
    """(2,), factors on the stated variances, none less than the new variance; and roundness of the outside covariances.

    They maximise the posterior density, given the differences.
    """
    both = np.isfinite(apart_m).all(axis=1)
    stated_m2 = readings.covariance_m2[both]
    least = np.log(white)
    ratio_prior = _RATIO_PRIOR + (_RATIO_SHOWN_PRIOR - _RATIO_PRIOR) * float(whiteness.max())

    def cost(parts: Float[np.ndarray, "3"]) -> float:
        logs, roundness = parts[:2], float(parts[2])
        S = np.einsum("s,fsij->fij", np.exp(logs), _equalise_axes(stated_m2, roundness))
        misfit = _normalised(apart_m[both], S) + np.linalg.slogdet(S)[1]
        prior = (logs.mean() / _BOTH_PRIOR) ** 2 + (np.diff(logs)[0] / ratio_prior) ** 2
        lasting = np.log(np.maximum(np.expm1(np.maximum(logs - least, 0.0)), _LEAST_LASTING))
        prior -= 2 * np.log(np.exp(-(lasting**2) / 2) + np.exp(-_SURPRISE * whiteness)).sum()
        return float(_TRUST * independent * misfit.sum() + prior) / 2

    bounds = [*((low, max(low, 0.0) + 10.0) for low in least), (0.0, 1.0)]
    # There may be two minima: one where a source is as good as its scatter, one where it is as good as it states.
    begins = (np.maximum(least, 0.0), np.array([least[0] + np.log(2), max(least[1], 0.0)]))
    found = [minimize(cost, [*begin, 0.1], method="L-BFGS-B", bounds=bounds) for begin in begins]
    best = min(found, key=lambda one: one.fun).x
    return np.exp(best[:2]), float(best[2])


def _equalise_axes(
    covariance_m2: Float[np.ndarray, "frames 2 3 3"], roundness: float
) -> Float[np.ndarray, "frames 2 3 3"]:
    """Covariances; a share (`roundness`) of the outside-in covariance is made equal along all axes.

    Rays that cross well determine a point well, but the point is the middle of a silhouette, which moves in the body. A
    pose from markers of known position has no such error.
    """
    rounded_m2 = covariance_m2.copy()
    mean_m2 = np.trace(covariance_m2[:, OUTSIDE], axis1=1, axis2=2)[:, None, None] / 3
    rounded_m2[:, OUTSIDE] = (1 - roundness) * covariance_m2[:, OUTSIDE] + roundness * mean_m2 * np.eye(3)
    return rounded_m2


def _lasting_s(
    apart_m: Float[np.ndarray, "frames 3"],
    readings: Readings,
    scales: Float[np.ndarray, "2"],
    white: Float[np.ndarray, "2"],
    step_s: float,
) -> float:
    """Time in which the lasting part of the differences decays to 1 / e, seconds, by their autocorrelation."""
    S = np.einsum("s,fsij->fij", scales, readings.covariance_m2)
    whitened = np.linalg.solve(np.linalg.cholesky(S), apart_m[..., None])[..., 0]
    of_white = np.linalg.solve(S, np.einsum("s,fsij->fij", white, readings.covariance_m2))
    lasting = 1 - float(np.trace(of_white, axis1=1, axis2=2).mean()) / 3
    both = np.asarray(np.isfinite(whitened).all(axis=1))
    whitened[~both] = 0.0
    power = float((whitened**2).sum()) / max(int(both.sum()), 1)
    if both.sum() * step_s < _LEAST_BOTH_S or power == 0:
        return _LASTING_S
    most = min(round(_MOST_S / step_s), len(both) // 2)
    before = 1.0
    for lag in range(1, most + 1):
        pairs = int((both[lag:] & both[:-lag]).sum())
        if not pairs:
            continue
        correlation = (whitened[lag:] * whitened[:-lag]).sum() / pairs
        now = float(correlation) / power / lasting
        if now < np.exp(-1):
            part = (before - np.exp(-1)) / (before - now)
            return float(np.clip((lag - 1 + part) * step_s, _LEAST_S, _MOST_S))
        before = now
    return _MOST_S


def _jerk(readings: Readings, model: ErrorModel, arm: Arm) -> Float[np.ndarray, "1"]:
    """The jerk density that maximises the likelihood of the readings, with everything else known."""

    def scores(decades: Float[np.ndarray, "tried"]) -> Float[np.ndarray, "tried"]:
        parts = {
            name: np.repeat(getattr(model, name), len(decades), axis=0)
            for name in ("white", "lasting", "time_s")
        }
        return log_likelihood(readings, ErrorModel(**parts, jerk_density_m2_s5=10.0**decades), arm)

    best = _JERK_DECADES[np.argmax(scores(_JERK_DECADES))]
    around = best + _FINER * (np.arange(len(_JERK_DECADES)) - len(_JERK_DECADES) // 2)
    return 10.0 ** around[[np.argmax(scores(around))]]


def _normalised(
    vectors: Float[np.ndarray, "rows 3"], covariance: Float[np.ndarray, "rows 3 3"]
) -> Float[np.ndarray, "rows"]:
    return np.einsum("ri,ri->r", vectors, np.linalg.solve(covariance, vectors[..., None])[..., 0])


def _densest_stretch(readings: Readings) -> Readings:
    """The stretch of frames with the most readings."""
    readings_before = np.cumsum(np.pad(readings.known.sum(axis=1), (1, 0)))
    length = min(_MOST_FRAMES, len(readings.time_s))
    begin = int(np.argmax(readings_before[length:] - readings_before[: len(readings_before) - length]))
    return select_frames(readings, slice(begin, begin + length))
