"""TOML files of rigs: `rig.toml`, the package's own format, and those of anipose, caliscope and pose2sim.

`rig.toml` has a table `[cameras.NAME]` per camera:

    version = 1

    [cameras.left]
    size = [1920, 1080]
    K = [[1160.2, 0.0, 961.0], [0.0, 1160.9, 541.2], [0.0, 0.0, 1.0]]
    model = "opencv"                           # or "fisheye"
    distortion = [-0.28, 0.09, 0.0, 0.0, 0.01] # OpenCV's order: 0, 4, 5, 8, 12 or 14 numbers; 4 of a fisheye
    rvec = [1.2, -0.4, 0.3]                    # x_cam = R X + t, R as Rodrigues vector; or R = [[...], [...], [...]]
    tvec = [0.1, 0.2, 5.0]                     # metres

Numbers are written with all their digits: reading gives the same bits, and of `rvec` the same matrix within 1e-15. A
camera whose place is not known has no `rvec`, `R` and `tvec`. `recording.toml` has the same keys beside its own.

The files of the other programs have a table per camera, with `name`, `size`, `matrix`, `distortions`, `rotation` (a
Rodrigues vector; a 3 x 3 matrix in older files of caliscope) and `translation`: x_cam = R X + t.

- anipose: tables `[cam_0]`, ... and `[metadata]`; lengths are in the unit of the board, which the file does not state.
  Files that psotrack writes state it as `unit` in `[metadata]`.
- caliscope: tables `[cameras.0]`, ... in camera_array.toml, and `[cam_0]`, ... in the older config.toml; metres.
- pose2sim: tables named like the cameras, each with `fisheye`; metres.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from psotrack.errors import InputError
from psotrack.geometry import Rig
from psotrack.geometry.rig_files.fields import CameraFields, camera_values, stated_unit_m
from psotrack.support import did_you_mean, read_toml, write_toml

#: Newest version of the layout.
VERSION = 1
#: Keys of a camera's lens and place.
KEYS = ("size", "K", "model", "distortion", "rvec", "R", "tvec")
_MODELS = ("opencv", "fisheye")
Tables = dict[tuple[str, ...], dict[str, Any]]
#: Keys that only caliscope writes into the table of a camera.
_CALISCOPE_KEYS = {"cam_id", "port", "rotation_count", "grid_count", "verified_resolutions"}


def fields_of_table(path: Path, name: str, table: Mapping[str, Any]) -> CameraFields:
    """The fields of a table `[cameras.NAME]`, checked to be complete; keys of a recording are left alone.

    Args:
        path: path of the file, for messages.
        name: name of the camera.
        table: the table.

    Raises:
        InputError: a key is misspelt, missing or wrong.
    """
    fields = CameraFields(path, f"cameras.{name}", table, name, unit_m=1.0)
    for key in table:
        if key not in KEYS and (meant := did_you_mean(key, KEYS)):
            raise fields.error(key, f"one of {', '.join(KEYS)}", key, meant)
    model = table.get("model", "opencv")
    if model not in _MODELS:
        raise fields.error("model", " or ".join(_MODELS), str(model))
    if table.get("distortion") is not None and not isinstance(table["distortion"], list):
        raise fields.error("distortion", "a list of numbers", str(table["distortion"]))
    if table.get("K") is None and any(key in table for key in ("distortion", "rvec", "R", "tvec")):
        raise fields.error("K", "3 x 3 numbers", "none")
    turn = [key for key in ("rvec", "R") if key in table]
    if len(turn) > 1:
        raise fields.error("R", "rvec or R", "both")
    if bool(turn) != ("tvec" in table):
        missing, other = ("tvec", turn[0]) if turn else ("rvec", "tvec")
        raise fields.error(missing, f"3 numbers, as for {other}", "none")
    return fields


def is_rig_toml(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are a rig.toml's."""
    cameras = data.get("cameras")
    tables = (
        [each for each in cameras.values() if isinstance(each, dict)] if isinstance(cameras, dict) else []
    )
    own = set(KEYS) - {"size"}
    return any(own & table.keys() for table in tables) or (bool(tables) and "version" in data)


