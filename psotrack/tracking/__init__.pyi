from .camera_middles import CameraMiddles, FoundDrones, middles_in_cameras
from .causal import CausalRow, CausalTracker
from .chunks import RunInputs, on_device, track_silhouettes
from .fitness import (
    PAPER_SCORE,
    Score,
    ScoreInputs,
    SoftIoU,
    camera_scores,
    camera_weights,
    foreground_and_area,
)
from .parameters import TrackerSettings, find_score, find_search, tracker_settings
from .search import ParticleSwarm, Search, SearchRegion, particle_swarm
from .tracker import DISPERSION_FRAMES

__all__ = [
    "DISPERSION_FRAMES",
    "PAPER_SCORE",
    "CameraMiddles",
    "CausalRow",
    "CausalTracker",
    "FoundDrones",
    "ParticleSwarm",
    "RunInputs",
    "Score",
    "ScoreInputs",
    "Search",
    "SearchRegion",
    "SoftIoU",
    "TrackerSettings",
    "camera_scores",
    "camera_weights",
    "find_score",
    "find_search",
    "foreground_and_area",
    "middles_in_cameras",
    "on_device",
    "particle_swarm",
    "track_silhouettes",
    "tracker_settings",
]
