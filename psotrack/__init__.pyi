from .api import background_model, detect_markers, read_recording, track
from .calibration.clocks import find_offset
from .evaluation import Evaluation, evaluate
from .foreground.detection import Detector
from .foreground.silhouettes import BackgroundModel
from .geometry import Rig, make_camera, make_rig, project, triangulate
from .geometry.rig_files import read_rig, write_rig
from .inside_out import MarkerMap, localise_video, read_marker_map
from .pipeline import Method, MethodInputs, TrackedRecording, track_runs
from .recordings import CameraRecording, Recording
from .recordings.exchange import export_tracks, read_tracks
from .recordings.mocap import read_c3d
from .settings import (
    DroneSettings,
    IdentitySettings,
    MotionSettings,
    ScoreSettings,
    StatusSettings,
    SwarmSettings,
    TrackSettings,
)
from .show.reports import view_3d
from .simulation import SimulationSettings, simulate
from .support import register_plugin
from .tracking.swarm import Score, ScoreInputs, Search, SearchRegion
from .trajectories import Trajectories, read_trajectories, write_trajectories

__version__: str

__all__ = [
    "BackgroundModel",
    "CameraRecording",
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