def read_rig_toml(path: Path, text: str) -> Iterator[CameraFields]:
    """Read a rig.toml; lengths are metres."""
    data = read_toml(path)
    version = data.get("version", VERSION)
    if version != VERSION:
        where, remedy = f"{path}, version", "use a newer psotrack"
        raise InputError(where, expected=f"{VERSION}", found=f"{version}", remedy=remedy)
    cameras = data.get("cameras")
    if not isinstance(cameras, dict) or not cameras:
        raise InputError(path, expected="a table [cameras.NAME] per camera", found="none")
    for name, table in cameras.items():
        if not isinstance(table, dict):
            raise InputError(f"{path}, cameras.{name}", expected="a table", found=f"{table}")
        yield fields_of_table(path, name, table)


def write_rig_toml(path: Path, rig: Rig, *, placed: bool = True) -> None:
    """Write a rig.toml; with `placed` false, only the lenses."""
    tables: dict[tuple[str, ...], Mapping[str, Any]] = {(): {"version": VERSION}}
    for index, name in enumerate(rig.names):
        tables["cameras", name] = camera_values(rig.cameras[index], placed=placed)
    write_toml(path, tables)


def is_caliscope(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are caliscope's."""
    tables = [table for _, _, table in _tables(data)]
    return isinstance(data.get("cameras"), dict) or any(_CALISCOPE_KEYS & table.keys() for table in tables)


def is_pose2sim(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are pose2sim's."""
    tables = [(key, table) for key, _, table in _tables(data)]
    return bool(tables) and all(table.get("name") == key and "fisheye" in table for key, table in tables)


def read_metres(path: Path, text: str) -> Iterator[CameraFields]:
    """Read a file of caliscope or pose2sim; lengths are metres."""
    return _read(path, read_toml(path), 1.0)


def read_anipose(path: Path, text: str) -> Iterator[CameraFields]:
    """Read a file of anipose; the unit is the one in `[metadata]`, if there is one."""
    data = read_toml(path)
    metadata = data.get("metadata")
    unit = metadata.get("unit") if isinstance(metadata, dict) else None
    return _read(path, data, stated_unit_m(path, "metadata.unit", unit))


def write_anipose(path: Path, rig: Rig) -> None:
    """Write a file of anipose, in metres."""
    # Numbers have leading zeros, because anipose sorts the tables by name: cam_10 would come before cam_2.
    digits = len(str(len(rig) - 1))
    tables: Tables = {(f"cam_{index:0{digits}d}",): _values(rig, index) for index in range(len(rig))}
    write_toml(path, {**tables, ("metadata",): {"unit": "m"}})


def write_caliscope(path: Path, rig: Rig) -> None:
    """Write a camera_array.toml of caliscope, in metres."""
    own = {"rotation_count": 0, "fisheye": False}
    write_toml(
        path,
        {("cameras", f"{index}"): {"cam_id": index} | own | _values(rig, index) for index in range(len(rig))},
    )


def _read(path: Path, data: Mapping[str, Any], unit_m: float | None) -> Iterator[CameraFields]:
    for key, place, table in _tables(data):
        if table.get("ignore") is not True:
            named = CameraFields(path, place, table).first("name", "cam_id", "port")
            name = str(table[named]) if named else key.removeprefix("cam_")
            yield CameraFields(path, place, table, name, unit_m)


def _tables(data: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Key, place in the file and table of each camera; other tables belong to the program that wrote the file."""
    nested = data.get("cameras")
    for key, table in (nested if isinstance(nested, dict) else data).items():
        if not isinstance(table, dict) or key == "metadata":
            continue
        if isinstance(nested, dict):
            yield key, f"cameras.{key}", table
        elif "matrix" in table or re.fullmatch(r"cam_?\d+", key) or "distortions" in table:
            yield key, key, table


def _values(rig: Rig, index: int) -> dict[str, Any]:
    values = camera_values(rig.cameras[index])
    return {
        "name": rig.names[index],
        "size": values["size"],
        "matrix": values["K"],
        # anipose needs coefficients; zeros mean no distortion.
        "distortions": values["distortion"] or [0.0] * 5,
        "rotation": values["rvec"],
        "translation": values["tvec"],
    } | ({"fisheye": True} if values["model"] == "fisheye" else {})
