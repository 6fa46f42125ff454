from .c3d import Markers, read_c3d, write_c3d
from .marker_bodies import body_trajectories
from .marker_groups import NoDronesError

__all__ = [
    "Markers",
    "NoDronesError",
    "body_trajectories",
    "read_c3d",
    "write_c3d",
]
