"""Reading and writing of rig files: the format is recognised by the content of the file.

All formats are converted to the conventions of `psotrack.geometry`: x_cam = R X + t in metres, t is not the camera's
centre, and pixel (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, Rig, make_rig
from psotrack.geometry.rig_files import (
    argus,
    camera_tables,
    dlt,
    easymocap,
    kalibr,
    opencv_storage,
    qualisys,
    rig_toml,
    text_blocks,
    vicon,
)
from psotrack.geometry.rig_files.dpjait_calibration import read_calibration, write_calibration
from psotrack.geometry.rig_files.entries import UNITS_M, Entry, FileRig, Source
from psotrack.support import read_text, read_toml, refuse_to_overwrite

_logger = logging.getLogger(__name__)

#: Beginning of the name of caliscope's files; other TOML files are written as rig.toml unless a format is given.
_CALISCOPE = "camera_array"


@dataclass(frozen=True)
class _Format:
    """A format of rig files: how to read it, and how to write it if that is possible."""

    read: Callable[[Source], FileRig]
    write: Callable[[Path, Rig], None] | None = None


def _read_dpjait(source: Source) -> FileRig:
    if source.image_size_wh is None:
        raise source.missing_size()
    size = source.image_size_wh
    rig = read_calibration(source.path, defaultdict(lambda: size))
    return FileRig({name: Entry(rig.cameras[index]) for index, name in enumerate(rig.names)}, 1.0)


#: Formats by the name that `--format` takes.
_FORMATS: Mapping[str, _Format] = {
    "rig": _Format(rig_toml.read, rig_toml.write),
    "dpjait": _Format(_read_dpjait, write_calibration),
    "anipose": _Format(camera_tables.read_anipose, camera_tables.write_anipose),
    "caliscope": _Format(camera_tables.read_caliscope, camera_tables.write_caliscope),
    "pose2sim": _Format(camera_tables.read_pose2sim),
    "opencv": _Format(opencv_storage.read, opencv_storage.write),
    "qualisys": _Format(qualisys.read),
    "vicon": _Format(vicon.read),
    "easymocap": _Format(easymocap.read),
    "kalibr": _Format(kalibr.read),
    "dlt": _Format(dlt.read),
    "argus": _Format(argus.read),
    "handpose3d": _Format(text_blocks.read),
}
#: Format by what a text has in it, for texts that are no TOML; the first that fits is taken.
_BY_CONTENT: Mapping[str, Callable[[str], bool]] = {
    "qualisys": qualisys.recognises,
    "vicon": vicon.recognises,
    "easymocap": easymocap.recognises,
    "kalibr": kalibr.recognises,
    "handpose3d": text_blocks.recognises,
    "argus": argus.recognises,
    "dlt": dlt.recognises,
    "opencv": lambda text: text.startswith(("%YAML", "{")) or "<opencv_storage" in text[:200],
    "dpjait": lambda text: "cam_name" in text.partition("\n")[0],
}
#: Names of the formats that can be read, and of those that can be written.
RIG_FORMATS = tuple(_FORMATS)
WRITTEN_RIG_FORMATS = tuple(name for name, one in _FORMATS.items() if one.write)


def read_rig(
    path: Path | str,
    image_size_wh: tuple[int, int] | None = None,
    *,
    metres_per_unit: float | None = None,
    file_format: str | None = None,
) -> Rig:
    """Read the cameras of a rig file, in metres.

    Cameras that the file does not place are left out, with a warning.

    Args:
        path: path of the file.
        image_size_wh: width and height of the images in pixels, for files without image sizes.
        metres_per_unit: unit of length in the file, metres; needed if the format leaves the unit open.
        file_format: one of `RIG_FORMATS`; None recognises the format by the content.

    Raises:
        InputError: the file cannot be read, its format or its unit is not known, a field is missing or wrong, or no
            camera is placed. The message names file and field.
        SettingsError: the format is unknown.
    """
    entries = read_entries(path, image_size_wh, metres_per_unit=metres_per_unit, file_format=file_format)
    placed = {key: entry for key, entry in entries.items() if entry.camera is not None and entry.placed}
    if not placed:
        raise InputError(
            path,
            expected="the poses of cameras",
            found="none",
            remedy="read only the lenses (`psotrack calibrate convert --lenses`), and find the poses by "
            "`psotrack calibrate extrinsics` with this file as --intrinsics",
        )
    for lacking, names in (
        ("lens", [key for key, entry in entries.items() if entry.camera is None]),
        (
            "pose",
            [key for key, entry in entries.items() if entry.camera is not None and not entry.placed],
        ),
    ):
        if names:
            _logger.warning(
                "%s: left out, because they have no %s: camera %s", path, lacking, ", ".join(names)
            )
    return make_rig({key: _camera(entry) for key, entry in placed.items()})


def read_entries(
    path: Path | str,
    image_size_wh: tuple[int, int] | None = None,
    *,
    metres_per_unit: float | None = None,
    file_format: str | None = None,
) -> dict[str, Entry]:
    """Read all cameras of a rig file by name, also those without lens or place, in metres.

    Arguments and errors: see `read_rig`; a unit of length is needed only if a camera is placed.
    """
    path = Path(path)
    file, name = _read(path, image_size_wh, file_format)
    if not any(entry.camera is not None and entry.placed for entry in file.entries.values()):
        return dict(file.entries)
    factor = _metres(path, file, name, metres_per_unit)
    return {key: _scaled(entry, factor) for key, entry in file.entries.items()}


def read_lenses(
    path: Path | str, image_size_wh: tuple[int, int] | None = None, *, file_format: str | None = None
) -> Rig:
    """Read only the lenses of a rig file: all cameras stand at the world's origin.

    Arguments and errors: see `read_rig`; the file need not have poses.
    """
    file, _ = _read(Path(path), image_size_wh, file_format)
    cameras = {name: entry.camera for name, entry in file.entries.items() if entry.camera is not None}
    if not cameras:
        raise InputError(path, expected="the lenses of cameras", found="none")
    rig = make_rig(cameras)
    origin = np.tile(np.eye(4), (len(rig), 1, 1))
    return Rig(rig.names, replace(rig.cameras, T_cam_world=origin))


def write_rig(path: Path | str, rig: Rig, *, force: bool = False, file_format: str | None = None) -> None:
    """Write a rig to a file, in metres.

    Args:
        path: path of the file. Without a format the suffix selects one: .toml rig.toml (caliscope's format if the
            name begins with camera_array), .csv DPJAIT, .yml and .yaml OpenCV.
        rig: the cameras.
        force: replace an existing file.
        file_format: one of `WRITTEN_RIG_FORMATS`.

    Raises:
        InputError: the path has another suffix.
        SettingsError: the format is unknown, or cannot hold the rig.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    name = file_format or _format_of_name(path)
    write = _FORMATS[name].write if name in _FORMATS else None
    if write is None:
        raise SettingsError("format", expected=f"one of {', '.join(WRITTEN_RIG_FORMATS)}", found=name)
    refuse_to_overwrite(path, force)
    write(path, rig)


