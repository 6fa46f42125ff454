"""`rig.toml`, the package's own format: a table `[cameras.NAME]` per camera.

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
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from psotrack.errors import InputError
from psotrack.geometry import Rig
from psotrack.geometry.rig_files.fields import CameraFields, camera_values
from psotrack.support import nearest, read_toml, write_toml

#: Newest version of the layout.
VERSION = 1
#: Keys of a camera's lens and place.
KEYS = ("size", "K", "model", "distortion", "rvec", "R", "tvec")
_MODELS = ("opencv", "fisheye")


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
        near = "" if key in KEYS else nearest(key, KEYS)
        if near:
            raise fields.error(key, f"one of {', '.join(KEYS)}", key, f"did you mean {near}?")
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


def recognises(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are a rig.toml's."""
    cameras = data.get("cameras")
    tables = (
        [each for each in cameras.values() if isinstance(each, dict)] if isinstance(cameras, dict) else []
    )
    own = set(KEYS) - {"size"}
    return any(own & table.keys() for table in tables) or (bool(tables) and "version" in data)


def read(path: Path, text: str) -> Iterator[CameraFields]:
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


def write(path: Path, rig: Rig, *, placed: bool = True) -> None:
    """Write a rig.toml; with `placed` false, only the lenses."""
    tables: dict[tuple[str, ...], Mapping[str, Any]] = {(): {"version": VERSION}}
    for index, name in enumerate(rig.names):
        tables["cameras", name] = camera_values(rig.cameras[index], placed=placed)
    write_toml(path, tables)
