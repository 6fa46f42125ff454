"""A recording as a laboratory makes it with its own cameras: a folder of videos, and videos of a board.

Four cameras have different frame rates, two image sizes, lenses with distortion, and clocks that are not set; files
bear the names that people give them. First a ChArUco board is held still at many places while all cameras film at one
rate; then the drones fly. What a laboratory would not know is written to the folder `truth`.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path

import cv2
import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack import __version__
from psotrack.calibration import Board, Similarity
from psotrack.errors import SettingsError
from psotrack.geometry import Rig, look_at, make_camera, make_rig, undistort
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import VideoWriter
from psotrack.simulation import scenarios
from psotrack.simulation.imaging.raster import Pinhole
from psotrack.simulation.imaging.renderer import CameraRenderer
from psotrack.simulation.imaging.sensor import Image, Sensor
from psotrack.simulation.scenarios import Scenario, SimulationSettings, Vector
from psotrack.simulation.scene import Scene, build
from psotrack.simulation.world.rooms import Point
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

#: White edge around the squares, metres.
_EDGE_M = 0.03
#: Texels per metre of the board.
_TEXELS_PER_M = 800.0
#: Samples per pixel along each side.
_MAGNIFICATION = 4
#: Grey levels of black, of white, and of the back.
_BLACK, _WHITE, _BACK = 48.0, 208.0, 120.0
#: Lowest and highest place of the board's middle, metres; and how far it may be from the middle of the room.
_HEIGHT_M, _FARTHEST_M = (0.8, 2.1), np.array([3.0, 2.2])
#: Distance of the board from the camera whose image it is to fill, metres.
_DISTANCE_M = (1.8, 4.4)
#: Where the board lies on the floor: its first corner.
_FLOOR_M = (-0.5, 0.1, 0.0)
#: Second number of the random seed of the board's places.
_FOR_BOARD = 1_000_004


@dataclass(frozen=True)
class PosedBoard:
    """The board in one place.

    Attributes:
        axes: (3, 3), columns are the board's axes in the world: right, down, and away from who looks at its front.
        corner_m: first corner of the squares, world, metres.
    """

    axes: Float[np.ndarray, "3 3"]
    corner_m: Point


def own_board() -> Board:
    """The board: 4 x 5 squares of 25 cm, with other markers than those on the walls."""
    return Board((4, 5), 0.25, 0.19, "5x5_50")


def board_poses(rig: Rig, number: int, seed: int) -> tuple[PosedBoard, ...]:
    """Places of the board: first on the floor, then in the hands of a person who shows the board to all cameras.

    Each place is in the view of one camera after the other, anywhere in its image. Every second round the board is
    turned to the middle between this camera and the next one, so that neighbours see it together.

    Args:
        rig: the cameras, which stand side by side along x.
        number: number of places.
        seed: seed of the places.
    """
    rng = np.random.default_rng([seed, _FOR_BOARD])
    centres_m = np.asarray(rig.cameras.centre_world)
    # Neighbours are next to each other along the wall.
    order = np.argsort(centres_m[:, 0])
    places = [PosedBoard(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array(_FLOOR_M))]
    width_m, height_m = np.array(own_board().squares_wh) * own_board().square_m
    while len(places) < number:
        turn, rounds = len(places) % len(rig), len(places) // len(rig)
        step = 1 if turn == 0 else -1 if turn == len(rig) - 1 else rng.choice([-1, 1])
        camera, beside = order[turn], order[turn + step]
        shared = rounds % 2 == 1
        middle_m = _in_view(rig, int(camera), rng)
        low_m, high_m = _HEIGHT_M
        if not (low_m <= middle_m[2] <= high_m and (np.abs(middle_m[:2]) <= _FARTHEST_M).all()):
            continue
        towards = rng.uniform(0.4, 0.6) if shared else rng.uniform(0.0, 0.2)
        target_m = centres_m[camera] + towards * (centres_m[beside] - centres_m[camera])
        away, _ = look_at(target_m.tolist(), middle_m.tolist())
        most_deg = 8.0 if shared else 30.0
        tilt = Rotation.from_euler("zxy", rng.uniform(-1, 1, 3) * [40.0, most_deg, most_deg], degrees=True)
        axes = away.T @ tilt.as_matrix()
        places.append(PosedBoard(axes, middle_m - axes[:, :2] @ [width_m / 2, height_m / 2]))
    return tuple(places)


def draw_board(image: Image, cam: Pinhole, board: PosedBoard) -> Image:
    """The image with the board drawn over it; nothing hides the board.

    Args:
        image: image of the room by a pinhole camera.
        cam: the camera.
        board: the board.
    """
    texture = _texture()
    rows, columns = texture.shape
    # Texel centres have integer coordinates.
    texel_m, first_m = 1 / _TEXELS_PER_M, 0.5 / _TEXELS_PER_M - _EDGE_M
    to_board = np.array([[texel_m, 0, first_m], [0, texel_m, first_m], [0, 0, 1]])
    to_camera = cam.R @ np.column_stack([board.axes[:, :2], board.corner_m]) + np.outer(cam.t_m, [0, 0, 1])
    H = cam.K @ to_camera @ to_board
    outline = np.array([[-0.5, -0.5], [columns - 0.5, -0.5], [columns - 0.5, rows - 0.5], [-0.5, rows - 0.5]])
    corners = np.c_[outline, np.ones(4)] @ H.T
    if corners[:, 2].min() < 0.1:
        return image
    pixels = corners[:, :2] / corners[:, 2:]
    x1, y1 = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    x2, y2 = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [cam.width, cam.height])
    if x1 >= x2 or y1 >= y2:
        return image
    if board.axes[:, 2] @ (board.corner_m + cam.R.T @ cam.t_m) < 0:
        texture = np.full_like(texture, _BACK)
    m = _MAGNIFICATION
    # Pixel p of the window is at m p + (m - 1) / 2 of the magnified window.
    enlarge = np.array([[m, 0, (m - 1) / 2 - m * x1], [0, m, (m - 1) / 2 - m * y1], [0, 0, 1.0]])
    size = (int(x2 - x1), int(y2 - y1))
    large = (m * size[0], m * size[1])
    seen = cv2.warpPerspective(
        texture, enlarge @ H, large, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    inside = np.zeros(large[::-1], np.uint8)
    polygon = np.c_[pixels, np.ones(4)] @ enlarge.T
    cv2.fillConvexPoly(inside, np.round(polygon[:, :2] * 16).astype(np.int32), 1, shift=4)
    share = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA)[..., None]
    grey = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)[..., None]
    drawn = image.copy()
    window = drawn[y1:y2, x1:x2]
    window[...] = np.clip(share * grey + (1 - share) * window + 0.5, 0, 255).astype(np.uint8)
    return drawn


@lru_cache(maxsize=1)
def _texture() -> Float[np.ndarray, "rows columns"]:
    """Grey levels of the board's front, with the white edge."""
    board = own_board()
    size = tuple(round(side * board.square_m * _TEXELS_PER_M) for side in board.squares_wh)
    front = board.opencv().generateImage((size[0], size[1]))
    edge = round(_EDGE_M * _TEXELS_PER_M)
    framed = cv2.copyMakeBorder(front, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255)
    return (_BLACK + framed.astype(np.float32) / 255 * (_WHITE - _BLACK)).astype(np.float32)


