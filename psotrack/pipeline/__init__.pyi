from .parts import Parts
from .results import TrackedRecording, environment, with_real_time
from .running import track_recording, track_runs

__all__ = [
    "Parts",
    "TrackedRecording",
    "environment",
    "track_recording",
    "track_runs",
    "with_real_time",
]
