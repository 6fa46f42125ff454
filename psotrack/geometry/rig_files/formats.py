"""Reading and writing of rig files: the format is recognised by the content of the file.

All formats are converted to the conventions of `psotrack.geometry`: x_cam = R X + t in metres, t is not the camera's
centre, and pixel (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, Rig, make_rig, scale_lens
from psotrack.geometry.rig_files import text_files, toml_files, xml_files, yaml_files
from psotrack.geometry.rig_files.fields import UNITS_M, CameraFields, Entry
from psotrack.geometry.rig_files.text_files import write_calibration
from psotrack.support import read_text, read_toml, refuse_to_overwrite

_logger = logging.getLogger(__name__)

#: Beginning of the name of caliscope's files; other TOML files are written as rig.toml unless a format is given.
_CALISCOPE = "camera_array"


@dataclass(frozen=True)
class _Format:
    """A format of rig files.

    Attributes:
        read: yields the fields of each camera, from the path and the text of a file.
        recognises: whether a file has this format: by its tables for formats of TOML, else by its text.
        write: writes a rig; None if the format is only read.
    """

    read: Callable[[Path, str], Iterable[CameraFields]]
    recognises: Callable[[Any], bool]
    write: Callable[[Path, Rig], None] | None = None


#: Formats by the name that `--format` takes; the first that recognises a file is taken.
_OF_TOML: Mapping[str, _Format] = {
    "rig": _Format(toml_files.read_rig_toml, toml_files.is_rig_toml, toml_files.write_rig_toml),
    "caliscope": _Format(toml_files.read_metres, toml_files.is_caliscope, toml_files.write_caliscope),
    "pose2sim": _Format(toml_files.read_metres, toml_files.is_pose2sim),
    "anipose": _Format(toml_files.read_anipose, lambda tables: True, toml_files.write_anipose),
}
_OF_TEXT: Mapping[str, _Format] = {
    "qualisys": _Format(xml_files.read_qualisys, xml_files.is_qualisys),
    "vicon": _Format(xml_files.read_vicon, xml_files.is_vicon),
    "easymocap": _Format(yaml_files.read_easymocap, yaml_files.is_easymocap),
    "kalibr": _Format(yaml_files.read_kalibr, yaml_files.is_kalibr),
    "handpose3d": _Format(text_files.read_handpose3d, text_files.is_handpose3d),
    "argus": _Format(text_files.read_argus, text_files.is_argus),
    "dlt": _Format(text_files.read_dlt, text_files.is_dlt),
    "opencv": _Format(yaml_files.read_opencv, yaml_files.is_opencv, yaml_files.write_opencv),
    "dpjait": _Format(text_files.read_dpjait, text_files.is_dpjait, write_calibration),
}
_FORMATS = {**_OF_TOML, **_OF_TEXT}
#: Format by the ending of a name, for files to be written, and for files whose content says nothing.
_SUFFIXES = {".toml": "rig", ".csv": "dpjait", ".yml": "opencv", ".yaml": "opencv"}
#: Names of the formats that can be read, and of those that can be written.
RIG_FORMATS = tuple(_FORMATS)
WRITTEN_RIG_FORMATS = tuple(name for name, one in _FORMATS.items() if one.write)
#: Width and height of all cameras' images in pixels, or of each camera's by its name.
Sizes = tuple[int, int] | Mapping[str, tuple[int, int]] | None


def read_rig(
    path: Path | str,
    image_size_wh: Sizes = None,
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
    cameras = read_cameras(path, file_format=file_format)
    placed = {}
    lacking: dict[str, list[str]] = {"lens": [], "pose": []}
    for name, entry in entries_of(cameras, image_size_wh, metres_per_unit=metres_per_unit).items():
        if entry.camera is not None and entry.placed:
            placed[name] = entry.camera
        else:
            lacking["lens" if entry.camera is None else "pose"].append(name)
    if not placed:
        raise InputError(
            path,
            expected="the poses of cameras",
            found="none",
            remedy="read only the lenses (`psotrack calibrate convert --lenses`), and find the poses by "
            "`psotrack calibrate rig --pairs` with this file as --lenses",
        )
    for what, names in lacking.items():
        if names:
            _logger.warning("%s: left out, because they have no %s: camera %s", path, what, ", ".join(names))
    return make_rig(placed)


def read_lenses(path: Path | str, image_size_wh: Sizes = None, *, file_format: str | None = None) -> Rig:
    """Read only the lenses of a rig file: all cameras stand at the world's origin.

    Arguments and errors: see `read_rig`; the file need not have poses.
    """
    entries = entries_of(read_cameras(path, file_format=file_format), image_size_wh, metres_per_unit=1.0)
    cameras = {name: entry.camera for name, entry in entries.items() if entry.camera is not None}
    if not cameras:
        raise InputError(path, expected="the lenses of cameras", found="none")
    rig = make_rig(cameras)
    origin = np.tile(np.eye(4), (len(rig), 1, 1))
    return Rig(rig.names, replace(rig.cameras, T_cam_world=origin))


def read_cameras(path: Path | str, *, file_format: str | None = None) -> dict[str, CameraFields]:
    """What a rig file says of each camera, by name: of what it does not state, sizes and unit are still open.

    Arguments and errors: see `read_rig`.
    """
    path = Path(path)
    if file_format is not None and file_format not in _FORMATS:
        raise SettingsError("format", expected=f"one of {', '.join(RIG_FORMATS)}", found=file_format)
    text = read_text(path)
    found: dict[str, CameraFields] = {}
    for fields in _FORMATS[file_format or _recognise(path, text)].read(path, text):
        if fields.name in found:
            raise fields.error("", "each camera once", f"{fields.name} again")
        found[fields.name] = fields
    if not found:
        raise InputError(path, expected="at least one camera", found="none")
    return found


def entries_of(
    cameras: Mapping[str, CameraFields], image_size_wh: Sizes = None, *, metres_per_unit: float | None = None
) -> dict[str, Entry]:
    """The cameras of a rig file by name, also those without lens or place, in metres.

    Args:
        cameras: what the file says, from `read_cameras`.
        image_size_wh: width and height of the images in pixels, for cameras whose size the file does not state.
        metres_per_unit: unit of length in the file, metres; needed if a camera is placed and the unit is open.

    Raises:
        InputError: the unit is not known, or a field is missing or wrong. The message names file and field.
    """
    found = {}
    for name, fields in cameras.items():
        size_wh = image_size_wh.get(name) if isinstance(image_size_wh, Mapping) else image_size_wh
        found[name] = fields.entry(size_wh, metres_per_unit or fields.unit_m or 1.0)
    placed = next((cameras[name] for name, entry in found.items() if entry.placed), None)
    if placed is None:
        return found
    if placed.unit_m is None and metres_per_unit is None:
        raise InputError(
            placed.path,
            expected="a unit of lengths",
            found="none, because the file leaves it open",
            remedy=f"state {' or '.join(UNITS_M)}: --units of `psotrack calibrate convert` and `psotrack init`, "
            "calibration_unit in a recording.toml",
        )
    if metres_per_unit is not None and placed.unit_m not in (None, metres_per_unit):
        _logger.warning(
            "%s: lengths are in units of %g m by the file, and are read in units of %g m, as asked for",
            placed.path, placed.unit_m, metres_per_unit,
        )  # fmt: skip
    return found


def rescale_lenses(
    path: Path, cameras: Mapping[str, Camera], sizes_wh: Mapping[str, tuple[int, int] | None]
) -> dict[str, Camera]:
    """Cameras of a rig file at the size of their images, where these have the same shape; a warning names them.

    Args:
        path: the rig file, for the warning.
        cameras: the cameras by name.
        sizes_wh: width and height of the images, pixels; nothing, or None, where they are not known.
    """
    scaled: dict[str, Camera] = {}
    sizes: list[str] = []
    for name, camera in cameras.items():
        (width, height), size_wh = camera.image_size_wh.astype(int).tolist(), sizes_wh.get(name)
        if size_wh and (width, height) != size_wh and width * size_wh[1] == height * size_wh[0]:
            scaled[name] = scale_lens(camera, size_wh)
            sizes.append(f"{width} x {height} to {size_wh[0]} x {size_wh[1]}")
    if scaled:
        _logger.warning(
            "%s: rescaled from %s pixels, the size of the images, for camera %s; this is right where images of both "
            "sizes show the same field of view", path, " and ".join(dict.fromkeys(sizes)), ", ".join(scaled),
        )  # fmt: skip
    return {**cameras, **scaled}


def write_rig(
    path: Path | str, rig: Rig, *, force: bool = False, file_format: str | None = None, placed: bool = True
) -> None:
    """Write a rig to a file, in metres.

    Args:
        path: path of the file. Without a format the suffix selects one: .toml rig.toml (caliscope's format if the
            name begins with camera_array), .csv DPJAIT, .yml and .yaml OpenCV.
        rig: the cameras.
        force: replace an existing file.
        file_format: one of `WRITTEN_RIG_FORMATS`.
        placed: whether the poses are written; only a rig.toml can leave them out.

    Raises:
        InputError: the path has another suffix.
        SettingsError: the format is unknown, or cannot hold the rig.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    if not placed and path.suffix.lower() != ".toml":
        expected = "a file that ends in .toml, for lenses without poses"
        raise InputError(path, expected=expected, found=path.name)
    name = (file_format or _format_of_name(path)) if placed else "rig"
    write = _FORMATS[name].write if name in _FORMATS else None
    if write is None:
        raise SettingsError("format", expected=f"one of {', '.join(WRITTEN_RIG_FORMATS)}", found=name)
    refuse_to_overwrite(path, force)
    write(path, rig) if placed else toml_files.write_rig_toml(path, rig, placed=False)


def _format_of_name(path: Path) -> str:
    if path.name.startswith(_CALISCOPE) and path.suffix.lower() == ".toml":
        return "caliscope"
    if path.suffix.lower() not in _SUFFIXES:
        raise InputError(path, expected=f"a file that ends in {', '.join(_SUFFIXES)}", found=path.name)
    return _SUFFIXES[path.suffix.lower()]


def _recognise(path: Path, text: str) -> str:
    """Name of the format of a file."""
    start, suffix = text.lstrip(), path.suffix.lower()
    is_toml = suffix == ".toml" or (
        not suffix.startswith(".y") and re.match(r"\[[\w.\"-]+\]\s*$", start, re.M)
    )
    content, formats = (read_toml(path), _OF_TOML) if is_toml else (start, _OF_TEXT)
    found = next((name for name, each in formats.items() if each.recognises(content)), _SUFFIXES.get(suffix))
    if found:
        return found
    raise InputError(
        path,
        expected="a rig file of a known format",
        found="other content",
        remedy=f"state its format, one of {', '.join(RIG_FORMATS)}, by --format",
    )
