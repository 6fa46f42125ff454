"""Cameras on drones in the DPJAIT dataset (the `_A` sequences): videos, poses, intrinsics.

Of the published layout only the names of the pose files are known, `dronN_cam_25.csv`. The written layout:

- `dronN_cam_s.avi`: the video.
- `dronN_cam_25.csv`: the columns of `dronN_pos_25.csv`. The position is the camera's centre; the rotation turns
  camera into world coordinates, with camera axes x right, y down, z forward. Row 0 is a placeholder, as in
  `dronN_pos_25.csv`.
- `drone_cameras_calibration.csv`: `cam_name` (`dronN`), `focal_length_x`, `focal_length_y`, `cx`, `cy`, `width`,
  `height`, in pixels; pixel centres are at integers, and there is no lens distortion.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError
from psotrack.recordings import OnboardVideo, probe
from psotrack.recordings.datasets._poses import poses_of_frames
from psotrack.support import read_table, whole_number, write_rows

ONBOARD_CALIBRATION = "drone_cameras_calibration.csv"

Intrinsics = Mapping[str, tuple[Float[np.ndarray, "3 3"], tuple[int, int]]]

_VIDEO = re.compile(r"drone?_?(?P<number>\d+)_cam(?:_s)?\.(?:avi|mp4)", re.IGNORECASE)
_POSES = re.compile(r"drone?_?(?P<number>\d+)_cam_(?P<rate>\d+(?:\.\d+)?)\.csv", re.IGNORECASE)
_SIZES = ("width", "height")


def onboard_pose_file(number: int, fps: float = 25.0) -> str:
    """Name of the pose file of the camera on drone `number`, 1-based; `write_poses` writes this file."""
    return f"dron{number}_cam_{fps:g}.csv"


def is_onboard_video(path: Path) -> bool:
    """Whether the file is the video of a camera on a drone, by its name."""
    return _VIDEO.fullmatch(path.name) is not None


def read_onboard(folder: Path | str) -> dict[str, OnboardVideo]:
    """Read the videos of cameras on drones in a sequence's folder, by the drones' names; empty without such videos.

    Poses and intrinsics may be missing; existing ones must fit the video.

    Raises:
        InputError: a file cannot be used. The message names file, line and column.
    """
    files = sorted(Path(folder).iterdir())
    videos, poses = _numbered(files, _VIDEO), _numbered(files, _POSES)
    calibration = Path(folder) / ONBOARD_CALIBRATION
    intrinsics = read_onboard_calibration(calibration) if videos and calibration.exists() else {}
    found = {}
    for number, path in videos.items():
        video, name = probe(path), f"dron{number}"
        K, size_wh = intrinsics.get(name, (None, video.image_size_wh))
        if size_wh != video.image_size_wh:
            raise InputError(
                path,
                expected=f"{size_wh[0]} x {size_wh[1]} pixels as {name} has in {ONBOARD_CALIBRATION}",
                found=f"{video.image_size_wh[0]} x {video.image_size_wh[1]}",
            )
        position_m = np.full((video.num_frames, 3), np.nan)
        orientation_wxyz = np.full((video.num_frames, 4), np.nan)
        if number in poses:
            _check_rate(poses[number], video.fps)
            position_m, orientation_wxyz = poses_of_frames(poses[number], video.num_frames)
        found[name] = OnboardVideo(video, K, position_m, orientation_wxyz)
    return found


def read_onboard_calibration(path: Path | str) -> Intrinsics:
    """Read intrinsics (3, 3), and width and height of the image, in pixels, by the drones' names.

    Raises:
        InputError: the file cannot be read, a column is missing, a camera occurs twice, or a value is not allowed.
    """
    table = read_table(path)
    name_column = table.column("cam_name")
    focal = [table.column(f"focal_length_{axis}") for axis in "xy"]
    centre = [table.column(name) for name in ("cx", "cy")]
    sizes = [table.column(name) for name in _SIZES]
    found: dict[str, tuple[Float[np.ndarray, "3 3"], tuple[int, int]]] = {}
    for row in table.rows:
        name = row.text(name_column).lower()
        if name in found:
            raise row.error(name_column, "each camera once", f"{name} again")
        for column in (*focal, *sizes):
            if row.number(column) <= 0:
                raise row.error(column, "a number of pixels above 0", row.text(column))
        (fx, fy), (cx, cy) = ([row.number(column) for column in pair] for pair in (focal, centre))
        width, height = (row.count(column) for column in sizes)
        found[name] = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), (width, height)
    return found


def write_onboard_calibration(path: Path | str, intrinsics: Intrinsics) -> None:
    """Write intrinsics (3, 3), and width and height of the image, in pixels, by the drones' names.

    Raises:
        SettingsError: there is no camera, or a camera has skew.
        OutputError: the file cannot be written.
    """
    if not intrinsics or any(K[0, 1] for K, _ in intrinsics.values()):
        found = "a camera with skew" if intrinsics else "no camera"
        raise SettingsError("intrinsics", expected="at least one camera, all without skew", found=found)
    header = ["cam_name", "focal_length_x", "focal_length_y", "cx", "cy", *_SIZES]
    rows = [[name, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size_wh] for name, (K, size_wh) in intrinsics.items()]
    write_rows(path, [header, *rows])


def _numbered(files: Iterable[Path], pattern: re.Pattern[str]) -> dict[int, Path]:
    """Files whose names match a pattern, by the number of the drone; raise `InputError` for two files of a drone."""
    found: dict[int, Path] = {}
    for path in files:
        match = pattern.fullmatch(path.name)
        if match is None:
            continue
        number = whole_number(match["number"])
        if number is None:
            raise InputError(path, expected="the number of a drone in the name", found=match["number"])
        if number in found:
            raise InputError(path, expected="one file per drone", found=f"{found[number].name} as well")
        found[number] = path
    return dict(sorted(found.items()))


def _check_rate(path: Path, fps: float) -> None:
    """Raise `InputError` if the rate in the name of a file differs from the video's rate."""
    match = _POSES.fullmatch(path.name)
    # 0.1 % is the accuracy of rates in containers; a larger difference would drift.
    if match is not None and abs(float(match["rate"]) - fps) > 1e-3 * fps:
        raise InputError(path, expected=f"poses at the {fps:g} Hz of the video", found=f"{match['rate']} Hz")
