from .meeting import CameraCounts, Instant, Meeting
from .messages import UdpLines, WebSocketLines, lines_of, write_lines
from .recorder import CameraRecorder, RecordedCounts, recording_folder
from .session import WAIT_S, LiveResult, LiveSession, RowsOutput
from .sources import (
    CameraStream,
    LiveCamera,
    LiveSource,
    ReplayedVideo,
    SourceFrame,
    StreamClock,
    live_cameras,
)

__all__ = [
    "WAIT_S",
    "CameraCounts",
    "CameraRecorder",
    "CameraStream",
    "Instant",
    "LiveCamera",
    "LiveResult",
    "LiveSession",
    "LiveSource",
    "Meeting",
    "RecordedCounts",
    "ReplayedVideo",
    "RowsOutput",
    "SourceFrame",
    "StreamClock",
    "UdpLines",
    "WebSocketLines",
    "lines_of",
    "live_cameras",
    "recording_folder",
    "write_lines",
]
