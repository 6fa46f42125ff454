from .building import BuiltMap, build_map, complete_map, corners_in_own_frame
from .checking import MapCheck, check_map
from .sightings import find_sightings

__all__ = [
    "BuiltMap",
    "MapCheck",
    "build_map",
    "check_map",
    "complete_map",
    "corners_in_own_frame",
    "find_sightings",
]
