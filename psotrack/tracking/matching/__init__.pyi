from .assignment import SEPARATION_M
from .crossings import Crossings, Expected, Measurement, crossings
from .explained import are_near
from .groups import NEW_GROUP_COST, SHARED_COST, UNEXPLAINED_COST
from .matching import Matches, match, wide_bounds
from .proposals import epipolar_distance
from .sightings import (
    BORDER_PX,
    CUT_SHARE,
    NOISE_PX,
    NOISE_SHARE,
    Sightings,
    by_image,
    from_boxes,
    from_detections,
    from_silhouettes,
    moved_to_instant,
)
from .straightened import straightened

__all__ = [
    "BORDER_PX",
    "CUT_SHARE",
    "NEW_GROUP_COST",
    "NOISE_PX",
    "NOISE_SHARE",
    "SEPARATION_M",
    "SHARED_COST",
    "UNEXPLAINED_COST",
    "Crossings",
    "Expected",
    "Matches",
    "Measurement",
    "Sightings",
    "are_near",
    "by_image",
    "crossings",
    "epipolar_distance",
    "from_boxes",
    "from_detections",
    "from_silhouettes",
    "match",
    "moved_to_instant",
    "straightened",
    "wide_bounds",
]
