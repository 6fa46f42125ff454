from .frame_poses import FollowedFrame, own_path
from .recording import localise_frames
from .records import STAGES, LocalisedVideo, LocaliseSettings
from .video import localise_video

__all__ = [
    "STAGES",
    "FollowedFrame",
    "LocaliseSettings",
    "LocalisedVideo",
    "localise_frames",
    "localise_video",
    "own_path",
]
