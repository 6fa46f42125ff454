"""What lies in a folder, found by name and content; and one function that opens any recording.

A recording is a `recording.toml`, a folder that holds one, or a folder of a dataset.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from psotrack.errors import InputError, system_errors
from psotrack.recordings import (
    IMAGE_SUFFIXES,
    RECORDING_FILE,
    Recording,
    image_files,
    natural_key,
    read_recording_file,
)
from psotrack.recordings.datasets.dpjait import (
    CALIBRATION,
    DETECTIONS,
    MARKER_CORNERS,
    is_onboard_video,
    read_sequence,
)
from psotrack.recordings.datasets.recording_files import read_recording_toml
from psotrack.support import ARCHIVE_SUFFIX, are_numbers

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


def open_recording(path: Path | str, *, bodies: Mapping[str, Sequence[str]] | None = None) -> Recording:
    """Open the recording that a user names.

    Args:
        path: a `recording.toml` under any name that ends in .toml, a folder that holds a `recording.toml`, or a folder
            of the DPJAIT dataset.
        bodies: labels of the markers of each drone in the C3D file of the reference; None: by the labels, or as the
            `recording.toml` says.

    Raises:
        InputError: there is no recording at the path, or one of its files cannot be used.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() == ".toml":
        return read_recording_toml(path, bodies)
    if (path / RECORDING_FILE).is_file():
        return read_recording_toml(path / RECORDING_FILE, bodies)
    if path.is_dir() and (path / CALIBRATION).exists():
        return read_sequence(path, bodies=bodies)
    raise _no_recording(path)


def is_recording(path: Path | str) -> bool:
    """Whether a path is that of a recording: a file that ends in .toml, or a folder that `open_recording` opens."""
    path = Path(path)
    return path.suffix.lower() == ".toml" or any(
        (path / name).is_file() for name in (RECORDING_FILE, CALIBRATION)
    )


def find_marker_corners(path: Path | str) -> Path:
    """Table of the marker corners of a recording: the one that its `recording.toml` names, or else the dataset's.

    Args:
        path: as in `open_recording`.

    Raises:
        InputError: a `recording.toml` is wrong, or names no table.
    """
    path = Path(path)
    file = path / RECORDING_FILE if path.is_dir() else path
    if not file.is_file():
        return path / MARKER_CORNERS
    markers = read_recording_file(file).markers
    if markers is None:
        raise InputError(f"{file}, markers.corners", expected="a table of marker corners", found="none")
    return file.parent / markers.corners


def _no_recording(path: Path) -> InputError:
    expected = f"a {RECORDING_FILE}, a folder that holds one, or a folder of the DPJAIT dataset"
    if path.suffix.lower() == ARCHIVE_SUFFIX and path.is_file():
        remedy = f"`psotrack archive {shlex.quote(f'{path}')} --out FOLDER` makes such a folder"
        return InputError(path, expected=expected, found="an archive", remedy=remedy)
    if path.suffix.lower() == ".zip" and path.is_file():
        return InputError(path, expected=expected, found="an archive", remedy="unpack it first")
    if not path.exists():
        return InputError(path, expected=expected, found="nothing")
    if not path.is_dir():
        return InputError(path, expected=expected, found="another file")
    try:
        names = (RECORDING_FILE, CALIBRATION)
        below = sorted(inner for inner in path.iterdir() if any((inner / name).is_file() for name in names))
    except OSError:
        return InputError(path, expected=expected, found="a folder without read permission")
    found, remedy = (
        f"neither {RECORDING_FILE} nor {CALIBRATION}",
        f"did you mean {below[0]}?" if below else "",
    )
    remedy = remedy or f"`psotrack init {path}` writes a {RECORDING_FILE} for your own videos"
    return InputError(path, expected=expected, found=found, remedy=remedy)
