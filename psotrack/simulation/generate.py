"""Scenario, seed, scale -> a sequence on disk, in the layout of the DPJAIT dataset."""

from __future__ import annotations

import logging
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import msgspec

from psotrack import __version__
from psotrack.datasets.dpjait import (
    CALIBRATION,
    MARKER_CORNERS,
    pose_file,
    write_calibration,
    write_marker_corners,
    write_poses,
)
from psotrack.errors import OutputError, SettingsError
from psotrack.files import refuse_to_overwrite, written_whole
from psotrack.processes import map_in_processes
from psotrack.progress import Advance, Report, silent
from psotrack.simulation.renderer import CameraRenderer
from psotrack.simulation.scenarios import Scenario, scenario
from psotrack.simulation.scene import Scene, build
from psotrack.video import VideoWriter

#: Settings that the videos in an unfinished folder were made with.
_RECORD = "simulation.json"

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _CameraTask:
    """The video of one camera: what a worker needs to know."""

    scenario: Scenario
    seed: int
    scale: float
    camera_index: int
    num_frames: int
    path: Path


def simulate(
    name: str,
    root: Path,
    *,
    num_frames: int | None = None,
    scale: float = 1.0,
    seed: int = 0,
    force: bool = False,
    jobs: int | None = None,
    report: Report = silent,
) -> Path:
    """Simulate a sequence into ROOT/Simulated_Data/NAME, as the published archive would hold it.

    The same name, scale and seed give the same truth and, before the codec, the same pixels, whatever the
    number of jobs; fewer frames are the first of the same flight. Work goes on in a hidden folder beside the
    sequence: a call that was interrupted finds there the cameras that it had finished.

    Args:
        name: of a scenario.
        root: folder of the dataset.
        num_frames: the first so many frames; None for all of the scenario.
        scale: of the images, 1 is full size.
        seed: varies flights and noise.
        force: whether to replace a sequence that is there.
        jobs: cameras that are drawn at once; None for one per processor.
        report: told of every frame.

    Returns:
        The sequence's folder.

    Raises:
        SettingsError: there is no such scenario, or a number makes no sense.
        OutputError: the sequence exists and `force` is not set, or it cannot be written.
    """
    recipe = scenario(name)
    frames = recipe.num_frames if num_frames is None else num_frames
    if not 0 < frames <= recipe.num_frames:
        raise SettingsError(
            "frames", expected=f"1 to {recipe.num_frames}, as many as {name} has", found=f"{frames}"
        )
    if jobs is not None and jobs < 1:
        raise SettingsError("jobs", expected="1 or more", found=f"{jobs}")
    scene = build(recipe, scale=scale, seed=seed)
    folder = Path(root) / "Simulated_Data" / name
    refuse_to_overwrite(folder, force)
    unfinished = _unfinished_folder(folder, _record(recipe, frames, scale, seed))
    _write_videos(scene, unfinished, frames, jobs or os.cpu_count() or 1, report)
    _write_tables(scene, unfinished, frames)
    with written_whole(folder) as temporary:
        os.replace(unfinished, temporary)
    return folder


def video_file(camera_name: str) -> str:
    """The name of a camera's video."""
    return f"{camera_name}_s.avi"


def _record(recipe: Scenario, num_frames: int, scale: float, seed: int) -> bytes:
    settings = {
        "version": __version__,
        "frames": num_frames,
        "scale": scale,
        "seed": seed,
        "scenario": recipe,
    }
    return msgspec.json.format(msgspec.json.encode(settings), indent=1)


def _unfinished_folder(folder: Path, record: bytes) -> Path:
    """The hidden folder beside `folder`, with what an earlier call of the same settings finished, or empty."""
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        known = unfinished / _RECORD
        if known.exists() and known.read_bytes() == record:
            for leftover in unfinished.glob(".*"):
                leftover.unlink()
            return unfinished
        if unfinished.exists():
            shutil.rmtree(unfinished)
        unfinished.mkdir(parents=True)
        known.write_bytes(record)
    except OSError as error:
        raise OutputError(unfinished, expected="to write it", found=error.strerror or str(error)) from error
    return unfinished


def _write_videos(scene: Scene, folder: Path, num_frames: int, jobs: int, report: Report) -> None:
    tasks = [
        _CameraTask(scene.scenario, scene.seed, scene.scale, index, num_frames, folder / video_file(name))
        for index, name in enumerate(scene.rig.names)
    ]
    finished = [task for task in tasks if task.path.exists()]
    if finished:
        _logger.info(
            "%s: %d of %d cameras were finished by an earlier call", folder, len(finished), len(tasks)
        )
    with report("simulate", len(tasks) * num_frames) as advance:
        advance(len(finished) * num_frames)
        waiting = [task for task in tasks if task not in finished]
        map_in_processes(_write_video, waiting, jobs=jobs, advance=advance)


def _write_video(task: _CameraTask, advance: Advance) -> None:
    scene = build(task.scenario, scale=task.scale, seed=task.seed)
    renderer = CameraRenderer(scene, task.camera_index)
    with VideoWriter(task.path, task.scenario.fps, (renderer.cam.width, renderer.cam.height)) as video:
        for frame in range(task.num_frames):
            video.write(renderer.frame(frame))
            advance(1)


def _write_tables(scene: Scene, folder: Path, num_frames: int) -> None:
    write_calibration(folder / CALIBRATION, scene.rig, unit="m")
    position_m, orientation_wxyz = scene.positions_m(num_frames), scene.orientations_wxyz(num_frames)
    for drone in range(position_m.shape[1]):
        write_poses(folder / pose_file(drone + 1), position_m[:, drone], orientation_wxyz[:, drone])
    if scene.scenario.markers:
        write_marker_corners(folder / MARKER_CORNERS, scene.room.marker_corners_m)
