from .least_squares import (
    Damping,
    NormalEquations,
    ReducedEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    covariance_from_information,
    gauss_newton,
    levenberg_marquardt,
)
from .rauch_tung_striebel import backward_step

__all__ = [
    "Damping",
    "NormalEquations",
    "ReducedEquations",
    "Step",
    "backward_step",
    "cauchy_loss",
    "cauchy_weight",
    "covariance_from_information",
    "gauss_newton",
    "levenberg_marquardt",
]
