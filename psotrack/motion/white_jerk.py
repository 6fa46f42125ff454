"""Process noise of a motion whose jerk is white noise, for NumPy and for JAX."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack._typing import Array


def white_jerk_noise(dt_s: float | Float[Array, ""]) -> Float[Array, "3 3"]:
    """(3, 3), covariance of position, velocity and acceleration along one axis after `dt_s` of unit white jerk.

    The integral over s from 0 to dt of g gᵀ with g = (s² / 2, s, 1): Bar-Shalom et al. 2001, section 6.2.3. Its lower
    right (2, 2) block is the noise of an angle and its rate under unit white angular acceleration.
    """
    xp = np if isinstance(dt_s, float | np.ndarray) else jnp
    one, two, three, four, five = (dt_s**power / divisor for power, divisor in enumerate((1, 2, 6, 8, 20), 1))
    return xp.stack(
        [xp.stack([five, four, three]), xp.stack([four, 2 * three, two]), xp.stack([three, two, one])]
    )
