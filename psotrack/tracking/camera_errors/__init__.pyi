from .constant_errors import ConstantErrors, fit_constant_errors
from .covariances import (
    LastingCovariances,
    MeasurementErrors,
    filtered_variances,
    lasting_covariances,
    noise_covariance,
    noise_ratios,
)
from .learning import CameraErrors, Fading, fading_of, learn_camera_errors
from .tracks import TrackErrors, with_camera_errors
from .variance_components import FittedPlaces, camera_variances
from .views import CameraViews, views_of_middles, views_of_places, views_of_sightings

__all__ = [
    "CameraErrors",
    "CameraViews",
    "ConstantErrors",
    "Fading",
    "FittedPlaces",
    "LastingCovariances",
    "MeasurementErrors",
    "TrackErrors",
    "camera_variances",
    "fading_of",
    "filtered_variances",
    "fit_constant_errors",
    "lasting_covariances",
    "learn_camera_errors",
    "noise_covariance",
    "noise_ratios",
    "views_of_middles",
    "views_of_places",
    "views_of_sightings",
    "with_camera_errors",
]
