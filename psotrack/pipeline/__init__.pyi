from .causal import causal_settings, causal_tracker, track_causally
from .inputs import Method, MethodInputs, Parts, check_detections, detection_files_of, prepare, usable_for
from .results import (
    TrackedRecording,
    changed_settings,
    environment,
    speed_in_words,
    warn_of_missing_drones,
    with_real_time,
)
from .running import track_recording, track_runs

__all__ = [
    "Method",
    "MethodInputs",
    "Parts",
    "TrackedRecording",
    "causal_settings",
    "causal_tracker",
    "changed_settings",
    "check_detections",
    "detection_files_of",
    "environment",
    "prepare",
    "speed_in_words",
    "track_causally",
    "track_recording",
    "track_runs",
    "usable_for",
    "warn_of_missing_drones",
    "with_real_time",
]
