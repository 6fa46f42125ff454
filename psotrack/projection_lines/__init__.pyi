from .tracker import LineSettings, track_detections

__all__ = [
    "LineSettings",
    "track_detections",
]
