"""The TOML files of anipose, caliscope and pose2sim: a table per camera with `matrix`, `distortions` and a pose.

All map world to camera, x_cam = R X + t. Each table has `name`, `size`, `matrix`, `distortions`, `rotation` (a
Rodrigues vector; a 3 x 3 matrix in older files of caliscope) and `translation`.

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

from psotrack.geometry import Rig
from psotrack.geometry.rig_files.fields import CameraFields, camera_values, stated_unit_m
from psotrack.support import read_toml, write_toml

Tables = dict[tuple[str, ...], dict[str, Any]]
#: Keys that only caliscope writes into the table of a camera.
_CALISCOPE_KEYS = {"cam_id", "port", "rotation_count", "grid_count", "verified_resolutions"}


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
