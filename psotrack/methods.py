"""The methods: from the inputs of runs to tracks, by the swarm, by projection lines, by both, or by a plugin.

`Method` is the interface of further methods, given to `psotrack.track(..., method=...)`, or by name as plugins (see
`psotrack.support.plugins`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from psotrack.camera_errors import (
    CameraViews,
    TrackErrors,
    views_of_middles,
    views_of_sightings,
    with_camera_errors,
)
from psotrack.correspondence import Sightings, from_detections, from_silhouettes
from psotrack.datasets.dpjait import detection_files, read_detections
from psotrack.errors import InputError
from psotrack.fusion import fuse_tracks, fused_errors
from psotrack.geometry import Rig
from psotrack.initiation import InitialState
from psotrack.projection_lines import LineSettings, track_detections
from psotrack.recordings import Recording
from psotrack.settings import BLOBS, YOLO, TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.support import Report, digest_file, no_progress
from psotrack.tracking import RunInputs, track_recording
from psotrack.trajectories import Status, Tracks


@dataclass(frozen=True)
class TrackedPoint:
    """The point of a drone that its track follows; no image shows where the origin of the body is.

    Attributes:
        drone: number of the drone.
        middle_of: "silhouette" or "box": the track follows the middle of the silhouette or of the box.
        box_off_m: (3,), vector from the middle of the silhouette to the middle of the box along the world's axes,
            metres; None where the vector is not known.
        box_off_std_m: (3,), standard error of `box_off_m`, metres; None where it is not known.
    """

    drone: int
    middle_of: Literal["silhouette", "box"]
    box_off_m: list[float] | None = None
    box_off_std_m: list[float] | None = None


@dataclass(frozen=True)
class MethodResult:
    """The result of a method for one run.

    Attributes:
        tracks: tracks of all frames.
        points: for each drone the point that its track follows.
        input_keys: digests of the inputs, by camera.
        seconds: seconds of each stage; "track" and "compile" at least; "finish" so far.
        errors: errors of the tracks that come from the cameras; None where the method states all errors itself.
    """

    tracks: Tracks
    points: tuple[TrackedPoint, ...]
    input_keys: Mapping[str, str]
    seconds: Mapping[str, float]
    errors: TrackErrors | None = None


@dataclass(frozen=True)
class MethodInputs:
    """Inputs of a method for one run.

    Attributes:
        rig: the cameras, calibrated.
        silhouettes: silhouettes of all cameras at the instants (`Silhouettes.read` gives the coverage of some of them,
            0 to 255; `exposures` says when each camera's frame was exposed, None where all were exposed together); None
            where none were computed.
        sightings: detections of all cameras at all instants; None for a method that does not read detections.
        initial: positions, velocities and sizes of the drones at frame 0, (drones, 3) each, metres and m/s.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        fps: instants per second.
        settings: settings of the run; the seed of random numbers is `settings.seed`.
    """

    rig: Rig
    silhouettes: Silhouettes | None
    sightings: Sightings | None
    initial: InitialState
    bounds_m: Float[np.ndarray, "2 3"]
    fps: float
    settings: TrackSettings


@runtime_checkable
class Method(Protocol):
    """A method of tracking: from silhouettes or detections of the whole recording to tracks.

    A method is called once per run, outside of any compiled function; its inputs and results are NumPy arrays. The
    stages after the method (identity, smoothing, body offset, record) are the same for all methods.

    Attributes:
        reads_detections: whether the method is given detections, besides silhouettes.
    """

    @property
    def reads_detections(self) -> bool: ...  # noqa: D102

    def __call__(self, inputs: MethodInputs, report: Report = no_progress) -> Tracks:
        """Track the drones through all frames.

        Args:
            inputs: inputs of the run.
            report: shows progress: `with report("name", num_frames) as advance:`, then `advance(1)` per frame.

        Returns:
            Tracks of all frames, with all drones that the method found. NaN stands for numbers that the method does
            not have.
        """
        ...


@dataclass(frozen=True)
class DetectionInputs:
    """Detections of all cameras, and digests of the files or silhouettes that they come from.

    Attributes:
        sightings: boxes in all frames of all cameras.
        keys: digests by camera.
        seconds: time of reading, seconds.
    """

    sightings: Sightings
    keys: Mapping[str, str]
    seconds: float


def read_sightings(
    recording: Recording, silhouettes: Silhouettes | None, source: str, report: Report = no_progress
) -> DetectionInputs:
    """Read the detections that `TrackSettings.detections` names.

    Raises:
        InputError: the detections cannot be read.
    """
    began = time.perf_counter()
    if source == BLOBS:
        assert silhouettes is not None
        blobs = from_silhouettes(silhouettes, report)
        return DetectionInputs(blobs, dict(silhouettes.keys), time.perf_counter() - began)
    files = detection_files_of(recording, source)
    detections = {name: read_detections(path) for name, path in files.items()}
    times = [recording.frame_times[name] for name in recording.rig.names if name in recording.frame_times]
    longest = max(each.num_frames for each in times)
    sightings = from_detections(detections, recording.rig, longest).at_instants(recording.timeline())
    keys = {name: digest_file(path, algorithm="sha256")[:16] for name, path in files.items()}
    return DetectionInputs(sightings, keys, time.perf_counter() - began)


def check_detections(recording: Recording, settings: TrackSettings) -> None:
    """Check the detections that a run reads against a recording as it was opened (see `Recording.check_detections`).

    Raises:
        InputError: there are no detections, a file cannot be read, or it belongs to other frames.
    """
    if settings.reads_detections:
        recording.check_detections(detection_files_of(recording, settings.detections))


def usable_for(
    recording: Recording,
    settings: TrackSettings,
    *,
    cameras: Sequence[str] | None = None,
    num_frames: int | None = None,
    videos: bool = False,
) -> Recording:
    """A recording with the cameras that these settings can use, and the detections that they name.

    Args:
        recording: the recording as it was opened.
        settings: settings of a run.
        cameras: names of the cameras to use; None uses all.
        num_frames: number of instants to use from the start; None uses all.
        videos: whether each camera needs a video, because a detector reads its frames; if not, stored silhouettes are
            as good as a video.

    Raises:
        InputError: detections cannot be read, no camera can be used (see `Recording.usable`), or fewer than two
            cameras have the videos or stored silhouettes that the method needs.
        SettingsError: a camera is unknown, or the recording has fewer instants.
    """
    if settings.reads_detections and settings.detections != YOLO:
        recording = recording.with_detections(detection_files_of(recording, settings.detections))
    usable = recording.usable(
        cameras, num_frames, videos=videos or settings.needs_each_video, silhouettes=not videos
    )
    shown = [name for name in usable.rig.names if name in usable.videos or name in usable.silhouettes]
    if settings.needs_silhouettes and len(shown) < min(2, len(usable.rig)):
        raise InputError(
            recording.folder,
            expected=f"videos of at least two cameras for --method {settings.method}",
            found=", ".join(shown) or "none",
            remedy="--method projection-lines needs detections only",
        )
    return usable


def detection_files_of(recording: Recording, source: str) -> Mapping[str, Path]:
    """The file of detections of each camera, found by `TrackSettings.detections`.

    Raises:
        InputError: there is no such file.
    """
    if source != YOLO:
        return detection_files(Path(source), recording.rig.names)
    if recording.detections is None:
        raise InputError(
            recording.folder,
            expected="detections in dl_data or in recording.toml",
            found="none",
            remedy="use --detections blobs, or --detections FOLDER",
        )
    return {name: path for name, path in recording.detections.items() if name in recording.rig.names}


def track_by_swarm(
    rig: Rig,
    silhouettes: Silhouettes,
    runs: Sequence[RunInputs],
    settings: Sequence[TrackSettings],
    fps: float,
    report: Report = no_progress,
) -> list[MethodResult]:
    """Track one or more runs by the swarm, all runs together; covariances hold for the errors that silhouettes show.

    The seconds of a run are its share of the time of all runs.

    Args:
        rig: the cameras.
        silhouettes: silhouettes of all cameras.
        runs: inputs of each run.
        settings: settings of each run.
        fps: instants per second.
        report: shows the progress in frames.
    """
    if not runs:
        return []
    began = time.perf_counter()
    tracked, compile_s = track_recording(rig, silhouettes, runs, fps=fps, report=report)
    seconds = {
        **silhouettes.seconds,
        "compile": compile_s / len(runs),
        "track": (time.perf_counter() - began - compile_s) / len(runs),
    }
    results = []
    for (tracks, places), chosen in zip(tracked, settings, strict=True):
        result = MethodResult(tracks, _points(tracks, "silhouette"), silhouettes.keys, seconds)
        if tracks.num_drones:
            began = time.perf_counter()
            views = views_of_middles(rig.cameras, silhouettes.exposures, places, *_found(tracks))
            result = _with_errors(result, views, chosen, fps, began)
        results.append(result)
    return results


def track_by_projection_lines(
    rig: Rig,
    detections: DetectionInputs,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    known: tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None,
    report: Report = no_progress,
) -> MethodResult:
    """Track one run by projection lines (see `psotrack.projection_lines.track_detections`).

    The covariances hold for the errors that the detections show.
    """
    began = time.perf_counter()
    tracks = track_detections(
        rig.cameras,
        detections.sightings,
        LineSettings(settings.motion, settings.drones, settings.status, settings.swarm.spread_m),
        fps=fps,
        bounds_m=bounds_m,
        known=known,
        report=report,
    )
    seconds = {"compile": 0.0, "track": detections.seconds + time.perf_counter() - began}
    result = MethodResult(tracks, _points(tracks, "box"), detections.keys, seconds)
    if not tracks.num_drones:
        return result
    began = time.perf_counter()
    views = views_of_sightings(rig.cameras, detections.sightings, *_found(tracks))
    return _with_errors(result, views, settings, fps, began)


def fuse_methods(
    swarm: MethodResult, lines: MethodResult, settings: TrackSettings, fps: float
) -> MethodResult:
    """Fuse the results of both methods for one run, and the errors of the cameras that they contain."""
    began = time.perf_counter()
    fusion = fuse_tracks(
        swarm.tracks,
        lines.tracks,
        settings.motion,
        fps=fps,
        max_coasting_s=settings.status.max_coasting_s,
        same_foreground=settings.detections == BLOBS,
    )
    tracks, errors, offset = fusion.tracks, None, fusion.offset
    if swarm.errors is not None or lines.errors is not None:
        tracks, errors = fused_errors(fusion, swarm.errors, lines.errors, settings.motion, fps)
    both = ("finish", "compile", "track")
    seconds = {
        **swarm.seconds,
        **{name: swarm.seconds.get(name, 0.0) + lines.seconds.get(name, 0.0) for name in both},
    }
    seconds["track"] += time.perf_counter() - began
    keys = {**swarm.input_keys, **{f"detections of {name}": key for name, key in lines.input_keys.items()}}
    points = tuple(
        TrackedPoint(drone, "silhouette" if drone < len(swarm.points) else "box", *known)
        for drone, known in enumerate(zip(_or_none(offset.offset_m), _or_none(offset.std_m), strict=True))
    )
    return MethodResult(tracks, points, keys, seconds, errors)


def track_by_plugin(method: Method, inputs: MethodInputs, report: Report = no_progress) -> MethodResult:
    """Track one run by a method that another package or the caller brings."""
    began = time.perf_counter()
    tracks = method(inputs, report)
    keys = {} if inputs.silhouettes is None else dict(inputs.silhouettes.keys)
    seconds = {"compile": 0.0, "track": time.perf_counter() - began}
    return MethodResult(tracks, _points(tracks, "silhouette"), keys, seconds)


def _found(tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities in float64, NaN in frames in which a drone was not found."""
    found = (np.asarray(tracks.status) == Status.TRACKED)[..., None]
    position_m, velocity_m_s = (
        np.where(found, np.asarray(value, np.float64), np.nan)
        for value in (tracks.position_m, tracks.velocity_m_s)
    )
    return position_m, velocity_m_s


def _with_errors(
    result: MethodResult, views: CameraViews, settings: TrackSettings, fps: float, began: float
) -> MethodResult:
    """The result with covariances that hold for the errors of the cameras that the views show."""
    tracks, errors = with_camera_errors(result.tracks, views, settings.motion, settings.errors, fps)
    seconds = {**result.seconds, "finish": time.perf_counter() - began}
    return replace(result, tracks=tracks, errors=errors, seconds=seconds)


def _points(tracks: Tracks, middle_of: Literal["silhouette", "box"]) -> tuple[TrackedPoint, ...]:
    return tuple(TrackedPoint(drone, middle_of) for drone in range(tracks.num_drones))


def _or_none(values: Float[np.ndarray, "drones 3"]) -> list[list[float] | None]:
    """The values of each drone as lists, fit for JSON; None where they are not known."""
    return [None if np.isnan(value).any() else value.tolist() for value in values]
