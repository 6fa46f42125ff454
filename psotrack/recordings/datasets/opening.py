"""One function that opens any recording: a `recording.toml`, a folder that holds one, or a folder of a dataset."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from psotrack.errors import InputError
from psotrack.recordings import RECORDING_FILE, Recording, read_recording_file
from psotrack.recordings.datasets.dpjait import CALIBRATION, MARKER_CORNERS, read_sequence
from psotrack.recordings.datasets.recording_files import read_recording_toml
from psotrack.support import ARCHIVE_SUFFIX


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
    remedy = (
        f"did you mean {below[0]}?"
        if below
        else f"`psotrack init {path}` writes a {RECORDING_FILE} for your own videos"
    )
    return InputError(
        path, expected=expected, found=f"neither {RECORDING_FILE} nor {CALIBRATION}", remedy=remedy
    )
