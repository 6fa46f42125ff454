"""Simulation of a sequence: from a scenario and settings to a folder in the layout of the DPJAIT dataset."""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from psotrack import __version__
from psotrack.errors import SettingsError
from psotrack.geometry import make_rig
from psotrack.geometry.rig_files import write_calibration, write_rig
from psotrack.recordings import (
    RECORDING_FILE,
    CameraTable,
    MarkersTable,
    RecordingFile,
    ReferenceTable,
    write_recording_file,
)
from psotrack.recordings.datasets import (
    CALIBRATION,
    DETECTIONS,
    MARKER_CORNERS,
    ONBOARD_CALIBRATION,
    mocap_markers_file,
    onboard_pose_file,
    pose_file,
    write_marker_corners,
    write_mocap_markers,
    write_onboard_calibration,
    write_poses,
)
from psotrack.simulation import scenarios
from psotrack.simulation.imaging.onboard import camera_record, intrinsics, lens, onboard_poses
from psotrack.simulation.scenarios import FlightFromFile, Mesh, Scenario, SimulationSettings
from psotrack.simulation.scene import Scene, build
from psotrack.simulation.segments import (
    Stream,
    Work,
    draw,
    join,
    join_masks,
    segment_folder,
    segments,
    unfinished,
)
from psotrack.support import (
    Report,
    atomic_write,
    digest_file,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
)

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
        _draw(works, len(streams) * frames, jobs or os.cpu_count() or 1, report)
        with atomic_write(folder) as growing:
            growing.mkdir()
            for stream in streams:
                join(stream, [segment_folder(parts / stream.name, some) for some in every], growing)
            if settings.masks:
                static = [stream for stream in streams if not stream.onboard]
                join_masks(
                    [segment_folder(parts / one.name, some) for one in static for some in every], growing
                )
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
        folder = parts / stream.name
        missing = [frames for frames in every if not segment_folder(folder, frames).exists()]
        for start in range(0, len(missing), _PIECE):
            works.append(Work(scene, stream, masks, folder, tuple(missing[start : start + _PIECE])))
    return works


def _draw(works: Sequence[Work], total: int, jobs: int, report: Report) -> None:
    """Draw what is missing of `total` frames of all streams."""
    waiting = sum(len(frames) for work in works for frames in work.segments)
    if waiting < total:
        _logger.info("%d of %d frames were drawn by an earlier call", total - waiting, total)
    with report("simulate", total) as advance:
        advance(total - waiting)
        map_in_processes(draw, works, jobs=jobs, advance=advance)


def _write_tables(scene: Scene, folder: Path, num_frames: int) -> None:
    fps = scene.scenario.fps
    try:
        write_calibration(folder / CALIBRATION, scene.rig, unit="m")
    except SettingsError:
        # The dataset's file has no columns for such lenses, but a rig file and a recording file have.
        write_rig(folder / _RIG, scene.rig)
        write_recording_file(folder / RECORDING_FILE, _recording_file(scene))
    position_m, orientation_wxyz = scene.positions_m(num_frames), scene.orientations_wxyz(num_frames)
    markers_m = scene.mocap_markers_m(num_frames)
    for drone in range(len(scene.flights)):
        number = drone + 1
        write_poses(folder / pose_file(number, fps), position_m[:, drone], orientation_wxyz[:, drone])
        write_mocap_markers(folder / mocap_markers_file(number, fps), markers_m[:, drone])
    if scene.scenario.markers:
        write_marker_corners(folder / MARKER_CORNERS, scene.room.marker_corners_m)


def _recording_file(scene: Scene) -> RecordingFile:
    """The recording file of a sequence whose lenses the dataset's calibration cannot hold."""
    cameras = {
        name: CameraTable(video=stream.video_file, detections=f"{DETECTIONS}/{stream.name}_s.csv")
        for name, stream in zip(scene.rig.names, _streams(scene, onboard=False), strict=True)
    }
    files = tuple(pose_file(drone + 1, scene.scenario.fps) for drone in range(len(scene.flights)))
    return RecordingFile(
        version=1,
        calibration=_RIG,
        cameras=cameras,
        reference=ReferenceTable(files=files),
        markers=MarkersTable(corners=MARKER_CORNERS) if scene.scenario.markers else None,
    )


def _write_onboard_tables(scene: Scene, folder: Path, num_frames: int) -> None:
    names = [f"dron{drone + 1}" for drone in range(len(scene.flights))]
    if camera_record(scene).distortion:
        # The dataset's table has no distortion, and without it the lens would be wrong.
        write_rig(folder / _ONBOARD_LENSES, make_rig(dict.fromkeys(names, lens(scene))))
    else:
        write_onboard_calibration(folder / ONBOARD_CALIBRATION, dict.fromkeys(names, intrinsics(scene)))
    for drone in range(len(scene.flights)):
        poses = onboard_poses(scene, drone, num_frames)
        write_poses(folder / onboard_pose_file(drone + 1, scene.scenario.fps), *poses)
