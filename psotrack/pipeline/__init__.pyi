from .causal import CausalRecording, causal_settings, causal_tracker
from .inputs import SharedInputs, check_detections, detection_files_of, prepare, usable_for
from .parts import Method, MethodInputs, Parts
from .results import (
    TrackedRecording,
    changed_settings,
    environment,
    real_time_factors,
    warn_of_missing_drones,
    with_real_time,
)
from .running import track_recording, track_runs

__all__ = [
    "CausalRecording",
    "Method",
    "MethodInputs",
    "Parts",
    "SharedInputs",
    "TrackedRecording",
    "causal_settings",
    "causal_tracker",
    "changed_settings",
    "check_detections",
    "detection_files_of",
    "environment",
    "prepare",
    "real_time_factors",
    "track_recording",
    "track_runs",
    "usable_for",
    "warn_of_missing_drones",
    "with_real_time",
]
