"""Parameters of the motion model, from the settings."""

from __future__ import annotations

import jax.numpy as jnp

from psotrack.motion.kalman import MotionParams
from psotrack.settings import MotionSettings


def motion_params(settings: MotionSettings, num_drones: int) -> MotionParams:
    """Parameters of the motion model for `num_drones` drones, as float32 arrays."""
    return MotionParams(
        jerk_density_m2_s5=jnp.full(num_drones, settings.jerk_density, jnp.float32),
        velocity_std_m_s=jnp.float32(settings.velocity_std_m_s),
        acceleration_std_m_s2=jnp.float32(settings.acceleration_std_m_s2),
        error_share=jnp.float32(settings.error_share),
        error_time_s=jnp.float32(settings.error_time_s),
    )
