from .c3d import Markers, read_c3d, write_c3d
from .detections import Detections, read_detections, write_detections
from .inventory import describe_recording, inventory_table
from .marker_bodies import body_trajectories
from .recording import OnboardVideo, Recording
from .video import VideoInfo, VideoWriter, join_videos, probe, read_frames, silence_opencv

__all__ = [
    "Detections",
    "Markers",
    "OnboardVideo",
    "Recording",
    "VideoInfo",
    "VideoWriter",
    "body_trajectories",
    "describe_recording",
    "inventory_table",
    "join_videos",
    "probe",
    "read_c3d",
    "read_detections",
    "read_frames",
    "silence_opencv",
    "write_c3d",
    "write_detections",
]
