from .causal import CausalRecording, causal_settings, causal_tracker
from .parts import Parts
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
    "Parts",
    "TrackedRecording",
    "causal_settings",
    "causal_tracker",
    "changed_settings",
    "environment",
    "real_time_factors",
    "track_recording",
    "track_runs",
    "warn_of_missing_drones",
    "with_real_time",
]
