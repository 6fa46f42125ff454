"""Where a drone may be that was not seen for a while, and how fast: its velocity wanders about 0, between walls.

Method: G. E. Uhlenbeck, L. S. Ornstein, On the theory of the Brownian motion, Physical Review 36, 1930. Over a short
gap the drone is expected where it was heading, over a long one it is anywhere in the room.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

#: Drones change their velocity within about this time; after it the last one says little of where they are.
VELOCITY_TIME_S = 1.0
#: How well places and velocities are measured, along each axis.
POSITION_STD_M, VELOCITY_STD_M_S = 0.1, 0.3
#: Images of the room to either side: after so many the drone may be anywhere.
NUM_WALLS = 3

#: Position (metres) and velocity (metres per second).
Motion = Float[np.ndarray, "2 3"]


def log_wandered(
    was: Motion, seen: Motion, gap_s: float, variance: float, bounds_m: Float[np.ndarray, "2 3"]
) -> float:
    """Log density, over position and velocity, of what is seen after a gap.

    The drone turns at the walls: what would be beyond them is mirrored into the room.

    Args:
        was, seen: (2, 3), position and velocity, in the room.
        gap_s: between them, from 0.
        variance: of the velocity along each axis, m2/s2, in the long run.
        bounds_m: (2, 3), corners of the room.
    """
    time = VELOCITY_TIME_S
    left = np.exp(-gap_s / time)
    to = np.array([[1.0, time * (1 - left)], [0.0, left]])
    wandered = variance * np.array(
        [
            [time**2 * (2 * gap_s / time - 3 + 4 * left - left**2), time * (1 - left) ** 2],
            [time * (1 - left) ** 2, 1 - left**2],
        ]
    )
    measured = np.diag([POSITION_STD_M**2, VELOCITY_STD_M_S**2])
    covariance = to @ measured @ to.T + wandered + measured
    error = _mirrored(seen, bounds_m) - (to @ was)[:, None]
    distance2 = np.einsum("iwa,ij,jwa->wa", error, np.linalg.inv(covariance), error)
    of_axes = logsumexp(-distance2 / 2, axis=0)
    return float(of_axes.sum() - 3 * np.log(np.linalg.det(2 * np.pi * covariance)) / 2)


def log_normal(value: Float[np.ndarray, "dims"], variance: float) -> float:
    """Log density of a Gaussian about 0, of the same variance along each axis."""
    return float(-(value @ value / variance + len(value) * np.log(2 * np.pi * variance)) / 2)


def _mirrored(motion: Motion, bounds_m: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 images 3"]:
    """Place and velocity along each axis, and their images in the walls, the walls' images, and so on."""
    (place, velocity), (low, high) = motion, bounds_m
    away = 2 * (high - low) * np.arange(-NUM_WALLS, NUM_WALLS + 1)[:, None]
    places = np.concatenate([place + away, 2 * low - place + away])
    return np.stack([places, np.repeat([velocity, -velocity], len(away), axis=0)])
