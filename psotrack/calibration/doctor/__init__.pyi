from .diagnosis import Diagnosis
from .examination import examine, sampled_frames
from .findings import Finding

__all__ = [
    "Diagnosis",
    "Finding",
    "examine",
    "sampled_frames",
]
