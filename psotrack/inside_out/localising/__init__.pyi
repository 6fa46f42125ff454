from .frame_poses import STAGES, FollowedFrame, LocalisedVideo, LocaliseSettings, own_path
from .recording import localise_frames, localise_video

__all__ = [
    "STAGES",
    "FollowedFrame",
    "LocaliseSettings",
    "LocalisedVideo",
    "localise_frames",
    "localise_video",
    "own_path",
]
