from .least_squares import (
    NormalEquations,
    ReducedEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    covariance_from_information,
    levenberg_marquardt,
)
from .rauch_tung_striebel import backward_step

__all__ = [
    "NormalEquations",
    "ReducedEquations",
    "Step",
    "backward_step",
    "cauchy_loss",
    "cauchy_weight",
    "covariance_from_information",
    "levenberg_marquardt",
]
