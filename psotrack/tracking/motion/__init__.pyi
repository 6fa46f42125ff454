from .kalman import GATE_999, Covariances, MotionParams, MotionState, motion_params, white_jerk_noise
from .smoothing import (
    Measurements,
    Smoothed,
    estimate_jerk_density,
    filter_measurements,
    last_state,
    smooth,
)

__all__ = [
    "GATE_999",
    "Covariances",
    "Measurements",
    "MotionParams",
    "MotionState",
    "Smoothed",
    "estimate_jerk_density",
    "filter_measurements",
    "last_state",
    "motion_params",
    "smooth",
    "white_jerk_noise",
]
