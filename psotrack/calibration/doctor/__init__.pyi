from .diagnosis import Diagnosis, Finding
from .examination import examine, sampled_frames

__all__ = [
    "Diagnosis",
    "Finding",
    "examine",
    "sampled_frames",
]
