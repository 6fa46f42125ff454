"""Ornstein-Uhlenbeck process: probability density of a drone's state after a gap in which it was not seen.

Method: G. E. Uhlenbeck, L. S. Ornstein, On the theory of the Brownian motion, Physical Review 36, 1930. The velocity
returns to 0 on average. After a short gap the drone is expected on its course, after a long gap anywhere in the room.
The walls of the room reflect the drone.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

#: Time constant of the velocity, seconds: after this time the last velocity says little about the position.
VELOCITY_TIME_S = 1.0
#: Standard deviations of measured positions and velocities along each axis.
POSITION_STD_M, VELOCITY_STD_M_S = 0.1, 0.3
#: Number of reflected images of the room on either side; a drone that is reflected more often may be anywhere.
NUM_WALLS = 3

#: Position (metres) and velocity (metres per second).
Motion = Float[np.ndarray, "2 3"]


def log_transition(
    before: Motion, after: Motion, gap_s: float, variance: float, bounds_m: Float[np.ndarray, "2 3"]
) -> float:
    """Log density of a measured state after a gap, over position and velocity.

    Args:
        before, after: (2, 3), measured positions and velocities, in the room.
        gap_s: time between them, at least 0.
        variance: stationary variance of the velocity along each axis, m2/s2.
        bounds_m: (2, 3), corners of the room.
    """
    time = VELOCITY_TIME_S
    decay = np.exp(-gap_s / time)
    transition = np.array([[1.0, time * (1 - decay)], [0.0, decay]])
    process = variance * np.array(
        [
            [time**2 * (2 * gap_s / time - 3 + 4 * decay - decay**2), time * (1 - decay) ** 2],
            [time * (1 - decay) ** 2, 1 - decay**2],
        ]
    )
    measured = np.diag([POSITION_STD_M**2, VELOCITY_STD_M_S**2])
    covariance = transition @ measured @ transition.T + process + measured
    error = _reflect(after, bounds_m) - (transition @ before)[:, None]
    distance2 = np.einsum("iwa,ij,jwa->wa", error, np.linalg.inv(covariance), error)
    per_axis = logsumexp(-distance2 / 2, axis=0)
    return float(per_axis.sum() - 3 * np.log(np.linalg.det(2 * np.pi * covariance)) / 2)


def log_normal(value: Float[np.ndarray, "dims"], variance: float) -> float:
    """Log density of a Gaussian with mean 0 and the same variance along each axis."""
    return float(-(value @ value / variance + len(value) * np.log(2 * np.pi * variance)) / 2)


def _reflect(motion: Motion, bounds_m: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 images 3"]:
    """Position and velocity along each axis, and their images after reflections at the walls."""
    (place, velocity), (low, high) = motion, bounds_m
    away = 2 * (high - low) * np.arange(-NUM_WALLS, NUM_WALLS + 1)[:, None]
    places = np.concatenate([place + away, 2 * low - place + away])
    return np.stack([places, np.repeat([velocity, -velocity], len(away), axis=0)])
