from .tracker import track_detections

__all__ = [
    "track_detections",
]
