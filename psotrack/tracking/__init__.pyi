from .chunks import Arrival, Tracked, on_device, track_silhouettes
from .fitness import ScoreSettings
from .inputs import motion_params
from .sizes import SizeMeasurements, SizeState, init
from .tracker import COMMON, DISPERSION_FRAMES, TrackerInfo

__all__ = [
    "COMMON",
    "DISPERSION_FRAMES",
    "Arrival",
    "ScoreSettings",
    "SizeMeasurements",
    "SizeState",
    "Tracked",
    "TrackerInfo",
    "init",
    "motion_params",
    "on_device",
    "track_silhouettes",
]
