"""Small folders in the layout of the DPJAIT dataset, and files of other layouts, without the package's writers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers import cameras_of

from psotrack.geometry import make_camera, make_rig
from psotrack.recordings import Recording, VideoInfo, VideoWriter
from psotrack.recordings.mocap import Markers, write_c3d

SIZE_WH, FPS, NUM_FRAMES = (64, 48), 25.0, 5
SIMULATED_HEADER = (
    "cam_name;cam_x[m];cam_y[m];cam_z[m];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy"
)
REAL_HEADER = SIMULATED_HEADER.replace("[m]", "[mm]") + ";coeff_1;coeff_2;coeff_3;coeff_4"
POSE_HEADER = "id;pos_x[m];pos_y[m];pos_z[m];rot_x[rad];rot_y[rad];rot_z[rad];q_w;q_x;q_y;q_z"
#: Names of the cameras of the real half: serial numbers.
SERIALS = ("55260362", "56339527", "60881257", "61920488")


def write_video(
    path: Path, num_frames: int = NUM_FRAMES, size_wh: tuple[int, int] = SIZE_WH, fps: float = FPS
) -> None:
    """A black video."""
    with VideoWriter(path, fps, size_wh) as writer:
        for _ in range(num_frames):
            writer.write(np.zeros((size_wh[1], size_wh[0], 3), np.uint8))


def write_cameras(folder: Path, names: list[str]) -> None:
    """The calibration of the simulated half; each camera has its own place, turn and focal length."""
    rows = [f"{name};{i};0.5;8;1.9;{i / 10};0;{1156.3 + i};32;24" for i, name in enumerate(names, start=1)]
    (folder / "cameras_calibration.csv").write_text("\n".join([SIMULATED_HEADER, *rows]) + "\n")


def pose_lines(num_rows: int, x0: float) -> str:
    """Poses of a drone that flies along x, turned by half a turn about z; row 0 is the placeholder."""
    rows = ["0;0;0;-0;0;0;0;1;0;0;0"]
    rows += [f"{i};{x0 + 0.1 * i:.2f};2;1.5;0;0;0;0;0;0;1" for i in range(1, num_rows)]
    return "\n".join([POSE_HEADER, *rows]) + "\n"


def make_simulated(folder: Path) -> None:
    """Three cameras, the second with detections, and two drones, each with a camera on board 0.1 m in front."""
    (folder / "dl_data").mkdir(parents=True)
    write_cameras(folder, ["cam1i", "cam2i", "cam3i"])
    for i in (1, 2, 3):
        write_video(folder / f"cam{i}i_s.avi")
    (folder / "dl_data" / "cam2i_s.csv").write_text("1,10,20,4,6,12,23,0.5\n")
    for i in (1, 2):
        write_video(folder / f"dron{i}_cam_s.avi")
        (folder / f"dron{i}_pos_25.csv").write_text(pose_lines(NUM_FRAMES, i - 1.0))
        (folder / f"dron{i}_cam_25.csv").write_text(pose_lines(NUM_FRAMES, i - 0.9))
    (folder / "drone_cameras_calibration.csv").write_text(
        "cam_name;focal_length_x;focal_length_y;cx;cy;width;height\n"
        "dron1;60.5;60.25;31.5;23.5;64;48\ndron2;61;61;31.5;23.5;64;48\n"
    )


def make_real(folder: Path) -> None:
    """Four cameras that are named by serial number, and two drones in motion capture at 100 Hz."""
    folder.mkdir(parents=True)
    cameras = [f"{name};-100;250.5;6000;1.9;0.1;0;1158.7;32;24;-0.1;0.02;0.001;-0.002" for name in SERIALS]
    (folder / "cameras_calibration.csv").write_text("\n".join([REAL_HEADER, *cameras]) + "\n")
    for name in SERIALS:
        write_video(folder / f"{name}.avi")
    # Three markers of each drone, on a line.
    t = np.arange(20)[:, None, None]
    position_m = np.tile([1.0, 2.0, 1.5], (20, 6, 1)) + 0.01 * t + 0.1 * np.arange(6)[None, :, None]
    labels = tuple(f"Dron{drone}:Dron{drone}{i}" for drone in (4, 7) for i in (1, 2, 3))
    write_c3d(folder / "R99.c3d", Markers(labels, position_m, 100.0))


def write_tum(path: Path, time_s: np.ndarray, position_m: np.ndarray) -> None:
    """A drone's positions (times, 3) in the format of TUM, which is level."""
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time_s), 1))
    np.savetxt(path, np.column_stack([time_s, position_m, level]), "%.17g")


def edit(file: str, old: str, new: str, count: int = 1) -> Callable[[Path], None]:
    """Function that replaces a text in a file of a folder."""

    def change(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, count))

    return change


LETTERS = ("a", "b", "c", "d", "e")
PLAIN_K = np.array([[1000, 0, 960], [0, 1000, 540], [0, 0, 1.0]])
#: Fields of a camera at the origin.
UPRIGHT = {"R": np.eye(3), "t_m": np.zeros(3), "K": PLAIN_K, "image_size_wh": (1920, 1080)}


def full_hd_recording(**changes: dict[str, object] | None) -> Recording:
    """A recording of five equal cameras, without files.

    Args:
        changes: Camera name -> fields of its `VideoInfo` that differ; None removes the camera's video.
    """
    videos = {
        name: replace(VideoInfo(Path(f"{name}.avi"), 250, 25.0, (1920, 1080)), **(changes.get(name) or {}))
        for name in LETTERS
        if changes.get(name, {}) is not None
    }
    rig = make_rig({name: make_camera(**UPRIGHT) for name in LETTERS})
    return Recording("S01", Path("S01"), cameras_of(rig, video=videos))
