from .api import (
    background_model,
    calibrate_rig,
    detect_markers,
    doctor,
    overlay,
    read_recording,
    report,
    run,
    save_picture,
    track,
)
from .calibration.clocks import reference_offset
from .calibration.rig.settings import RigSettings
from .evaluation import Evaluation, errors_over_time, evaluate
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
from .sweeps import sweep
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
    "RigSettings",
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
    "calibrate_rig",
    "detect_markers",
    "doctor",
    "errors_over_time",
    "evaluate",
    "export_tracks",
    "localise_video",
    "make_camera",
    "make_rig",
    "overlay",
    "project",
    "read_c3d",
    "read_marker_map",
    "read_recording",
    "read_rig",
    "read_tracks",
    "read_trajectories",
    "reference_offset",
    "register_plugin",
    "report",
    "run",
    "save_picture",
    "simulate",
    "sweep",
    "track",
    "track_runs",
    "triangulate",
    "view_3d",
    "write_rig",
    "write_trajectories",
]
