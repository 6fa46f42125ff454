from .kalman import GATE_999, Covariances, MotionParams, MotionState
from .smoothing import check_measurements, forward, jerk_density, smooth

__all__ = [
    "GATE_999",
    "Covariances",
    "MotionParams",
    "MotionState",
    "check_measurements",
    "forward",
    "jerk_density",
    "smooth",
]
