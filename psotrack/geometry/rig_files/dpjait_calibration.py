"""`cameras_calibration.csv` of the DPJAIT dataset: one camera per line.

`cam_x/y/z` is the translation t of x_cam = R X + t, not the camera's centre -Rᵀ t. `cam_or_x/y/z` is the Rodrigues
vector of R (world to camera). `focal_length`, `cx`, `cy` are in pixels. `coeff_1..4` are OpenCV's k1, k2, p1, p2; a
file may lack them. The header names the unit of lengths, millimetres or metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, Rig, camera_key, make_camera, make_rig
from psotrack.support import Column, Table, TextRow, read_table, write_rows

#: Units of lengths in the headers of the dataset's tables.
METRES_PER_UNIT = {"m": 1.0, "mm": 1e-3}
_RADIANS_PER_UNIT = {"rad": 1.0, "": 1.0, "deg": np.pi / 180}
_MOST_COEFFICIENTS = 4
_ADVICE = (
    "this file cannot hold that lens: write a rig.toml (a name that ends in .toml), which holds every lens"
)


def read_camera_names(path: Path | str) -> tuple[str, ...]:
    """Read the names of the cameras from a calibration file.

    Raises:
        InputError: the file cannot be read, has no column `cam_name`, or names a camera twice.
    """
    table = read_table(path)
    column = table.column("cam_name")
    names: dict[str, str] = {}
    for row in table.rows:
        name = row.text(column)
        if camera_key(name) in names:
            raise row.error(column, "each camera once", f"{name} again")
        names[camera_key(name)] = name
    return tuple(names.values())


def read_calibration(path: Path | str, image_sizes_wh: Mapping[str, tuple[int, int]]) -> Rig:
    """Read the cameras of a calibration file, in metres.

    Args:
        path: path of the file.
        image_sizes_wh: width and height of the images in pixels, by camera name; the file does not have them.

    Raises:
        InputError: the file cannot be read, a column is missing, a value is not a finite number, a camera occurs
            twice, or a focal length is not above 0. The message names line and column.
    """
    names = read_camera_names(path)
    table = read_table(path)
    translation = [table.column(f"cam_{axis}") for axis in "xyz"]
    rotation = [table.column(f"cam_or_{axis}") for axis in "xyz"]
    metres = np.array([table.factor(column, METRES_PER_UNIT) for column in translation])
    radians = np.array([table.factor(column, _RADIANS_PER_UNIT) for column in rotation])
    coefficients = _coefficient_columns(table)
    cameras = {}
    for name, row in zip(names, table.rows, strict=True):
        cameras[name] = make_camera(
            R=Rotation.from_rotvec(_numbers(row, rotation) * radians).as_matrix(),
            t_m=_numbers(row, translation) * metres,
            K=_intrinsics(table, row),
            dist=_numbers(row, coefficients).tolist(),
            image_size_wh=image_sizes_wh[name],
        )
    return make_rig(cameras)


def write_calibration(path: Path | str, rig: Rig, unit: Literal["m", "mm"] = "m") -> None:
    """Write a rig to a calibration file; `read_calibration` reads the same numbers to 1e-12.

    Distortion columns are written if a camera has distortion, as in the real half of the dataset. The simulated half
    has no such columns.

    Args:
        path: path of the file.
        rig: the cameras.
        unit: unit of lengths in the file.

    Raises:
        SettingsError: the layout cannot hold the rig: a camera has two focal lengths, skew, or coefficients beyond p2.
        OutputError: the file cannot be written.
    """
    if unit not in METRES_PER_UNIT:
        raise SettingsError("unit", expected=" or ".join(METRES_PER_UNIT), found=unit)
    _check_writable(rig)
    num_coefficients = min(rig.cameras.dist.shape[-1], _MOST_COEFFICIENTS) if rig.cameras.dist.any() else 0
    header = [
        "cam_name",
        *(f"cam_{axis}[{unit}]" for axis in "xyz"),
        *(f"cam_or_{axis}[rad]" for axis in "xyz"),
        "focal_length",
        "cx",
        "cy",
        *(f"coeff_{number + 1}" for number in range(num_coefficients)),
    ]
    rows = [_calibration_row(rig, index, unit, num_coefficients) for index in range(len(rig))]
    write_rows(path, [header, *rows])


def _calibration_row(rig: Rig, index: int, unit: str, num_coefficients: int) -> list[object]:
    camera: Camera = rig.cameras[index]
    return [
        rig.names[index],
        *(camera.T_cam_world[:3, 3] / METRES_PER_UNIT[unit]),
        *Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_rotvec(),
        *(camera.K[0, 0], camera.K[0, 2], camera.K[1, 2]),
        *camera.dist[:num_coefficients],
    ]


def _check_writable(rig: Rig) -> None:
    for name, index in zip(rig.names, range(len(rig)), strict=True):
        camera: Camera = rig.cameras[index]
        K, extra = camera.K, camera.dist[_MOST_COEFFICIENTS:]
        if camera.fisheye is not None and camera.fisheye:
            expected, found = "OpenCV's pinhole model", "a fisheye"
        elif K[0, 0] != K[1, 1]:
            expected, found = "one focal length", f"fx {K[0, 0]:.10g} and fy {K[1, 1]:.10g}"
        elif K[0, 1]:
            expected, found = "no skew", f"{K[0, 1]:g}"
        elif extra.any():
            last = _MOST_COEFFICIENTS + int(np.flatnonzero(extra)[-1]) + 1
            expected, found = "distortion by k1, k2, p1, p2 alone", f"{last} coefficients"
        else:
            continue
        raise SettingsError(f"camera {name}", expected=expected, found=found, remedy=_ADVICE)


def _intrinsics(table: Table, row: TextRow) -> Float[np.ndarray, "3 3"]:
    column = table.column("focal_length")
    focal_length_px = row.number(column)
    if focal_length_px <= 0:
        raise row.error(column, "a focal length above 0 pixels", f"{focal_length_px:g}")
    cx, cy = (row.number(table.column(name)) for name in ("cx", "cy"))
    return np.array([[focal_length_px, 0, cx], [0, focal_length_px, cy], [0, 0, 1]])


def _coefficient_columns(table: Table) -> list[Column]:
    """The columns of k1, k2, p1, p2, or an empty list."""
    present = [column for column in table.columns if column.name.startswith("coeff")]
    if not present:
        return []
    if len(present) > _MOST_COEFFICIENTS:
        raise InputError(
            table.path,
            expected=f"{_MOST_COEFFICIENTS} distortion coefficients",
            found=f"{len(present)}: {', '.join(column.header for column in present)}",
        )
    return [table.column(f"coeff_{number + 1}") for number in range(_MOST_COEFFICIENTS)]


def _numbers(row: TextRow, columns: list[Column]) -> Float[np.ndarray, " columns"]:
    return np.array([row.number(column) for column in columns], np.float64)
