from .meeting import CameraCounts, Instant, Meeting
from .messages import JsonLines, UdpLines
from .session import LiveCamera, LiveResult, LiveSession, live_cameras
from .sources import CameraStream, LiveSource, ReplayedVideo

__all__ = [
    "CameraCounts",
    "CameraStream",
    "Instant",
    "JsonLines",
    "LiveCamera",
    "LiveResult",
    "LiveSession",
    "LiveSource",
    "Meeting",
    "ReplayedVideo",
    "UdpLines",
    "live_cameras",
]
