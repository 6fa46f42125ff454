"""What a run has before it tracks: parts that the caller brings, cameras and detections that its settings can use.

A method is given to `psotrack.track(..., method=...)`, or by name as a plugin (see `psotrack.support.plugins`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypedDict, get_type_hints, runtime_checkable

import numpy as np
from jaxtyping import Float

from psotrack.calibration.clocks import CameraClocks
from psotrack.errors import InputError, SettingsError
from psotrack.foreground.detection import Detector
from psotrack.foreground.silhouettes import BackgroundModel, Silhouettes
from psotrack.geometry import Rig, views_meet
from psotrack.recordings import Recording, read_detections
from psotrack.recordings.datasets import detection_files
from psotrack.settings import BLOBS, YOLO, TrackSettings
from psotrack.support import Report, check_interface, digest_file, make_plugin, no_progress
from psotrack.tracking.births import (
    FlightVolume,
    InitialState,
    MovingPoints,
    StartSource,
    flight_volume,
    moving_points,
    start_source,
)
from psotrack.tracking.camera_errors import Knock
from psotrack.tracking.matching import Sightings, from_detections, from_silhouettes, straightened
from psotrack.tracking.swarm import Score, Search
from psotrack.trajectories import Tracks

#: The methods of this package.
_BUILT_IN = ("swarm", "projection-lines", "fused")


@dataclass(frozen=True)
class MethodInputs:
    """Inputs of a method for one run.

    Attributes:
        rig: the cameras, calibrated.
        silhouettes: silhouettes of all cameras at the instants (`Silhouettes.read` gives the coverage of some of them,
            0 to 255; `exposures` says when each camera's frame was exposed, None where all were exposed together).
        sightings: detections of all cameras at all instants; None for a method that does not read detections.
        initial: positions, velocities and sizes of the drones at frame 0, (drones, 3) each, metres and m/s.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        fps: instants per second.
        settings: settings of the run; the seed of random numbers is `settings.seed`.
    """

    rig: Rig
    silhouettes: Silhouettes
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


class Parts(TypedDict, total=False):
    """Parts that the caller brings, instead of those that the settings name.

    Attributes:
        search: the search in one frame (see `Search`).
        score: the score of positions in single cameras (see `Score`).
        method: the method of tracking (see `Method`).
        background: the background model that makes the silhouettes (see `BackgroundModel`); only `track` and
            `track_recording` make silhouettes.
        detector: makes the detections (see `Detector`); only `track` and `track_recording` make detections.
    """

    search: Search
    score: Score
    method: Method
    background: BackgroundModel
    detector: Detector


def check_parts(parts: Parts) -> None:
    """Raise `SettingsError` if a part lacks an attribute or a method of its interface."""
    for kind, interface in get_type_hints(Parts).items():
        if kind in parts:
            check_interface(kind, parts.get(kind), interface)


def find_method(settings: TrackSettings, parts: Parts) -> Method | None:
    """The method that the caller brings, or that an entry point names; None for the methods of this package.

    Raises:
        SettingsError: there is no method of the settings' name.
    """
    if "method" in parts or settings.method in _BUILT_IN:
        return parts.get("method")
    method: Method = make_plugin(
        "method", settings.method, settings, interface=Method, setting="method", built_in=_BUILT_IN
    )
    return method


def check_detector_is_used(settings: TrackSettings, method: Method | None) -> None:
    """Raise `SettingsError` if a detector is brought, but the method reads no detections or others are named."""
    if settings.method == "swarm" if method is None else not method.reads_detections:
        name = settings.method if method is None else type(method).__name__
        expected = "a method that reads detections, such as projection-lines or fused"
        raise SettingsError("detector", expected=expected, found=f"method {name}")
    if settings.detections != YOLO:
        found = f"detections {settings.detections} as well"
        raise SettingsError("detector", expected="detections from one source", found=found)


logger = logging.getLogger(__name__)


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
        InputError: detections cannot be read, no camera can be used (see `Recording.usable`), no two cameras have a
            place in view together, or fewer than two have the videos or stored silhouettes that the method needs.
        SettingsError: a camera is unknown, or the recording has fewer instants.
    """
    if settings.reads_detections and settings.detections != YOLO:
        recording = recording.with_detections(detection_files_of(recording, settings.detections))
    usable = recording.usable(
        cameras, num_frames, videos=videos or settings.needs_each_video, silhouettes=not videos
    )
    names = usable.rig.names
    if len(names) < 2:
        raise InputError(
            recording.folder,
            expected="at least two cameras that can be used, because one camera does not show distances",
            found=", ".join(names),
        )
    if not views_meet(usable.rig.cameras):
        raise InputError(
            recording.folder,
            expected="cameras of which two have a place in view together",
            found=f"that no views of {', '.join(names)} meet",
            remedy="check the places and directions of the cameras in the calibration",
        )
    shown = [each.name for each in usable.cameras if each.video or each.silhouettes]
    if settings.needs_silhouettes and len(shown) < 2:
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
    if not recording.detections:
        raise InputError(
            recording.folder,
            expected="detections in dl_data or in recording.toml",
            found="none",
            remedy="use --detections blobs, or --detections FOLDER",
        )
    return {name: path for name, path in recording.detections.items() if name in recording.rig.names}


def check_detections(recording: Recording, settings: TrackSettings) -> None:
    """Check the detections that a run reads against a recording as it was opened (see `Recording.check_detections`).

    Raises:
        InputError: there are no detections, a file cannot be read, or it belongs to other frames.
    """
    if settings.reads_detections:
        recording.check_detections(detection_files_of(recording, settings.detections))


def read_sightings(
    recording: Recording, silhouettes: Silhouettes | None, source: str, report: Report = no_progress
) -> tuple[Sightings, dict[str, str]]:
    """Read the detections that `TrackSettings.detections` names, and digests of their files or silhouettes by camera.

    Raises:
        InputError: the detections cannot be read.
    """
    if source == BLOBS:
        assert silhouettes is not None
        return from_silhouettes(silhouettes, report), dict(silhouettes.keys)
    files = detection_files_of(recording, source)
    detections = {name: read_detections(path) for name, path in files.items()}
    if not any(map(len, detections.values())):
        logger.warning("no camera has a detection in the whole recording; does the detector find drones?")
    num_frames = max(times.num_frames for times in recording.exposed.values())
    sightings = from_detections(detections, recording.rig, num_frames)
    keys = {name: digest_file(path, algorithm="sha256")[:16] for name, path in files.items()}
    return sightings.at_instants(recording.timeline()), keys


@dataclass(frozen=True, eq=False)
class Run:
    """What is known of a run before it tracks.

    Attributes:
        recording, silhouettes: those at the instants of the run.
        given: the recording with its own lenses; `recording` is without those that fold (see `straightened`).
        settings: settings of the run, with the speed limit that was found.
        parts: parts that the caller brings.
        source: source of the first positions.
        volume: bounds of the room, and where they come from.
        plugin: the method that the caller brings or that an entry point names; None for the methods of this package.
        sightings: detections of all cameras at the instants; None where the method reads none.
        detection_keys: digests of the files or silhouettes that the detections come from, by camera.
        read_s: time in which the detections were read, seconds.
        volume_s: time in which the volume was found, seconds.
        clocks: clocks of the cameras, where they were estimated and corrected; None elsewhere.
        knocks: knocks of cameras that the recording is without from then on.
    """

    recording: Recording
    given: Recording
    silhouettes: Silhouettes | None
    settings: TrackSettings
    parts: Parts
    source: StartSource
    volume: FlightVolume
    plugin: Method | None
    sightings: Sightings | None
    detection_keys: Mapping[str, str]
    read_s: float
    volume_s: float
    clocks: CameraClocks | None = None
    knocks: tuple[Knock, ...] = ()

    @property
    def by_swarm(self) -> bool:
        """Whether the swarm follows the silhouettes, alone or beside projection lines."""
        return self.plugin is None and self.settings.method != "projection-lines"


def prepare(
    recording: Recording,
    silhouettes: Silhouettes | None,
    points: dict[Any, MovingPoints],
    settings: TrackSettings,
    parts: Parts,
    report: Report = no_progress,
) -> Run:
    """Read the detections that the method needs, and find the volume and the speed limit (see `track_runs`).

    Args:
        recording, silhouettes: those at the instants of the run.
        points: moving points in them by the source of the detections and the given size of the drones; what is found
            here is added for other runs.
        settings: settings of the run.
        parts: parts that the caller brings.
        report: shows the progress in frames.
    """
    began = time.perf_counter()
    plugin = find_method(settings, parts)
    sightings, source, keys = None, BLOBS, dict[str, str]()
    if settings.method != "swarm" if plugin is None else plugin.reads_detections:
        source = settings.detections
        sightings, keys = read_sightings(recording, silhouettes, source, report)
    given = recording
    if sightings is not None and silhouettes is None and plugin is None:
        recording, sightings = _without_folds(recording, sightings)
    read_s = time.perf_counter() - began
    bounds_m, speed_m_s = settings.bounds_m or recording.bounds_m, settings.motion.max_speed_m_s
    size_m = settings.drones.size_m
    key = source, size_m
    found = silhouettes if sightings is None else sightings
    if key not in points and found is not None and (bounds_m is None or speed_m_s is None):
        points[key] = moving_points(recording.rig, found, recording.fps, size_m, any_size=source != BLOBS)
    volume = flight_volume(recording.rig, points.get(key), bounds_m=bounds_m, max_speed_m_s=speed_m_s)
    settings = settings.changed({"motion.max_speed_m_s": volume.max_speed_m_s})
    start = start_source(recording, settings.init)
    volume_s = time.perf_counter() - began - read_s
    return Run(
        recording,
        given,
        silhouettes,
        settings,
        parts,
        start,
        volume,
        plugin,
        sightings,
        keys,
        read_s,
        volume_s,
    )


def _without_folds(recording: Recording, sightings: Sightings) -> tuple[Recording, Sightings]:
    """The recording and its detections, without the lenses that fold within the image; warns of these."""
    rig, sightings, names = straightened(recording.rig, sightings)
    if not names:
        return recording, sightings
    logger.warning(
        "the lens of %s folds within the image, as no real one does: its calibration does not hold near the border, "
        "where it is continued; calibrate it with points that reach the border",
        ", ".join(names),
    )
    return recording.with_rig(rig), sightings
