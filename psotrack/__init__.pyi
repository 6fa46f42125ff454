from .api import background_model, detect_markers, read_recording, track
from .clocks import find_offset
from .detection import Detector
from .evaluation import Evaluation, evaluate
from .exchange import export_tracks, read_tracks
from .geometry import Rig, make_camera, make_rig, project, triangulate
from .inside_out import MarkerMap, localise_video, read_marker_map
from .pipeline import Method, MethodInputs, TrackedRecording, track_runs
from .recordings import Recording, read_c3d
from .reports import view_3d
from .rig_files import read_rig, write_rig
from .settings import (
    DroneSettings,
    IdentitySettings,
    MotionSettings,
    ScoreSettings,
    StatusSettings,
    SwarmSettings,
    TrackSettings,
)
from .silhouettes import BackgroundModel
from .simulation import SimulationSettings, simulate
from .support import register_plugin
from .tracking import Score, ScoreInputs, Search, SearchRegion
from .trajectories import Trajectories, read_trajectories, write_trajectories

__version__: str

__all__ = [
    "BackgroundModel",
    "Detector",
    "DroneSettings",
    "Evaluation",
    "IdentitySettings",
    "MarkerMap",
    "Method",
    "MethodInputs",
    "MotionSettings",
    "Recording",
    "Rig",
    "Score",
    "ScoreInputs",
    "ScoreSettings",
    "Search",
    "SearchRegion",
    "SimulationSettings",
    "StatusSettings",
    "SwarmSettings",
    "TrackSettings",
    "TrackedRecording",
    "Trajectories",
    "background_model",
    "detect_markers",
    "evaluate",
    "export_tracks",
    "find_offset",
    "localise_video",
    "make_camera",
    "make_rig",
    "project",
    "read_c3d",
    "read_marker_map",
    "read_recording",
    "read_rig",
    "read_tracks",
    "read_trajectories",
    "register_plugin",
    "simulate",
    "track",
    "track_runs",
    "triangulate",
    "view_3d",
    "write_rig",
    "write_trajectories",
]
