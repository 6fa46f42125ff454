from .results import state_at_first_frame
from .tracker import LineSettings, track_detections

__all__ = [
    "LineSettings",
    "state_at_first_frame",
    "track_detections",
]
