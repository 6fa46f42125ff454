"""Quintic splines through position samples; the attitude follows from the spline's second derivative.

The spline passes exactly through samples with little noise. Noise that would cause large accelerations is smoothed: the
spline is then fitted by least squares with a knot every quarter of a second, which keeps the motions that a multirotor
can make, up to about 2 Hz, and removes faster ones.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline

_DEGREE = 5
#: Smallest number of samples for a quintic spline.
MIN_SAMPLES = _DEGREE + 1
#: Largest noise of the acceleration without smoothing; it tilts a drone by 3 degrees.
_NOISE_M_S2 = 0.5
#: Standard deviation of the second derivative of a quintic spline through white noise, times the squared spacing,
#: divided by the standard deviation of the noise; found by simulation.
_NOISE_GAIN = 3.84
#: Smallest time, and smallest number of samples, between two knots.
_KNOT_S = 0.25
_SAMPLES_PER_KNOT = 3

Samples = Float[np.ndarray, "samples"]
Positions = Float[np.ndarray, "samples 3"]


def spline(time_s: Samples, position_m: Positions) -> BSpline:
    """Quintic spline through samples, or near samples with noise.

    Args:
        time_s: (samples,), increasing times of at least `MIN_SAMPLES` samples.
        position_m: (samples, 3), world.

    Returns:
        Position over time, (times, 3).
    """
    # The shortest spacing, because two nearly simultaneous samples that differ give the largest acceleration.
    spacing_s = float(np.diff(time_s).min())
    if _NOISE_GAIN * _noise_m(time_s, position_m) / spacing_s**2 <= _NOISE_M_S2:
        return make_interp_spline(time_s, position_m, k=_DEGREE)
    first, last = (np.repeat(end, _DEGREE + 1) for end in (time_s[0], time_s[-1]))
    return make_lsq_spline(time_s, position_m, np.concatenate([first, _knots_s(time_s), last]), k=_DEGREE)


def _noise_m(time_s: Samples, position_m: Positions) -> float:
    """Standard deviation, along the worst axis, of the samples' differences from the quintic through six neighbours."""
    if len(time_s) <= MIN_SAMPLES:
        return 0.0
    window_s = np.lib.stride_tricks.sliding_window_view(time_s, 7)
    window_m = np.lib.stride_tricks.sliding_window_view(position_m, 7, axis=0)
    here_s, others = window_s[:, 3], [0, 1, 2, 4, 5, 6]
    weights = np.zeros_like(window_s)
    weights[:, 3] = -1.0
    for j in others:
        rest_s = window_s[:, [m for m in others if m != j]]
        # Lagrange polynomials at the time of the middle sample.
        weights[:, j] = np.prod((here_s[:, None] - rest_s) / (window_s[:, j, None] - rest_s), axis=1)
    residual_m = np.einsum("nj,naj->na", weights, window_m) / np.linalg.norm(weights, axis=1, keepdims=True)
    # The median ignores the few jerks of a person at the sticks, which are no noise. The median of the absolute value
    # of a Gaussian is 0.6745 standard deviations.
    return float(np.median(np.abs(residual_m), axis=0).max()) / 0.6745


def _knots_s(time_s: Samples) -> Float[np.ndarray, "knots"]:
    """(knots,), sample times with `_KNOT_S` and `_SAMPLES_PER_KNOT` between them, so that the fit is unique."""
    knots: list[int] = []
    index = 0
    while True:
        index = max(int(np.searchsorted(time_s, time_s[index] + _KNOT_S)), index + _SAMPLES_PER_KNOT)
        if index + _SAMPLES_PER_KNOT >= len(time_s):
            break
        knots.append(index)
    # The first and last interval are twice as long: with samples on one side only, the noise of the acceleration would
    # be five times as large there.
    knots = knots[1:-1]
    return time_s[knots if len(knots) + MIN_SAMPLES <= len(time_s) else []]
