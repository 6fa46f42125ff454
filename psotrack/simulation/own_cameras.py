"""A recording as a laboratory makes it with its own cameras: a folder of videos, and videos of a board.

Four cameras have different frame rates, two image sizes, lenses with distortion, and clocks that are not set; files
bear the names that people give them. First a ChArUco board is held still at many places while all cameras film at one
rate; then the drones fly. What a laboratory would not know is written to the folder `truth`.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path

import cv2
import msgspec
import numpy as np
from jaxtyping import Float

from psotrack import __version__
from psotrack.errors import SettingsError
from psotrack.geometry import Rig, look_at, make_camera, make_rig
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import VideoWriter
from psotrack.simulation import scenarios
from psotrack.simulation.imaging.posed_board import PosedBoard, board_poses, draw_board, own_board
from psotrack.simulation.imaging.renderer import CameraRenderer
from psotrack.simulation.imaging.sensor import Sensor
from psotrack.simulation.scenarios import Scenario, SimulationSettings, Vector
from psotrack.simulation.scene import Scene, build
from psotrack.support import (
    Advance,
    Report,
    atomic_write,
    map_in_processes,
    no_progress,
    refuse_to_overwrite,
    write_rows,
)
from psotrack.trajectories import Trajectories
from psotrack.trajectories.tum import write_tum

#: Rate of the videos of the board, which is moved from one frame to the next.
BOARD_FPS = 5.0
#: Number of places of the board, the first on the floor.
BOARD_PLACES = 48
#: Rate of the reference, hertz.
_REFERENCE_HZ = 100.0
#: Number of the first random stream of the sensors in videos of the board.
_BOARD_STREAM = 2000


class OwnCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera of the laboratory.

    Attributes:
        name: its name; the name of its video of the board.
        flight: name of its video of the flight.
        fps: rate of its video of the flight.
        start_s: when its first frame is exposed, after the first camera's, seconds.
        position_m, target_m: where it stands in the hall, and what it looks at.
        size: width and height of its images at full size, pixels.
        focal_px: its focal length at full size.
        distortion: k1, k2, p1, p2 of its lens.
    """

    name: str
    flight: str
    fps: float
    start_s: float
    position_m: Vector
    target_m: Vector
    size: tuple[int, int]
    focal_px: float
    distortion: tuple[float, float, float, float]


_LISTED = resources.files("psotrack.simulation.world").joinpath("own_cameras.toml").read_bytes()
OWN_CAMERAS = tuple(msgspec.toml.decode(_LISTED, type=dict[str, list[OwnCamera]])["cameras"])
#: The hall in which the cameras stand.
_HALL = "laboratory"


def simulate_own_cameras(
    scenario: str | Scenario,
    folder: str | Path,
    settings: SimulationSettings | None = None,
    *,
    force: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> Path:
    """Simulate a recording of four cameras of a laboratory's own, with videos of a board to calibrate them.

    The cameras are `OWN_CAMERAS`, not those of the scenario. The folder holds a video per camera, `board` with the
    videos of the board, a TUM file with the poses of each drone, `truth` with the rig and the starts of the videos, and
    simulation.json. Calibrated with the board's frame 0 as floor, the world is that of the reference.

    Args:
        scenario: the scenario, or the name of a scenario of the package.
        folder: folder to write.
        settings: number of frames (at the scenario's rate), scale and seed; masks and on-board cameras are not made.
        force: replace an existing folder.
        jobs: number of drawing processes; None: one per processor.
        report: shows the progress in frames of all videos.

    Returns:
        The folder.

    Raises:
        SettingsError: see `simulate`; or the scenario is not in the laboratory.
        InputError: a mesh or a recorded flight of the scenario cannot be used.
        OutputError: the folder exists and `force` is not set, or it cannot be written.
    """
    recipe = scenarios.scenario(scenario) if isinstance(scenario, str) else scenario
    settings = settings or SimulationSettings()
    folder = Path(folder)
    refuse_to_overwrite(folder, force)
    num_frames = scenarios.count_frames(recipe, settings.num_frames)
    scene = build(recipe, scale=settings.scale, seed=settings.seed)
    if recipe.hall != _HALL:
        raise scenarios.scenario_error(recipe, "hall", _HALL, recipe.hall)
    rig = own_rig(settings.scale)
    duration_s = num_frames / recipe.fps
    places = board_poses(rig, BOARD_PLACES, settings.seed)
    frames = [int((duration_s - one.start_s) * one.fps) for one in OWN_CAMERAS]
    if min(frames) < 1:
        expected = "a flight longer than the clocks differ"
        raise SettingsError("frames", expected=expected, found=f"{num_frames}")
    with (
        atomic_write(folder) as growing,
        report("simulate", sum(frames) + len(frames) * len(places)) as advance,
    ):
        (growing / "board").mkdir(parents=True)
        works = [_Work(scene, rig, index, number, places, growing) for index, number in enumerate(frames)]
        map_in_processes(_draw, works, jobs=jobs or os.cpu_count() or 1, advance=advance)
        _write_tables(growing, scene, rig, places[0], duration_s)
        _write_record(growing, scene, num_frames)
    return folder


def own_rig(scale: float) -> Rig:
    """The laboratory's cameras in the hall's world.

    Args:
        scale: scale of the image sizes; 1 is full size.
    """
    cameras = {}
    for one in OWN_CAMERAS:
        R, t_m = look_at(one.position_m, one.target_m)
        width, height = (2 * round(side * scale / 2) for side in one.size)
        focal = one.focal_px * scale
        # Lenses are a little off the middle of their sensors, and their pixels not quite square.
        K = np.array([[focal, 0.0, 0.505 * width], [0.0, 1.001 * focal, 0.496 * height], [0.0, 0.0, 1.0]])
        cameras[one.name] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(width, height), dist=one.distortion)
    return make_rig(cameras)


