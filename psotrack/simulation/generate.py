"""Simulation of a sequence: from a scenario and settings to a folder in the layout of the DPJAIT dataset.

Segments are consecutive frames of one camera with their video, masks and detections, each drawn by one process. A
segment's folder is either complete or absent. A segment depends only on the scene and its frame numbers, so neither the
number of processes nor an interruption changes the joined files.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from psotrack import __version__
from psotrack.errors import OutputError, SettingsError
from psotrack.geometry import make_rig
from psotrack.geometry.rig_files import write_calibration, write_rig
from psotrack.recordings import (
    RECORDING_FILE,
    CameraTable,
    Detections,
    MarkersTable,
    RecordingFile,
    ReferenceTable,
    VideoWriter,
    datasets,
    join_videos,
    write_detections,
    write_recording_file,
)
from psotrack.simulation import scenarios
from psotrack.simulation.imaging.renderer import (
    CameraRenderer,
    OnboardRenderer,
    camera_record,
    intrinsics,
    lens,
    onboard_poses,
)
from psotrack.simulation.labels import detect
from psotrack.simulation.scenarios import FlightFromFile, Mesh, Scenario, SimulationSettings
from psotrack.simulation.scene import Scene, build
from psotrack.support import (
    Advance,
    Locks,
    Report,
    atomic_write,
    digest_file,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
)


@contextlib.contextmanager
def unfinished(target: Path, record: bytes) -> Iterator[Path]:
    """Folder of the segments that calls with the same record have drawn; it is locked, and removed after the block.

    If the block raises, or the process is killed, the segments stay for the next call.

    Args:
        target: folder of the sequence, beside which the hidden folder is.
        record: everything that decides the content of the sequence.

    Raises:
        OutputError: another call is making the sequence, or the folder of the sequence cannot be written.
    """
    hidden = target.with_name(f".{target.name}.unfinished")
    # A worker that outlives its killed parent for a moment must not leave a segment to a sequence with another record.
    segments = hidden / hashlib.sha256(record).hexdigest()[:16]
    with Locks().attempt(target.with_name(f".{target.name}.lock")) as is_held:
        if not is_held:
            expected = "no other simulation of this sequence at the same time"
            remedy = "wait until it ends, or choose another folder"
            raise OutputError(target, expected=expected, found="another simulation", remedy=remedy)
        for other in hidden.glob("*"):
            if other != segments:
                shutil.rmtree(other, ignore_errors=True)
        yield segments
        shutil.rmtree(hidden, ignore_errors=True)


#: Frames per segment: ten groups of pictures of the codec. An interruption costs at most one segment per process,
#: about ten seconds of work.
SEGMENT_FRAMES = 120
_VIDEO, _BOXES, _MASKS = "video.avi", "detections.csv", "masks.zip"


@dataclass(frozen=True)
class Stream:
    """The images of one camera over time.

    Attributes:
        name: beginning of the names of the camera's files.
        index: index of the static camera, or of the drone that carries the camera.
        onboard: whether the camera is on board of a drone.
    """

    name: str
    index: int
    onboard: bool = False

    @property
    def video_file(self) -> str:
        """File name of the stream's video."""
        return f"{self.name}_s.avi"


@dataclass(frozen=True)
class Work:
    """Segments of one stream that one process draws, one after the other.

    Attributes:
        scene: the scene to draw.
        stream: the camera's stream.
        masks: whether to write the drones' masks.
        parts: folder of the segments of all streams.
        segments: frame numbers of each segment.
    """

    scene: Scene
    stream: Stream
    masks: bool
    parts: Path
    segments: tuple[range, ...]


def segments(num_frames: int) -> list[range]:
    """Frame numbers of each segment."""
    starts = range(0, num_frames, SEGMENT_FRAMES)
    return [range(start, min(start + SEGMENT_FRAMES, num_frames)) for start in starts]


def _segment_folder(parts: Path, stream: Stream, frames: range) -> Path:
    """Folder of a complete segment, inside the folder of all segments."""
    return parts / stream.name / f"{frames.start:06d}"


def _draw(work: Work, advance: Advance) -> None:
    """Draw the segments of one piece of work; `advance` counts frames."""
    scene, stream = work.scene, work.stream
    artist = OnboardRenderer(scene, stream.index) if stream.onboard else CameraRenderer(scene, stream.index)
    for frames in work.segments:
        with atomic_write(_segment_folder(work.parts, stream, frames)) as folder:
            folder.mkdir()
            with VideoWriter(folder / _VIDEO, scene.scenario.fps, artist.size_wh) as video:
                for frame in frames:
                    video.write(artist.frame(frame))
                    advance(1)
            if isinstance(artist, CameraRenderer):
                _write_labels(work, folder, artist, frames)


