"""Rig files: the DPJAIT dataset's CSV, the TOML of anipose and caliscope, and OpenCV's YAML.

All formats map world to camera, x_cam = R X + t, as `psotrack.geometry` does; t is not the camera's centre. Lengths are
written in metres.

- CSV: see `geometry.dpjait_calibration`. One focal length per camera, no skew, only k1, k2, p1, p2; no image sizes.
- TOML: a table per camera with `name`, `size`, `matrix`, `distortions`, `rotation` (a Rodrigues vector; a 3 x 3 matrix
  can be read too) and `translation`. The tables are `[cam_0]`, ... and `[metadata]` in files of anipose,
  `[cameras.0]`, ... in files of caliscope. A file whose name starts with `camera_array` is written as caliscope's.
- YAML: a sequence `cameras` of maps with `name`, `image_size`, `K`, `D`, `R` (3 x 3) and `t`.

Numbers are written with all their digits. Reading gives the same bits; only rotations that are written as Rodrigues
vectors may differ by 1e-15.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, OutputError
from psotrack.geometry.camera_fields import CameraFields, camera_from_fields
from psotrack.geometry.cameras import Camera, Rig, make_rig
from psotrack.geometry.dpjait_calibration import read_calibration, write_calibration
from psotrack.support import atomic_write, read_text, read_toml, refuse_to_overwrite

#: Beginning of the name of caliscope's files. TOML files with other names are written as anipose's.
_CALISCOPE = "camera_array"


def read_rig(
    path: Path | str, image_size_wh: tuple[int, int] | None = None, *, metres_per_unit: float = 1.0
) -> Rig:
    """Read the cameras of a rig file, in metres.

    Args:
        path: path that ends in .csv, .toml, .yml or .yaml.
        image_size_wh: width and height of the images in pixels, for files without image sizes.
        metres_per_unit: length unit of a TOML or YAML file, metres; a CSV file names its unit.

    Raises:
        InputError: the file cannot be read, or a field is missing or wrong; the message names file and field.
    """
    return _read(Path(path), image_size_wh, metres_per_unit, placed=True)


def read_lenses(path: Path | str, image_size_wh: tuple[int, int] | None = None) -> Rig:
    """Read only the lenses of a rig file: all cameras stand at the world's origin.

    Arguments and errors: see `read_rig`; the file need not have poses.
    """
    rig = _read(Path(path), image_size_wh, 1.0, placed=False)
    origin = np.tile(np.eye(4), (len(rig), 1, 1))
    return Rig(rig.names, replace(rig.cameras, T_cam_world=origin))


def write_rig(path: Path | str, rig: Rig, *, force: bool = False) -> None:
    """Write a rig to a file; the suffix of the path selects the format.

    Args:
        path: path that ends in .csv, .toml, .yml or .yaml.
        rig: the cameras.
        force: replace an existing file.

    Raises:
        InputError: the path has another suffix.
        SettingsError: the rig does not fit into a CSV file.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    write = _by_suffix(
        path, {".csv": write_calibration, ".toml": _write_toml, ".yml": _write_yaml, ".yaml": _write_yaml}
    )
    refuse_to_overwrite(path, force)
    write(path, rig)


def _read(path: Path, image_size_wh: tuple[int, int] | None, metres_per_unit: float, *, placed: bool) -> Rig:
    read = _by_suffix(
        path, {".csv": _read_csv, ".toml": _toml_fields, ".yml": _yaml_fields, ".yaml": _yaml_fields}
    )
    if read is _read_csv:
        return _read_csv(path, image_size_wh)
    cameras: dict[str, Camera] = {}
    for name, fields in read(path):
        if name in cameras:
            raise fields.error("name", "each camera once", f"{name} again")
        cameras[name] = camera_from_fields(fields, image_size_wh, metres_per_unit, placed)
    if not cameras:
        raise InputError(path, expected="at least one camera", found="none")
    return make_rig(cameras)


def _read_csv(path: Path, image_size_wh: tuple[int, int] | None) -> Rig:
    if image_size_wh is None:
        raise InputError(
            path,
            expected="the size of the images",
            found="a layout without image sizes",
            remedy="pass --size",
        )
    return read_calibration(path, defaultdict(lambda: image_size_wh))


def _toml_fields(path: Path) -> Iterator[tuple[str, CameraFields]]:
    """Names and tables of the cameras in a file of anipose or caliscope."""
    data = read_toml(path)
    nested = data.get("cameras")
    tables = nested if isinstance(nested, dict) else data
    prefix = "cameras." if tables is nested else ""
    for key, table in tables.items():
        if isinstance(table, dict) and table.get("ignore") is True:
            continue
        # Other tables, such as metadata or charuco, belong to the program that wrote the file.
        if not isinstance(table, dict) or key == "metadata" or "matrix" not in table:
            if prefix or re.fullmatch(r"cam_\w+", key):
                values = table if isinstance(table, dict) else {}
                raise CameraFields(path, f"{prefix}{key}", values).error("matrix", "3 x 3 numbers", "none")
            continue
        fields = CameraFields(path, f"{prefix}{key}", table)
        name = fields.first("name", "cam_id", "port")
        yield str(table[name]) if name else key.removeprefix("cam_"), fields


