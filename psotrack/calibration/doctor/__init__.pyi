from .agreement import Agreement
from .diagnosis import Diagnosis
from .examination import examine, sampled_frames
from .findings import Finding

__all__ = [
    "Agreement",
    "Diagnosis",
    "Finding",
    "examine",
    "sampled_frames",
]
