"""The DPJAIT dataset (Zenodo, record 14748573): real and simulated recordings of drones in halls.

A sequence is a folder with `cameras_calibration.csv`, one video per camera, and a reference: files `dronN_pos_25.csv`
in the simulated half, one `.c3d` file in the real half. The reader relies on the files, not on the name of the folder:
S05_D8 has ten drones.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from psotrack.errors import InputError
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
from psotrack.recordings.datasets._onboard import is_onboard_video, read_onboard
from psotrack.recordings.datasets._poses import read_reference
from psotrack.recordings.mocap import NoDronesError

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
    return {name: probe(path) for name, path in found.items()}


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
