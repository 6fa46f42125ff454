"""Judging tracks by a reference. Sees trajectories only, so every method is judged by the same lines.

`evaluate` gives the numbers, `errors_over_time` those of every frame; `tables` and `plots` show them.
"""

from psotrack.evaluation.metrics import evaluate
from psotrack.evaluation.over_time import errors_over_time
from psotrack.evaluation.records import DroneEvaluation, ErrorSummary, Evaluation

__all__ = ["DroneEvaluation", "ErrorSummary", "Evaluation", "errors_over_time", "evaluate"]
