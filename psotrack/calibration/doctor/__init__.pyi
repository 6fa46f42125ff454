from .agreement import Agreement
from .checked_adjustment import CheckedAdjustment, improve_with_check
from .diagnosis import Diagnosis
from .examination import examine, sampled_frames
from .findings import Finding

__all__ = [
    "Agreement",
    "CheckedAdjustment",
    "Diagnosis",
    "Finding",
    "examine",
    "improve_with_check",
    "sampled_frames",
]
