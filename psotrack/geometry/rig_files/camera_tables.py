"""The TOML files of anipose, caliscope and pose2sim: a table per camera with `matrix`, `distortions` and a pose.

All map world to camera, x_cam = R X + t. Each table has `name`, `size`, `matrix`, `distortions`, `rotation` (a
Rodrigues vector; a 3 x 3 matrix in older files of caliscope) and `translation`.

- anipose: tables `[cam_0]`, ... and `[metadata]`; lengths are in the unit of the board, which the file does not state.
  Files that psotrack writes state it as `unit` in `[metadata]`.
- caliscope: tables `[cameras.0]`, ... in camera_array.toml, and `[cam_0]`, ... in the older config.toml; metres.
- pose2sim: tables named like the cameras, each with `fisheye`; metres.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import Rig
from psotrack.geometry.rig_files.entries import UNITS_M, Entry, FileRig, Source, collect
from psotrack.geometry.rig_files.fields import CameraFields, entry_from_fields, lens_model
from psotrack.support import atomic_write, read_toml

#: Keys that only caliscope writes into the table of a camera.
_CALISCOPE_KEYS = {"cam_id", "port", "rotation_count", "grid_count", "verified_resolutions"}


def recognises_caliscope(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are caliscope's."""
    tables = [table for _, _, table in _tables(data)]
    return isinstance(data.get("cameras"), dict) or any(_CALISCOPE_KEYS & table.keys() for table in tables)


def recognises_pose2sim(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are pose2sim's."""
    tables = [(key, table) for key, _, table in _tables(data)]
    return bool(tables) and all(table.get("name") == key and "fisheye" in table for key, table in tables)


def read_caliscope(source: Source) -> FileRig:
    """Read a file of caliscope; lengths are metres."""
    return _read(source, metres_per_unit=1.0)


def read_pose2sim(source: Source) -> FileRig:
    """Read a file of pose2sim; lengths are metres."""
    return _read(source, metres_per_unit=1.0)


def read_anipose(source: Source) -> FileRig:
    """Read a file of anipose; the unit is the one in `[metadata]`, if there is one."""
    metadata = read_toml(source.path).get("metadata")
    unit = metadata.get("unit") if isinstance(metadata, dict) else None
    if unit is not None and unit not in list(UNITS_M):
        raise InputError(
            f"{source.path}, metadata.unit", expected=f"one of {', '.join(UNITS_M)}", found=f"{unit}"
        )
    return _read(source, metres_per_unit=None if unit is None else UNITS_M[unit])


def write_anipose(path: Path, rig: Rig) -> None:
    """Write a file of anipose, in metres."""
    # Numbers have leading zeros, because anipose sorts the tables by name: cam_10 would come before cam_2.
    digits = len(str(len(rig) - 1))
    blocks = [
        _block(f"cam_{index:0{digits}d}", _fields(rig, index)) for index in range(len(rig))
    ]  # fmt: skip
    _write(path, [*blocks, '[metadata]\nunit = "m"'])


def write_caliscope(path: Path, rig: Rig) -> None:
    """Write a camera_array.toml of caliscope, in metres."""
    blocks = [
        _block(
            f"cameras.{index}",
            {"cam_id": index, "rotation_count": 0, "fisheye": False} | _fields(rig, index),
        )
        for index in range(len(rig))
    ]
    _write(path, blocks)


def _read(source: Source, metres_per_unit: float | None) -> FileRig:
    data = read_toml(source.path)
    entries = collect(source.path, _entries(source, data))
    if not entries:
        raise InputError(source.path, expected="at least one camera", found="none")
    return FileRig(entries, metres_per_unit)


def _entries(source: Source, data: Mapping[str, Any]) -> Iterator[tuple[str, str, Entry]]:
    for key, place, table in _tables(data):
        if table.get("ignore") is True:
            continue
        fields = CameraFields(source.path, place, table)
        name = fields.first("name", "cam_id", "port")
        shown = str(table[name]) if name else key.removeprefix("cam_")
        yield shown, f"{place}.{name or ''}".rstrip("."), entry_from_fields(fields, source.image_size_wh)


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


def _fields(rig: Rig, index: int) -> dict[str, Any]:
    camera = rig.cameras[index]
    distortion, fisheye = lens_model(camera)
    return {
        "name": rig.names[index],
        "size": [int(side) for side in camera.image_size_wh],
        "matrix": camera.K.tolist(),
        # anipose needs coefficients; zeros mean no distortion.
        "distortions": distortion or [0.0] * 5,
        "rotation": Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_rotvec().tolist(),
        "translation": camera.T_cam_world[:3, 3].tolist(),
    } | ({"fisheye": True} if fisheye else {})


def _block(header: str, fields: Mapping[str, Any]) -> str:
    # Lists and texts in JSON are valid TOML.
    return "\n".join([f"[{header}]", *(f"{key} = {json.dumps(value)}" for key, value in fields.items())])


def _write(path: Path, blocks: list[str]) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
