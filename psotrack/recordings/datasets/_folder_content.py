"""What lies in a folder: videos, folders of images, detections, frame times, references, found by name and content."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from psotrack.errors import system_errors
from psotrack.recordings import IMAGE_SUFFIXES, image_files, natural_key
from psotrack.recordings.datasets._onboard import is_onboard_video
from psotrack.recordings.datasets.dpjait import CALIBRATION, DETECTIONS, MARKER_CORNERS
from psotrack.support import are_numbers

#: Kinds of files of a recording; "other" is none of them. A folder of pictures is a video.
Kind = Literal["video", "ignore", "detections", "timestamps", "reference", "corners", "calibration", "other"]
#: Kinds of which a camera has one file.
OF_CAMERA: tuple[Kind, ...] = ("video", "ignore", "detections", "timestamps")

VIDEO_SUFFIXES = {
    ".avi", ".mp4", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".mts", ".m2ts", ".ts", ".wmv", ".mjpeg",
}  # fmt: skip
#: Names of rig files, without suffix.
_CALIBRATIONS = {"rig", "calibration", "calib", "camera_array", Path(CALIBRATION).stem}
_CALIBRATION_SUFFIXES = {".toml", ".csv", ".yml", ".yaml", ".json", ".xml", ".txt"}
_IGNORE_WORDS = ("ignore", "mask")
#: Names of folders whose files belong to the recording.
_FOLDERS = {DETECTIONS, "detections", "boxes"}
#: Values of one detection in a line of a file of detections, after the number of the frame.
_DETECTION_VALUES = 7


@dataclass(frozen=True)
class Found:
    """A file, or a folder of images, and what it is.

    Attributes:
        path: path of the file or folder.
        kind: what it is.
        alone_in: name of the folder in which it is the only video; empty for a file of the recording's own folder.
    """

    path: Path
    kind: Kind
    alone_in: str = ""

    @property
    def name(self) -> str:
        """The words that may name a camera."""
        own = self.path.name if self.path.is_dir() else self.path.stem
        return f"{self.alone_in} {own}" if self.alone_in else own

    @property
    def is_video_file(self) -> bool:
        """Whether it is a video, and no folder of pictures."""
        return self.kind == "video" and self.path.is_file()


def look_into(folder: Path) -> list[Found]:
    """Everything in a folder, in its folders of detections, and in folders that hold one video, by name.

    Raises:
        InputError: the folder cannot be read.
    """
    with system_errors(folder, "a folder with a recording's files"):
        paths = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return [found for path in paths for found in _look_at(path)]


def kind_of(path: Path) -> Kind:
    """What a file or a folder is, by its name and its first line."""
    suffix, stem = path.suffix.lower(), path.stem.lower()
    if path.is_dir():
        return "video" if image_files(path) else "other"
    if suffix in VIDEO_SUFFIXES:
        return "other" if is_onboard_video(path) else "video"
    if suffix in IMAGE_SUFFIXES:
        return "ignore" if any(word in stem for word in _IGNORE_WORDS) else "other"
    if suffix in _CALIBRATION_SUFFIXES and stem in _CALIBRATIONS:
        return "calibration"
    if path.name.lower() == MARKER_CORNERS or stem in ("corners", "marker_corners"):
        return "corners" if suffix == ".csv" else "other"
    if suffix in (".c3d", ".tum"):
        return "reference"
    return _kind_of_text(path) if suffix in (".csv", ".txt") else "other"


def _look_at(path: Path) -> Iterator[Found]:
    if path.is_dir() and path.name.lower() in _FOLDERS:
        for inner in sorted(path.iterdir()):
            yield Found(inner, kind_of(inner))
        return
    kind = kind_of(path)
    videos = videos_in(path)
    if kind == "other" and len(videos) == 1:
        yield Found(videos[0], "video", alone_in=path.name)
    else:
        yield Found(path, kind)


def videos_in(folder: Path | str) -> list[Path]:
    """The videos that lie in a folder, in the order of their names; none where the path is no folder."""
    folder = Path(folder)
    files = sorted(folder.iterdir(), key=natural_key) if folder.is_dir() else ()
    return [path for path in files if path.suffix.lower() in VIDEO_SUFFIXES and not is_onboard_video(path)]


def _kind_of_text(path: Path) -> Kind:
    line = _first_line(path)
    names = {name.strip().partition("[")[0] for name in line.lower().replace(";", ",").split(",")}
    if {"frame", "time_s"} == names:
        return "timestamps"
    if {"pos_x", "pos_y", "pos_z"} <= names or {"frame", "drone", "x_m", "y_m", "z_m"} <= names:
        # The pose of a camera on a drone is not the drone's. Tracks with a status are the output of `psotrack track`.
        return "other" if "_cam_" in path.name or names & {"status", "cov_xx"} else "reference"
    values = _cells(line)
    if len(values) == 1 and values[0].isdecimal():
        # The first frames may have no detection: numbers of frames alone.
        values = _cells(_first_line(path, lambda line: len(_cells(line)) > 1))
    if len(values) > 1 and (len(values) - 1) % _DETECTION_VALUES == 0 and are_numbers(values):
        return "detections"
    if len(line.split()) == 8 and are_numbers(line.split()):
        return "reference"
    # No frame of a file of detections may have one.
    return "detections" if path.suffix.lower() == ".csv" and path.parent.name.lower() in _FOLDERS else "other"


def _first_line(path: Path, fits: Callable[[str], object] = str.strip) -> str:
    """The first line that is no comment and fits; empty if there is none."""
    with (
        system_errors(path, "a readable file"),
        path.open(encoding="utf-8-sig", errors="replace") as file,
    ):
        return next((line.strip() for line in file if not line.startswith("#") and fits(line)), "")


def _cells(line: str) -> list[str]:
    """Cells of a line, without empty ones at the end."""
    cells = [cell.strip() for cell in line.split(",")]
    while cells and not cells[-1]:
        cells.pop()
    return cells
