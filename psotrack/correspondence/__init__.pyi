from .epipolar import epipolar_distance
from .groups import NEW, SHARED, UNEXPLAINED
from .matching import Matches, match
from .packing import SEPARATION_M
from .sightings import (
    BORDER_PX,
    CUT_SHARE,
    NOISE_PX,
    NOISE_SHARE,
    CameraSightings,
    Sightings,
    from_detections,
    from_silhouettes,
)

__all__ = [
    "BORDER_PX",
    "CUT_SHARE",
    "NEW",
    "NOISE_PX",
    "NOISE_SHARE",
    "SEPARATION_M",
    "SHARED",
    "UNEXPLAINED",
    "CameraSightings",
    "Matches",
    "Sightings",
    "epipolar_distance",
    "from_detections",
    "from_silhouettes",
    "match",
]
