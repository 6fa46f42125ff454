"""Samples of a position to a curve that can be derived twice, whose second derivative the attitude follows from.

The curve is a quintic spline. Through clean samples it goes exactly. Noise that would become wild accelerations is
smoothed away: then it is fitted by least squares with a knot every quarter of a second, which passes what a multirotor
can do, motions up to about 2 Hz, and nothing faster.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline

_DEGREE = 5
#: A quintic spline goes through no fewer.
MIN_SAMPLES = _DEGREE + 1
#: Accelerations as wrong as this tilt a drone by 3 degrees; noise that makes them is smoothed.
_NOISE_M_S2 = 0.5
#: The second derivative of a quintic spline through white noise, times the spacing squared, over the noise (simulated).
_NOISE_GAIN = 3.84
_KNOT_S = 0.25
_SAMPLES_PER_KNOT = 3

Samples = Float[np.ndarray, "samples"]
Positions = Float[np.ndarray, "samples 3"]


def spline(time_s: Samples, position_m: Positions) -> BSpline:
    """A quintic spline through samples, or, where they are noisy, near them.

    Args:
        time_s: increasing, at least `MIN_SAMPLES`.
        position_m: world.

    Returns:
        The position over time, (times, 3).
    """
    # The shortest: two samples of one moment that disagree are the worst.
    spacing_s = float(np.diff(time_s).min())
    if _NOISE_GAIN * _noise_m(time_s, position_m) / spacing_s**2 <= _NOISE_M_S2:
        return make_interp_spline(time_s, position_m, k=_DEGREE)
    first, last = (np.repeat(end, _DEGREE + 1) for end in (time_s[0], time_s[-1]))
    return make_lsq_spline(time_s, position_m, np.concatenate([first, _knots_s(time_s), last]), k=_DEGREE)


def _noise_m(time_s: Samples, position_m: Positions) -> float:
    """Standard deviation per axis of what a sample's six neighbours, by the quintic through them, do not explain."""
    if len(time_s) <= MIN_SAMPLES:
        return 0.0
    window_s = np.lib.stride_tricks.sliding_window_view(time_s, 7)
    window_m = np.lib.stride_tricks.sliding_window_view(position_m, 7, axis=0)
    here_s, others = window_s[:, 3], [0, 1, 2, 4, 5, 6]
    weights = np.zeros_like(window_s)
    weights[:, 3] = -1.0
    for j in others:
        rest_s = window_s[:, [m for m in others if m != j]]
        # Lagrange's polynomials, at the time of the sample in the middle.
        weights[:, j] = np.prod((here_s[:, None] - rest_s) / (window_s[:, j, None] - rest_s), axis=1)
    residual_m = np.einsum("nj,naj->na", weights, window_m) / np.linalg.norm(weights, axis=1, keepdims=True)
    # The median, because a person at the sticks makes jerks, which are few and no noise; 0.6745 is a Gaussian's.
    return float(np.median(np.abs(residual_m), axis=0).max()) / 0.6745


def _knots_s(time_s: Samples) -> Float[np.ndarray, "knots"]:
    """Samples' times, some time and some samples apart, so that least squares have one solution."""
    knots: list[int] = []
    index = 0
    while True:
        index = max(int(np.searchsorted(time_s, time_s[index] + _KNOT_S)), index + _SAMPLES_PER_KNOT)
        if index + _SAMPLES_PER_KNOT >= len(time_s):
            break
        knots.append(index)
    # Twice as far from the ends: what is one-sided there takes noise for acceleration five times as easily.
    knots = knots[1:-1]
    return time_s[knots if len(knots) + MIN_SAMPLES <= len(time_s) else []]
