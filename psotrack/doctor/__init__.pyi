from .agreement import Agreement
from .examination import Diagnosis, examine, sampled_frames

__all__ = [
    "Agreement",
    "Diagnosis",
    "examine",
    "sampled_frames",
]