def _yaml_fields(path: Path) -> Iterator[tuple[str, CameraFields]]:
    """Names and maps of the cameras: a sequence `cameras`, or a single camera as OpenCV's samples write it."""
    text = read_text(path)
    # OpenCV recognises the format by the first line.
    header = "" if text.startswith("%YAML") else "%YAML:1.0\n---\n"
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        storage = cv2.FileStorage(header + text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        content = _values(storage.root())
    except (cv2.error, SystemError) as error:
        # The last line of OpenCV's error is the reason; the lines before are source code.
        reason = str(error.__cause__ or error).strip().splitlines()[-1].rstrip("'")
        line = re.search(r"\((\d+)\): (.*)", reason)
        where = f"{path}, line {int(line[1]) - header.count(chr(10))}" if line else path
        found = f"an error ({line[2] if line else reason})"
        raise InputError(where, expected="OpenCV's YAML", found=found) from None
    finally:
        cv2.utils.logging.setLogLevel(level)
    values = content if isinstance(content, dict) else {}
    cameras = values.get("cameras")
    if not isinstance(cameras, list):
        yield path.stem, CameraFields(path, "camera", values)
        return
    for index, item in enumerate(cameras):
        fields = CameraFields(path, f"cameras[{index}]", item if isinstance(item, dict) else {})
        name = fields.first("name")
        if name is None:
            raise fields.error("name", "a name", "none")
        yield str(fields.values[name]), fields


def _values(node: Any) -> Any:
    """Convert a node of OpenCV's file storage to dictionaries, lists, arrays, numbers and text."""
    if node.isMap():
        inner = {key: node.getNode(key) for key in node.keys()}  # noqa: SIM118 - a FileNode is not iterable
        if {"rows", "cols", "dt", "data"} <= set(inner):
            return node.mat()
        return {key: _values(value) for key, value in inner.items()}
    if node.isSeq():
        return [_values(node.at(index)) for index in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None


def _write_toml(path: Path, rig: Rig) -> None:
    caliscope = path.name.startswith(_CALISCOPE)
    # Numbers have leading zeros, because anipose sorts the tables by name: cam_10 would come before cam_2.
    digits = len(str(len(rig) - 1))
    blocks = []
    for index, name in enumerate(rig.names):
        camera = rig.cameras[index]
        fields: dict[str, Any] = {"cam_id": index} if caliscope else {}
        fields |= {
            "name": name,
            "size": [int(side) for side in camera.image_size_wh],
            "matrix": camera.K.tolist(),
            # anipose needs coefficients; zeros mean no distortion.
            "distortions": camera.dist.tolist() or [0.0] * 5,
            "rotation": Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_rotvec().tolist(),
            "translation": camera.T_cam_world[:3, 3].tolist(),
        }
        fields |= {"rotation_count": 0, "fisheye": False} if caliscope else {}
        header = f"[cameras.{index}]" if caliscope else f"[cam_{index:0{digits}d}]"
        # Lists and texts in JSON are valid TOML.
        lines = [header, *(f"{key} = {json.dumps(value)}" for key, value in fields.items())]
        blocks.append("\n".join(lines))
    if not caliscope:
        blocks.append('[metadata]\nunit = "m"')
    with atomic_write(path) as temporary:
        temporary.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")


def _write_yaml(path: Path, rig: Rig) -> None:
    with atomic_write(path) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
        if not storage.isOpened():
            raise OutputError(
                path, expected="a path that can be written", found="a folder that cannot be written"
            )
        storage.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
        for index, name in enumerate(rig.names):
            camera = rig.cameras[index]
            storage.startWriteStruct("", cv2.FILE_NODE_MAP)
            # In quotes, because OpenCV would read the names true and null as values.
            storage.write("name", json.dumps(name, ensure_ascii=False))
            # Vectors become columns, because OpenCV 4 has no arrays with camera axis.
            arrays = {
                "image_size": camera.image_size_wh.astype(np.int32)[:, None],
                "K": camera.K,
                "D": camera.dist[:, None],
                "R": camera.T_cam_world[:3, :3],
                "t": camera.T_cam_world[:3, 3:],
            }
            for key, array in arrays.items():
                if array.size:
                    storage.write(key, np.ascontiguousarray(array))
            storage.endWriteStruct()
        storage.endWriteStruct()
        storage.release()


def _by_suffix(path: Path, functions: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    function = functions.get(path.suffix.lower())
    if function is None:
        raise InputError(path, expected=f"a file that ends in {', '.join(functions)}", found=path.name)
    return function
