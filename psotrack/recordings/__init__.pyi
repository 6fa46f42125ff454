from .detections import Detections, read_detections, write_detections
from .inventory import contents, render
from .mocap import Markers, body_trajectories, read_c3d, write_c3d
from .sequence import OnboardVideo, Sequence
from .video import VideoInfo, VideoWriter, join_videos, probe, quiet, read_frames

__all__ = [
    "Detections",
    "Markers",
    "OnboardVideo",
    "Sequence",
    "VideoInfo",
    "VideoWriter",
    "body_trajectories",
    "contents",
    "join_videos",
    "probe",
    "quiet",
    "read_c3d",
    "read_detections",
    "read_frames",
    "render",
    "write_c3d",
    "write_detections",
]
