"""psotrack: 3D positions of several drones, in every frame, from calibrated camera videos alone.

    import psotrack as pt

    if __name__ == "__main__":  # silhouettes are made by several processes
        recording = pt.read_recording("data/Simulated_Data/S02_D4_A")
        tracked = pt.track(recording)
        print(tracked.trajectories.position_m.shape)  # (frames, drones, 3), metres
        print(pt.evaluate(tracked.trajectories, recording.truth).mean_error_m)

Own cameras, step by step or in one call
    run: from the videos of a rig to a report; returns a `RunSummary`
    calibrate_rig: lenses and places of all cameras, from a board, points or markers; returns a `RigCalibration`
    RigSettings: what is known of the board and the lenses, and where the world is
    doctor: what disagrees in a calibration, before tracking; returns a `Diagnosis`
    track, track_runs: the drones of a recording, once or with several seeds; return a `TrackedRecording` per run
    report: one HTML page about tracks
    overlay: videos with the tracks drawn into them
    save_picture: the middle moment of a flight in its cameras, with a map
    view_3d: the flight in 3D, in a notebook
    sweep: track with every combination of a grid of settings; returns a `SweepOutcome`
Recordings and tracks
    Recording, CameraRecording, read_recording: cameras with their videos and detections; the reference
    Trajectories, read_trajectories, write_trajectories: positions of drones over time
    read_tracks, export_tracks: tracks in other programs' formats
    read_c3d: markers of motion capture
    simulate, SimulationSettings: a recording with its truth
Settings of tracking
    TrackSettings, and its parts SwarmSettings, ScoreSettings, MotionSettings, DroneSettings, StatusSettings,
    IdentitySettings
Judging
    Evaluation, evaluate: errors, scores and identities against a reference
    errors_over_time: the error of each drone in each frame
    reference_offset: the offset between the clocks of a reference and of the videos
Cameras
    Rig, make_rig, make_camera: cameras that are calibrated
    read_rig, write_rig: files of many programs
    project, triangulate: from points to pixels, and back
Inside-out
    localise_video: the path of a drone, from markers in its own video
    MarkerMap, read_marker_map: where the markers are
    detect_markers: ArUco markers in an image
Bring your own
    Search, SearchRegion: another search than the swarm
    Score, ScoreInputs: another score
    Method, MethodInputs: another tracker
    BackgroundModel, background_model: another foreground
    Detector: a network that finds drones in images
    register_plugin: give it a name, for the command line

Names are loaded when they are first used. Importing the package has no effects: no device is chosen and no setting of
JAX is changed. Every part of the package is a room with its own documentation: `help(psotrack.tracking)`, for example.
"""

import inspect as _inspect
from dataclasses import is_dataclass as _is_dataclass
from importlib.metadata import version as _version
from typing import Any as _Any

import lazy_loader

__version__ = _version("psotrack")

# Without `__all__`, `help(psotrack)` is this page alone; with it, the help of every name follows, on fifty screens.
_load, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)


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