def write_lenses(path: Path | str, rig: Rig, *, force: bool = False) -> None:
    """Write the lenses of cameras to a rig.toml, without poses.

    Args:
        path: path that ends in .toml.
        rig: the cameras.
        force: replace an existing file.

    Raises:
        InputError: the path has another suffix.
        OutputError: see `write_rig`.
    """
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise InputError(
            path, expected="a file that ends in .toml, for lenses without poses", found=path.name
        )
    refuse_to_overwrite(path, force)
    rig_toml.write(path, rig, placed=False)


def _format_of_name(path: Path) -> str:
    if path.name.startswith(_CALISCOPE) and path.suffix.lower() == ".toml":
        return "caliscope"
    suffixes = {".toml": "rig", ".csv": "dpjait", ".yml": "opencv", ".yaml": "opencv"}
    if path.suffix.lower() not in suffixes:
        raise InputError(path, expected=f"a file that ends in {', '.join(suffixes)}", found=path.name)
    return suffixes[path.suffix.lower()]


def _read(path: Path, image_size_wh: tuple[int, int] | None, file_format: str | None) -> tuple[FileRig, str]:
    """The content of a file, and the name of its format."""
    if file_format is not None and file_format not in _FORMATS:
        raise SettingsError("format", expected=f"one of {', '.join(RIG_FORMATS)}", found=file_format)
    source = Source(path, read_text(path), image_size_wh)
    name = file_format or _recognise(source)
    return _FORMATS[name].read(source), name


def _recognise(source: Source) -> str:
    """Name of the format of a file."""
    start = source.text.lstrip()
    suffix = source.path.suffix.lower()
    if suffix == ".toml" or (not suffix.startswith(".y") and re.match(r"\[[\w.\"-]+\]\s*$", start, re.M)):
        return _toml_format(read_toml(source.path))
    found = next((name for name, recognises in _BY_CONTENT.items() if recognises(start)), None)
    found = found or {".yml": "opencv", ".yaml": "opencv", ".csv": "dpjait"}.get(suffix)
    if found:
        return found
    raise InputError(
        source.path,
        expected="a rig file of a known format",
        found="other content",
        remedy=f"state its format, one of {', '.join(RIG_FORMATS)}, by --format",
    )


def _toml_format(data: Mapping[str, Any]) -> str:
    if rig_toml.recognises(data):
        return "rig"
    if camera_tables.recognises_caliscope(data):
        return "caliscope"
    return "pose2sim" if camera_tables.recognises_pose2sim(data) else "anipose"


def _metres(path: Path, file: FileRig, name: str, given: float | None) -> float:
    """Length of the unit of a file's translations, metres."""
    if given is None and file.metres_per_unit is None:
        raise InputError(
            path,
            expected="a unit of lengths",
            found=f"none, because {name} leaves it open",
            remedy=f"state {' or '.join(UNITS_M)}: --units of `psotrack calibrate convert` and `psotrack init`, "
            "calibration_unit in a recording.toml",
        )
    if name == "dpjait":
        # The reader has converted the lengths already, column by column.
        if given is not None:
            _logger.warning("%s: the header names the unit of lengths; the stated unit is not used", path)
        return 1.0
    if given is not None and file.metres_per_unit not in (None, given):
        _logger.warning(
            "%s: lengths are in units of %g m by the file, and are read in units of %g m, as asked for",
            path,
            file.metres_per_unit,
            given,
        )
    return given if given is not None else float(file.metres_per_unit or 1.0)


def _camera(entry: Entry) -> Camera:
    assert entry.camera is not None
    return entry.camera


def _scaled(entry: Entry, factor: float) -> Entry:
    """The camera with its translation multiplied."""
    if factor == 1.0 or entry.camera is None or not entry.placed:
        return entry
    T = np.array(entry.camera.T_cam_world)
    T[:3, 3] *= factor
    return replace(entry, camera=replace(entry.camera, T_cam_world=T))
