from .agreement import Agreement
from .checked_adjustment import CheckedAdjustment, improve_with_check
from .examination import Diagnosis, examine, sampled_frames

__all__ = [
    "Agreement",
    "CheckedAdjustment",
    "Diagnosis",
    "examine",
    "improve_with_check",
    "sampled_frames",
]
