from .metrics import errors_over_time, evaluate
from .offsets import Offset, find_offset
from .path_comparison import PathComparison, PathSettings, Statistics, compare_paths, drone_of
from .scores import INSIDE_90
from .tables import DroneEvaluation, ErrorSummary, Evaluation

__all__ = [
    "INSIDE_90",
    "DroneEvaluation",
    "ErrorSummary",
    "Evaluation",
    "Offset",
    "PathComparison",
    "PathSettings",
    "Statistics",
    "compare_paths",
    "drone_of",
    "errors_over_time",
    "evaluate",
    "find_offset",
]
