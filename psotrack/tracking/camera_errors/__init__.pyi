from .changes import ClockStep, Knock, find_change
from .constant_errors import ConstantErrors, fit_constant_errors
from .covariances import (
    MeasurementErrors,
    SystematicCovariances,
    filtered_variances,
    noise_covariance,
    noise_ratios,
    systematic_covariances,
)
from .learning import Autocorrelation, CameraErrors, autocorrelation_of, learn_camera_errors
from .tracks import TrackErrors, with_camera_errors
from .variance_components import FittedPlaces, camera_variances
from .views import CameraViews, views_of_places, with_nearest_sightings

__all__ = [
    "Autocorrelation",
    "CameraErrors",
    "CameraViews",
    "ClockStep",
    "ConstantErrors",
    "FittedPlaces",
    "Knock",
    "MeasurementErrors",
    "SystematicCovariances",
    "TrackErrors",
    "autocorrelation_of",
    "camera_variances",
    "filtered_variances",
    "find_change",
    "fit_constant_errors",
    "learn_camera_errors",
    "noise_covariance",
    "noise_ratios",
    "systematic_covariances",
    "views_of_places",
    "with_camera_errors",
    "with_nearest_sightings",
]
