from .consistency import INSIDE_90
from .metrics import evaluate
from .over_time import errors_over_time
from .records import DroneEvaluation, ErrorSummary, Evaluation

__all__ = [
    "INSIDE_90",
    "DroneEvaluation",
    "ErrorSummary",
    "Evaluation",
    "errors_over_time",
    "evaluate",
]
