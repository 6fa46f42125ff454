from .causal_run import CausalRecording, CausalRun, causal_settings
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
    "CausalRun",
    "Parts",
    "TrackedRecording",
    "causal_settings",
    "changed_settings",
    "environment",
    "real_time_factors",
    "track_recording",
    "track_runs",
    "warn_of_missing_drones",
    "with_real_time",
]
