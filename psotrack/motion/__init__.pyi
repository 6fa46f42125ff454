from .kalman import GATE_999, Covariances, MotionParams, MotionState
from .params import motion_params
from .smoothing import check_measurements, estimate_jerk_density, filter_measurements, smooth
from .white_jerk import white_jerk_noise

__all__ = [
    "GATE_999",
    "Covariances",
    "MotionParams",
    "MotionState",
    "check_measurements",
    "estimate_jerk_density",
    "filter_measurements",
    "motion_params",
    "smooth",
    "white_jerk_noise",
]
