"""The DPJAIT dataset (Zenodo, record 14748573): real and simulated recordings of drones in halls.

A sequence is a folder with `cameras_calibration.csv`, one video per camera, and a reference: files `dronN_pos_25.csv`
in the simulated half, one `.c3d` file in the real half. The reader relies on the files, not on the name of the folder:
S05_D8 has ten drones.

The `_A` sequences have cameras on drones: videos, poses, intrinsics. Of their published layout only the names of the
pose files are known, `dronN_cam_25.csv`. The written layout:

- `dronN_cam_s.avi`: the video.
- `dronN_cam_25.csv`: the columns of `dronN_pos_25.csv`. The position is the camera's centre; the rotation turns
  camera into world coordinates, with camera axes x right, y down, z forward. Row 0 is a placeholder, as in
  `dronN_pos_25.csv`.
- `drone_cameras_calibration.csv`: `cam_name` (`dronN`), `focal_length_x`, `focal_length_y`, `cx`, `cy`, `width`,
  `height`, in pixels; pixel centres are at integers, and there is no lens distortion.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Rig, files_by_camera
from psotrack.geometry.rig_files import read_cameras, read_rig
from psotrack.recordings import (
    CameraRecording,
    FrameTimes,
    OnboardVideo,
    Recording,
    Reference,
    Timeline,
    VideoInfo,
    frame_times,
    natural_key,
    probe,
)
from psotrack.recordings.datasets._poses import poses_of_frames, read_reference
from psotrack.recordings.mocap import NoDronesError
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


CALIBRATION = "cameras_calibration.csv"
#: The folder of the detections, one file per camera.
DETECTIONS = "dl_data"
MARKER_CORNERS = "aruco_corners.csv"

_logger = logging.getLogger(__name__)
_VIDEO_SUFFIXES = {".avi", ".mp4"}
#: Largest distance of a principal point from the middle of the image, in shares of its width and height.
_OFF_CENTRE = 0.1
_POSE_FILE = re.compile(r"drone?_?\d+_pos_\d+(\.\d+)?\.csv", re.IGNORECASE)


def read_sequence(folder: Path | str, *, bodies: Mapping[str, Sequence[str]] | None = None) -> Recording:
    """Read a sequence from a folder of the dataset, simulated or real.

    A camera without video gets the image size of most videos. Videos may differ in length. `Recording.usable` is
    stricter. Videos of cameras on drones that cannot be used are left out with a warning, because their published
    layout is unknown and tracking does not need them. So is a .c3d file without drones.

    Args:
        folder: the folder.
        bodies: labels of the markers of each drone in the .c3d file, as the user says; None: by the labels.

    Raises:
        InputError: the folder does not belong to the dataset, or one of its files cannot be used.
    """
    folder = Path(folder)
    calibration = folder / CALIBRATION
    names = tuple(read_cameras(calibration, file_format="dpjait"))
    files = sorted(folder.iterdir())
    videos = _videos(folder, files, names)
    rig = read_rig(calibration, _image_sizes(names, videos), file_format="dpjait")
    _check_principal_points(rig, videos)
    boxes = folder / DETECTIONS
    if boxes.exists() and not boxes.is_dir():
        raise InputError(boxes, expected="a folder of detections, or none", found="a file")
    detections = files_by_camera(boxes.glob("*.csv"), names)
    times = _frame_times(videos, detections)
    corners = folder / MARKER_CORNERS
    recording = Recording(
        name=folder.resolve().name,
        folder=folder,
        cameras=tuple(
            CameraRecording(
                name,
                rig.cameras[index],
                videos.get(name),
                times=times.get(name),
                detections=detections.get(name),
            )
            for index, name in enumerate(names)
        ),
        onboard=_onboard(folder),
        marker_corners=corners if corners.exists() else None,
    )
    return replace(recording, reference=_reference(files, recording.timeline(), bodies))


def detection_files(folder: Path | str, cameras: Sequence[str]) -> dict[str, Path]:
    """Find the detection files of cameras in a folder, by the file names of `dl_data`.

    A camera without a file is absent; it has no detections.

    Args:
        folder: folder with the files.
        cameras: names of the cameras.

    Raises:
        InputError: no camera has a file, or a camera has two files.
    """
    folder = Path(folder)
    found = files_by_camera(folder.glob("*.csv"), cameras)
    if not found:
        raise InputError(
            folder,
            expected=f"a folder with files named like the cameras, {cameras[0]}.csv ...",
            found="no such file" if folder.is_dir() else "no such folder",
        )
    return found


def _onboard(folder: Path) -> Mapping[str, OnboardVideo]:
    try:
        return read_onboard(folder)
    except InputError as error:
        _logger.warning("cameras on drones are left out: %s", error)
        return {}


def _videos(folder: Path, files: Sequence[Path], names: Sequence[str]) -> dict[str, VideoInfo]:
    videos = [path for path in files if path.suffix.lower() in _VIDEO_SUFFIXES]
    candidates = [path for path in videos if not is_onboard_video(path)]
    found = files_by_camera(candidates, names)
    if not found:
        raise InputError(
            folder,
            expected=f"videos named like the cameras, {names[0]}.avi ...",
            found=", ".join(path.name for path in candidates) or "no .avi or .mp4 at all",
        )
    for path in candidates:
        if path not in found.values():
            _logger.info("%s: not used, because no camera in %s has this name", path, CALIBRATION)
    with ThreadPoolExecutor() as threads:  # each video is opened and decodes its first frames
        return dict(zip(found, threads.map(probe, found.values()), strict=True))


def _frame_times(videos: Mapping[str, VideoInfo], detections: Mapping[str, Path]) -> dict[str, FrameTimes]:
    """Frame i of every camera was exposed at one time; a camera with detections only lasts as long as the others."""
    first = next(iter(videos.values()))
    most = max(video.num_frames for video in videos.values())
    alone = {name: FrameTimes(most, first.fps) for name in detections if name not in videos}
    # Rates are rounded in headers: rates that differ by less than a thousandth of a hertz are one rate.
    return alone | {
        name: frame_times(replace(video, fps=first.fps) if abs(video.fps - first.fps) < 1e-3 else video)
        for name, video in videos.items()
    }


def _image_sizes(names: Sequence[str], videos: Mapping[str, VideoInfo]) -> dict[str, tuple[int, int]]:
    most_wh = Counter(video.image_size_wh for video in videos.values()).most_common(1)[0][0]
    for name in names:
        if name not in videos:
            _logger.info("camera %s has no video: assuming %d x %d pixels like most cameras", name, *most_wh)
    return {name: videos[name].image_size_wh if name in videos else most_wh for name in names}


def _check_principal_points(rig: Rig, videos: Mapping[str, VideoInfo]) -> None:
    """Raise `InputError` where sizes differ, and a principal point says that a video is of another camera.

    The calibration states no image sizes, so that nothing else shows it.
    """
    if len({video.image_size_wh for video in videos.values()}) == 1:
        return
    for name, video in videos.items():
        x, y = rig.cameras.K[rig.names.index(name), :2, 2]
        width, height = video.image_size_wh
        if max(abs(x / width - 0.5), abs(y / height - 0.5)) > _OFF_CENTRE:
            raise InputError(
                video.path,
                expected=f"images with their middle near the principal point ({x:g}, {y:g})",
                found=f"{width} x {height} pixels",
                remedy="is it the video of another camera?",
            )


def _reference(
    files: Sequence[Path], timeline: Timeline, bodies: Mapping[str, Sequence[str]] | None
) -> Reference | None:
    """The reference in pose files or else in C3D files, or None."""
    poses = sorted((path for path in files if _POSE_FILE.fullmatch(path.name)), key=natural_key)
    found = poses or [path for path in files if path.suffix.lower() == ".c3d"]
    try:
        return read_reference(found, timeline, bodies) if found or bodies else None
    except NoDronesError as error:
        _logger.warning("no reference: %s", error)
        return None