def _write_labels(work: Work, folder: Path, artist: CameraRenderer, frames: range) -> None:
    """Write the detections of a segment of a static camera, and the mask of each drone; black where it is not seen."""
    drones = {frame: artist.silhouettes(frame) for frame in frames}
    found = [detect(work.scene, work.stream.index, frame, seen) for frame, seen in drones.items()]
    parts = ([getattr(each, name) for each in found] for name in ("frame", "xyxy", "confidence"))
    write_detections(folder / _BOXES, Detections(*map(np.concatenate, parts)))
    if work.masks:
        black = np.zeros(artist.size_wh[::-1], bool)
        with datasets.MaskWriter(folder / _MASKS) as writer:
            for frame, seen in drones.items():
                masks = {drone.number: drone.mask() for drone in seen}
                for number in range(1, len(work.scene.flights) + 1):
                    writer.write(work.stream.name, number, frame, masks.get(number, black))


def _join(stream: Stream, parts: Sequence[Path], folder: Path) -> None:
    """Join the videos of the segments of a stream, and the detections of a static camera."""
    if not stream.onboard:
        with atomic_write(folder / datasets.DETECTIONS / f"{stream.name}_s.csv") as temporary:
            temporary.write_bytes(b"".join((part / _BOXES).read_bytes() for part in parts))
    join_videos(folder / stream.video_file, [part / _VIDEO for part in parts])


#: File that says how the sequence was made.
RECORD = "simulation.json"
#: Segments of a piece of work. Several, because each piece first draws a camera's backdrop.
_PIECE = 2
#: Rig file of a sequence whose lenses the dataset's calibration cannot hold.
_RIG = "rig.toml"
#: File of the lenses of on-board cameras with distortion, by the drones' names: for `localise --camera`.
_ONBOARD_LENSES = "drone_cameras.toml"

_logger = logging.getLogger(__name__)


