"""psotrack: 3D positions of several drones, in every frame, from calibrated camera videos alone.

    import psotrack as pt

    if __name__ == "__main__":  # silhouettes are made by several processes
        recording = pt.read_recording("data/Simulated_Data/S02_D4_A")
        tracked = pt.track(recording)
        print(tracked.trajectories.position_m.shape)  # (frames, drones, 3), metres
        print(pt.evaluate(tracked.trajectories, recording.truth).mean_error_m)

Recordings and files
    read_recording, Recording, CameraRecording, read_c3d, read_trajectories, write_trajectories, read_tracks,
    export_tracks, simulate, SimulationSettings
Tracking
    track, track_runs, TrackSettings and its parts (SwarmSettings, ScoreSettings, MotionSettings, DroneSettings,
    StatusSettings, IdentitySettings), TrackedRecording, Trajectories
Judging and showing
    evaluate, Evaluation, find_offset, view_3d
Cameras
    Rig, make_camera, make_rig, read_rig, write_rig, project, triangulate
Inside-out
    localise_video, read_marker_map, MarkerMap, detect_markers
Bring your own
    Search, SearchRegion, Score, ScoreInputs, Method, MethodInputs, BackgroundModel, Detector, background_model,
    register_plugin

Names are loaded when they are first used. Importing the package has no effects: no device is chosen and no setting of
JAX is changed. Every part of the package is a room with its own documentation: `help(psotrack.tracking)`, for example.
"""

import inspect as _inspect
from dataclasses import is_dataclass as _is_dataclass
from importlib.metadata import version as _version
from typing import Any as _Any

import lazy_loader

__version__ = _version("psotrack")

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> _Any:
    """A public name; calls of functions and of records are checked (`psotrack.support.calls`)."""
    value = _load(name)
    if name in globals():
        from psotrack.support import check_records, checked

        if _inspect.isfunction(value):
            value = globals()[name] = checked(value)
        elif _is_dataclass(value):
            check_records(value)
    return value
