from .c3d import Markers, read_c3d, write_c3d
from .marker_bodies import MarkerBodies, marker_bodies
from .marker_groups import NoDronesError

__all__ = [
    "MarkerBodies",
    "Markers",
    "NoDronesError",
    "marker_bodies",
    "read_c3d",
    "write_c3d",
]