def simulate(
    scenario: str | Scenario,
    root: str | Path,
    settings: SimulationSettings | None = None,
    *,
    force: bool = False,
    keep: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> Path:
    """Simulate a sequence in the folder ROOT/Simulated_Data/NAME, in the layout of the DPJAIT dataset.

    Cameras whose lenses the dataset's calibration cannot hold (fisheyes, more coefficients than k1, k2, p1, p2, two
    focal lengths, skew) are written in `rig.toml`, and the folder gets a `recording.toml` instead of the calibration.

    On one machine, the same scenario and settings give the same files for every number of jobs. A simulation of fewer
    frames shows the beginning of the same flight. The sequence appears at its place when it is complete. If a call is
    interrupted or killed, the next call with the same scenario and settings keeps the parts that are drawn.

    Args:
        scenario: the scenario, or the name of a scenario of the package, such as "S02_D4_A".
        root: root folder of the data.
        settings: number of frames, scale, seed and parts of the sequence; None: the defaults.
        force: whether to replace an existing sequence.
        keep: whether an existing sequence of this scenario and these settings is the result.
        jobs: number of drawing processes; None: one per processor.
        report: shows the progress in frames of all videos.

    Returns:
        Folder of the sequence.

    Raises:
        SettingsError: the scenario does not exist, or a setting is out of its range.
        InputError: a mesh or a recorded flight of the scenario cannot be used.
        OutputError: the sequence exists and is neither replaced nor kept, another call is making it, or it cannot be
            written.
    """
    recipe = scenarios.scenario(scenario) if isinstance(scenario, str) else scenario
    settings = settings or SimulationSettings()
    frames = scenarios.count_frames(recipe, settings.num_frames)
    if jobs is not None and jobs < 1:
        raise SettingsError("jobs", expected="1 or more", found=f"{jobs}")
    scene = build(recipe, scale=settings.scale, seed=settings.seed)
    folder = Path(root) / "Simulated_Data" / recipe.name
    settings = replace(settings, num_frames=frames, onboard=settings.onboard and recipe.onboard is not None)
    if settings.onboard:
        # On-board images have their own size. Check here, not after hours of drawing, that the scale fits it.
        intrinsics(scene)
    record = _record(scene, settings)
    if keep and (folder / RECORD).is_file() and (folder / RECORD).read_bytes() == record:
        return folder
    refuse_to_overwrite(folder, force)
    streams, every = _streams(scene, settings.onboard), segments(frames)
    with unfinished(folder, record) as parts:
        works = _missing(scene, streams, every, settings.masks, parts)
        waiting = sum(len(some) for work in works for some in work.segments)
        total = len(streams) * frames
        if waiting < total:
            _logger.info("%d of %d frames were drawn by an earlier call", total - waiting, total)
        with report("simulate", total) as advance:
            advance(total - waiting)
            map_in_processes(_draw, works, jobs=jobs or os.cpu_count() or 1, advance=advance)
        with atomic_write(folder) as growing:
            growing.mkdir()
            masks = []
            for stream in streams:
                folders = [_segment_folder(parts, stream, some) for some in every]
                _join(stream, folders, growing)
                masks += [] if stream.onboard else [part / _MASKS for part in folders]
            if settings.masks:
                datasets.join_archives(growing / datasets.MASKS, masks)
            _write_tables(scene, growing, frames)
            if settings.onboard:
                _write_onboard_tables(scene, growing, frames)
            (growing / RECORD).write_bytes(record)
    return folder


def _record(scene: Scene, settings: SimulationSettings) -> bytes:
    """Everything that decides the content of the sequence, as JSON."""
    record = {
        "version": __version__,
        "libraries": {"numpy": np.__version__, "opencv": cv2.__version__},
        "frames": settings.num_frames,
        "scale": scene.scale,
        "seed": scene.seed,
        "masks": settings.masks,
        "onboard": settings.onboard,
        "sha256": _digests(scene.scenario),
        "scenario": scene.scenario,
    }
    return msgspec.json.format(msgspec.json.encode(record), indent=1)


def _digests(recipe: Scenario) -> dict[str, str]:
    """SHA-256 digests of the files that a scenario names, by path."""
    parts = itertools.chain.from_iterable((drone.model, drone.flight) for drone in recipe.drones)
    files = sorted({part.file for part in parts if isinstance(part, Mesh | FlightFromFile)})
    return {file: digest_file(file, algorithm="sha256") for file in files}


def _streams(scene: Scene, onboard: bool) -> list[Stream]:
    # As in the published dataset, the calibration says `cam1`, and that camera's files are `cam1i_s.avi` and
    # `dl_data/cam1i_s.csv`.
    static = [Stream(f"{name}i", index) for index, name in enumerate(scene.rig.names)]
    drones = range(len(scene.flights)) if onboard else ()
    return static + [Stream(f"dron{drone + 1}_cam", drone, onboard=True) for drone in drones]


def _missing(
    scene: Scene, streams: Sequence[Stream], every: Sequence[range], masks: bool, parts: Path
) -> list[Work]:
    """Pieces of work for the segments that are not drawn yet."""
    works = []
    for stream in streams:
        missing = [frames for frames in every if not _segment_folder(parts, stream, frames).exists()]
        for start in range(0, len(missing), _PIECE):
            works.append(Work(scene, stream, masks, parts, tuple(missing[start : start + _PIECE])))
    return works


def _write_tables(scene: Scene, folder: Path, num_frames: int) -> None:
    fps = scene.scenario.fps
    try:
        write_calibration(folder / datasets.CALIBRATION, scene.rig, unit="m")
    except SettingsError:
        # The dataset's file has no columns for such lenses, but a rig file and a recording file have.
        write_rig(folder / _RIG, scene.rig)
        write_recording_file(folder / RECORDING_FILE, _recording_file(scene))
    position_m, orientation_wxyz = scene.positions_m(num_frames), scene.orientations_wxyz(num_frames)
    markers_m = scene.mocap_markers_m(num_frames)
    for drone in range(len(scene.flights)):
        number = drone + 1
        datasets.write_poses(
            folder / datasets.pose_file(number, fps), position_m[:, drone], orientation_wxyz[:, drone]
        )
        datasets.write_mocap_markers(folder / datasets.mocap_markers_file(number, fps), markers_m[:, drone])
    if scene.scenario.markers:
        datasets.write_marker_corners(folder / datasets.MARKER_CORNERS, scene.room.marker_corners_m)


def _recording_file(scene: Scene) -> RecordingFile:
    """The recording file of a sequence whose lenses the dataset's calibration cannot hold."""
    cameras = {
        name: CameraTable(video=stream.video_file, detections=f"{datasets.DETECTIONS}/{stream.name}_s.csv")
        for name, stream in zip(scene.rig.names, _streams(scene, onboard=False), strict=True)
    }
    files = tuple(datasets.pose_file(drone + 1, scene.scenario.fps) for drone in range(len(scene.flights)))
    return RecordingFile(
        version=1,
        calibration=_RIG,
        cameras=cameras,
        reference=ReferenceTable(files=files),
        markers=MarkersTable(corners=datasets.MARKER_CORNERS) if scene.scenario.markers else None,
    )


def _write_onboard_tables(scene: Scene, folder: Path, num_frames: int) -> None:
    names = [f"dron{drone + 1}" for drone in range(len(scene.flights))]
    if camera_record(scene).distortion:
        # The dataset's table has no distortion, and without it the lens would be wrong.
        write_rig(folder / _ONBOARD_LENSES, make_rig(dict.fromkeys(names, lens(scene))))
    else:
        datasets.write_onboard_calibration(
            folder / datasets.ONBOARD_CALIBRATION, dict.fromkeys(names, intrinsics(scene))
        )
    for drone in range(len(scene.flights)):
        poses = onboard_poses(scene, drone, num_frames)
        datasets.write_poses(folder / datasets.onboard_pose_file(drone + 1, scene.scenario.fps), *poses)
