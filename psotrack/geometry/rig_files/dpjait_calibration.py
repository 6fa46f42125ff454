"""`cameras_calibration.csv` of the DPJAIT dataset: one camera per line.

`cam_x/y/z` is the translation t of x_cam = R X + t, not the camera's centre -Rᵀ t. `cam_or_x/y/z` is the Rodrigues
vector of R (world to camera). `focal_length`, `cx`, `cy` are in pixels. `coeff_1..4` are OpenCV's k1, k2, p1, p2; a
file may lack them. The header names the unit of lengths, millimetres or metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, Rig, camera_key
from psotrack.geometry.rig_files.fields import UNITS_M, CameraFields
from psotrack.support import Column, Table, TextRow, read_table, write_rows

_RADIANS_PER_UNIT = {"rad": 1.0, "": 1.0, "deg": np.pi / 180}
_MOST_COEFFICIENTS = 4
_ADVICE = (
    "this file cannot hold that lens: write a rig.toml (a name that ends in .toml), which holds every lens"
)


def recognises(text: str) -> bool:
    """Whether the first line of a text names the dataset's column of cameras."""
    return "cam_name" in text.partition("\n")[0]


def read(path: Path, text: str) -> Iterator[CameraFields]:
    """Read the cameras of a calibration file; the sizes of the images are open."""
    table = read_table(path)
    coefficients = _coefficient_columns(table)
    name_column, focal_length = table.column("cam_name"), table.column("focal_length")
    translation = [table.column(f"cam_{axis}") for axis in "xyz"]
    rotation = [table.column(f"cam_or_{axis}") for axis in "xyz"]
    middle = [table.column(name) for name in ("cx", "cy")]
    metres = np.array([table.factor(column, UNITS_M) for column in translation])
    radians = [table.factor(column, _RADIANS_PER_UNIT) for column in rotation]
    names: set[str] = set()
    for row in table.rows:
        name, f = row.text(name_column), row.number(focal_length)
        if camera_key(name) in names:
            raise row.error(name_column, "each camera once", f"{name} again")
        names.add(camera_key(name))
        if f <= 0:
            raise row.error(focal_length, "a focal length above 0 pixels", f"{f:g}")
        cx, cy = _numbers(row, middle)
        values = {
            "K": [[f, 0, cx], [0, f, cy], [0, 0, 1]],
            "D": _numbers(row, coefficients),
            "rvec": _numbers(row, rotation) * radians,
            # In units of the first column.
            "t": _numbers(row, translation) * (metres / metres[0]),
        }
        yield CameraFields(path, f"camera {name}", values, name, float(metres[0]))


def write_calibration(path: Path | str, rig: Rig, unit: Literal["m", "mm"] = "m") -> None:
    """Write a rig to a calibration file; `read_rig` reads the same numbers to 1e-12.

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
    if unit not in UNITS_M:
        raise SettingsError("unit", expected=" or ".join(UNITS_M), found=unit)
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
        *(camera.T_cam_world[:3, 3] / UNITS_M[unit]),
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
