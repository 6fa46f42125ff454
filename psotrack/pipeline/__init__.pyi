from .parts import Parts
from .results import TrackedRecording, environment
from .running import track_recording, track_runs

__all__ = [
    "Parts",
    "TrackedRecording",
    "environment",
    "track_recording",
    "track_runs",
]