def _in_view(rig: Rig, camera: int, rng: np.random.Generator) -> Point:
    """A point somewhere in the image of a camera."""
    one = rig.cameras[camera]
    pixel = rng.uniform(0.06, 0.94, 2) * one.image_size_wh
    x, y = undistort(one, pixel)
    ray = np.array([x, y, 1.0])
    in_camera = ray / np.linalg.norm(ray) * rng.uniform(*_DISTANCE_M)
    T = np.asarray(one.T_cam_world)
    return T[:3, :3].T @ (in_camera - T[:3, 3])


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
        map_in_processes(_draw_videos, works, jobs=jobs or os.cpu_count() or 1, advance=advance)
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


def _draw_videos(work: _Work, advance: Advance) -> None:
    one, lens = OWN_CAMERAS[work.index], work.rig.cameras[work.index]
    scenario = msgspec.structs.replace(work.scene.scenario, fps=one.fps)
    scene = replace(work.scene, scenario=scenario, rig=make_rig({one.name: lens}), start_s=one.start_s)
    renderer = CameraRenderer(scene, 0, stream=work.index)
    sensor = Sensor(scenario.imaging, scene.seed, _BOARD_STREAM + work.index, renderer.size_wh[::-1])
    with VideoWriter(work.folder / "board" / f"{one.name}.avi", BOARD_FPS, renderer.size_wh) as video:
        for number, board in enumerate(work.places):
            views = [draw_board(view.empty_room, view.cam, board) for view in renderer.views]
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
    write_rig(folder / "truth" / "rig.toml", Similarity(np.eye(3), -origin_m).rig(rig))
    rows = [[one.name, one.flight, one.fps, one.start_s] for one in OWN_CAMERAS]
    write_rows(folder / "truth" / "clocks.csv", [["camera", "video", "fps", "start_s"], *rows], separator=",")


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