@dataclass(frozen=True)
class _Work:
    """The two videos of one camera, which one process draws."""

    scene: Scene
    rig: Rig
    index: int
    num_frames: int
    places: tuple[PosedBoard, ...]
    folder: Path


def _draw(work: _Work, advance: Advance) -> None:
    one, lens = OWN_CAMERAS[work.index], work.rig.cameras[work.index]
    scenario = msgspec.structs.replace(work.scene.scenario, fps=one.fps)
    scene = replace(work.scene, scenario=scenario, rig=make_rig({one.name: lens}), start_s=one.start_s)
    renderer = CameraRenderer(scene, 0, stream=work.index)
    sensor = Sensor(scenario.imaging, scene.seed, _BOARD_STREAM + work.index, renderer.size_wh[::-1])
    with VideoWriter(work.folder / "board" / f"{one.name}.avi", BOARD_FPS, renderer.size_wh) as video:
        for number, board in enumerate(work.places):
            views = [draw_board(view.empty_room(), view.cam, board) for view in renderer.views]
            video.write(sensor.expose(renderer.assemble(views), number, number / BOARD_FPS))
            advance(1)
    with VideoWriter(work.folder / one.flight, one.fps, renderer.size_wh) as video:
        for frame in range(work.num_frames):
            video.write(renderer.frame(frame))
            advance(1)


def _write_tables(folder: Path, scene: Scene, rig: Rig, floor: PosedBoard, duration_s: float) -> None:
    """The reference and the truth, in the world of the board on the floor."""
    origin_m = floor.corner_m
    times = np.arange(int(duration_s * _REFERENCE_HZ) + 1) / _REFERENCE_HZ
    trajectories = Trajectories(
        np.arange(len(times)),
        times,
        tuple(f"dron{number + 1}" for number in range(len(scene.flights))),
        np.stack([flight.position_m(times) for flight in scene.flights], axis=1) - origin_m,
        orientation_wxyz=np.stack([flight.orientation_wxyz(times) for flight in scene.flights], axis=1),
    )
    write_tum(folder, trajectories)
    write_rig(folder / "truth" / "rig.toml", moved(rig, origin_m))
    rows = [[one.name, one.flight, one.fps, one.start_s] for one in OWN_CAMERAS]
    write_rows(folder / "truth" / "clocks.csv", [["camera", "video", "fps", "start_s"], *rows], separator=",")


def moved(rig: Rig, origin_m: Float[np.ndarray, "3"]) -> Rig:
    """The rig in a world with another origin and the same axes."""
    T = np.array(rig.cameras.T_cam_world)
    T[:, :3, 3] += T[:, :3, :3] @ origin_m
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def _write_record(folder: Path, scene: Scene, num_frames: int) -> None:
    record = {
        "version": __version__,
        "scenario": scene.scenario.name,
        "frames": num_frames,
        "scale": scene.scale,
        "seed": scene.seed,
        "board": {**asdict(own_board()), "fps": BOARD_FPS, "floor": 0},
        "opencv": cv2.__version__,
    }
    (folder / "simulation.json").write_bytes(msgspec.json.format(msgspec.json.encode(record), indent=1))
