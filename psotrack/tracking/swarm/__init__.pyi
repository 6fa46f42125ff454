from .block import on_device
from .fitness import (
    PAPER_SCORE,
    DroneFitness,
    Score,
    ScoreInputs,
    SoftIoU,
    camera_scores,
    camera_weights,
    foreground_and_area,
)
from .parameters import TrackerSettings, find_score, find_search, tracker_settings
from .recording import Places, compile_ahead, track_silhouettes
from .run import RunInputs
from .search import ParticleSwarm, Search, SearchRegion, particle_swarm
from .stepwise import StepwiseTracker
from .tracker import DISPERSION_FRAMES

__all__ = [
    "DISPERSION_FRAMES",
    "PAPER_SCORE",
    "DroneFitness",
    "ParticleSwarm",
    "Places",
    "RunInputs",
    "Score",
    "ScoreInputs",
    "Search",
    "SearchRegion",
    "SoftIoU",
    "StepwiseTracker",
    "TrackerSettings",
    "camera_scores",
    "camera_weights",
    "compile_ahead",
    "find_score",
    "find_search",
    "foreground_and_area",
    "on_device",
    "particle_swarm",
    "track_silhouettes",
    "tracker_settings",
]
