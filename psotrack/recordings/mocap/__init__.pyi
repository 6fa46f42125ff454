from .c3d import Markers, read_c3d, write_c3d
from .marker_bodies import NoDronesError, marker_bodies

__all__ = [
    "Markers",
    "NoDronesError",
    "marker_bodies",
    "read_c3d",
    "write_c3d",
]
