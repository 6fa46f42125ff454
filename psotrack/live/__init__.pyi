from .meeting import CameraCounts, Instant, Meeting
from .messages import JsonLines, UdpLines
from .recorder import CameraRecorder, RecordedCounts, RecordingFolder
from .session import WAIT_S, LiveCamera, LiveResult, LiveSession, live_cameras
from .sources import CameraStream, LiveSource, ReplayedVideo
from .websocket import WebSocketLines

__all__ = [
    "WAIT_S",
    "CameraCounts",
    "CameraRecorder",
    "CameraStream",
    "Instant",
    "JsonLines",
    "LiveCamera",
    "LiveResult",
    "LiveSession",
    "LiveSource",
    "Meeting",
    "RecordedCounts",
    "RecordingFolder",
    "ReplayedVideo",
    "UdpLines",
    "WebSocketLines",
    "live_cameras",
]
