"""The variance of a filtered position when the errors of the measurements are other than the filter assumes.

The filter of `psotrack.tracking.motion` assumes how much of the measurements' variance lasts, and for how long.
Recordings differ, and what the errors of a recording are like is known only when all of it has been seen. Here the
filter keeps its gain, and the variance of its error follows from the errors that were found (the Lyapunov equation of
the joint error of state and filter; A. Gelb, Applied Optimal Estimation, 1974, section 7.2). One axis is enough,
because the filter treats the axes alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.tracking.motion import white_jerk_noise

#: Largest number of frames until the filter's covariance has settled.
_MAX_FRAMES = 2000
#: The filter has settled when its variance changes by less than this share per frame.
_SETTLED = 1e-6


@dataclass(frozen=True)
class MeasurementErrors:
    """Errors of measured positions along one axis.

    Attributes:
        variance_m2: variance, m².
        fading_share: share of the variance that fades exponentially; the rest is white.
        time_s: time constant of the fading errors, seconds.
    """

    variance_m2: float
    fading_share: float
    time_s: float


def filtered_variances(
    assumed: MeasurementErrors, found: MeasurementErrors, *, dt_s: float, jerk_density_m2_s5: float
) -> tuple[float, float]:
    """Variance of the filtered position as the filter states it, and as it is with the errors that were found, m².

    Args:
        assumed: errors that the filter assumes.
        found: errors of the measurements.
        dt_s: time between frames, seconds.
        jerk_density_m2_s5: spectral density of the white jerk.
    """
    F = np.eye(4)
    F[:3, :3] += np.array([[0, dt_s, dt_s**2 / 2], [0, 0, dt_s], [0, 0, 0]])
    F[3, 3] = np.exp(-dt_s / assumed.time_s)
    motion_noise = np.zeros((4, 4))
    motion_noise[:3, :3] = jerk_density_m2_s5 * white_jerk_noise(float(dt_s))
    fading_m2 = assumed.fading_share * assumed.variance_m2
    noise = motion_noise + np.diag([0, 0, 0, fading_m2 * (1 - F[3, 3] ** 2)])
    # A measurement is the position plus the fading error plus white noise.
    H = np.array([1.0, 0.0, 0.0, 1.0])
    white_m2 = (1 - assumed.fading_share) * assumed.variance_m2
    P, gain = np.diag([assumed.variance_m2, 1.0, 1.0, fading_m2]), np.zeros(4)
    stated_m2 = np.inf
    for _ in range(_MAX_FRAMES):
        P = F @ P @ F.T + noise
        gain = P @ H / (H @ P @ H + white_m2)
        P = (np.eye(4) - np.outer(gain, H)) @ P
        P = (P + P.T) / 2
        if abs(P[0, 0] - stated_m2) < _SETTLED * P[0, 0]:
            break
        stated_m2 = P[0, 0]
    return float(P[0, 0]), _real_variance(F, motion_noise, gain, found, dt_s)


def _real_variance(
    F: Float[np.ndarray, "4 4"],
    motion_noise: Float[np.ndarray, "4 4"],
    gain: Float[np.ndarray, "4"],
    found: MeasurementErrors,
    dt_s: float,
) -> float:
    """Variance of the filtered position's error with a fixed gain."""
    # State: true minus estimated position, velocity, acceleration; the filter's fading error; the real fading error.
    decay = np.exp(-dt_s / found.time_s)
    ahead = np.zeros((5, 5))
    ahead[:4, :4], ahead[4, 4] = F, decay
    fading_m2 = found.fading_share * found.variance_m2
    noise = np.zeros((5, 5))
    noise[:4, :4] = motion_noise
    noise[4, 4] = fading_m2 * (1 - decay**2)
    # Innovation: error of the position + real fading error - the filter's fading error + white noise.
    innovation = np.array([1.0, 0.0, 0.0, -1.0, 1.0])
    corrects = np.array([-gain[0], -gain[1], -gain[2], gain[3], 0.0])
    correct = np.eye(5) + np.outer(corrects, innovation)
    white_m2 = (1 - found.fading_share) * found.variance_m2
    step = correct @ ahead
    driven = correct @ noise @ correct.T + white_m2 * np.outer(corrects, corrects)
    # X = step X stepᵀ + driven, as linear equations.
    solved = np.linalg.solve(np.eye(25) - np.kron(step, step), driven.ravel())
    return float(solved[0])
