"""Text files: the DPJAIT dataset's table, DLT coefficients, Argus's profile of lenses, the blocks of handpose3d.

**DPJAIT**'s `cameras_calibration.csv` has one camera per line. `cam_x/y/z` is the translation t of x_cam = R X + t, not
the camera's centre -Rᵀ t. `cam_or_x/y/z` is the Rodrigues vector of R (world to camera). `focal_length`, `cx`, `cy` are
in pixels. `coeff_1..4` are OpenCV's k1, k2, p1, p2; a file may lack them. The header names the unit of lengths,
millimetres or metres.

**Direct linear transformation** (DLT) has 11 coefficients per camera, as DLTdv, easyWand and Argus write them:

    u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1)
    v = (L5 X + L6 Y + L7 Z + L8) / (L9 X + L10 Y + L11 Z + 1)

A file has 11 lines of numbers, one column per camera; 11 numbers per line and one line per camera are read too. The
unit of X, Y, Z is open. Argus and DLTdv before version 8 measure v upwards from the lower edge of the image, DLTdv8 and
other programs downwards; the sign of the determinant of the 3 x 3 part says which, if the world's origin is in front of
the cameras, as a calibration object or a wand at the origin is. A camera alone with the other sign has the origin
behind it.

Upwards, v is the image's height less the row, where the first row is 0; u is 0 in the first column. That is Argus's
count (`DLCclicker.py` and `frameFinderPyglet.py` of https://github.com/backyardbiomech/argus_gui). DLTdv, in MATLAB,
counts columns from 1 (and DLTdv8 rows, too; `dlt_invert.m` of https://github.com/tlhedrick/dltdv changes from one
origin to the other). Places from its files are therefore shown 1 pixel too far to the right (and below): a file does
not say which program wrote it. There is no lens distortion: pixels must be undistorted ones.

**Argus**'s profile has a line `camera fx w h cx cy AR k1 k2 t1 t2 k3` per camera, no poses. AR is fy / fx; k1, k2, t1,
t2, k3 are OpenCV's k1, k2, p1, p2, k3. The format: `docs/user-guide.md` of the same repository (there k1, k2, k3 are
r2, r4, r6). Argus takes cy and t1 for pixels counted upwards where it undistorts clicked points
(`tools.undistort_pts`), but estimates them on images, downwards (`patterns`). Here they are those of images; the two
differ only if cy is not in the middle or t1 is not 0. Argus undistorts with fx alone; AR is 1 in its profiles.

**handpose3d** has blocks `intrinsic:`, `distortion:`, `R:` and `T:`, each followed by lines of numbers.

`c0.dat` has the lens of the first camera, `rot_trans_c0.dat` beside it the pose, x_cam = R X + T; the unit is open. All
cameras of the folder are read. A second `R:` and `T:`, from the first camera to this one, is left alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, Rig, camera_key
from psotrack.geometry.rig_files.fields import UNITS_M, CameraFields
from psotrack.support import Column, Table, TextRow, are_numbers, read_table, read_text, write_rows

_RADIANS_PER_UNIT = {"rad": 1.0, "": 1.0, "deg": np.pi / 180}
_MOST_COEFFICIENTS = 4
_ADVICE = (
    "this file cannot hold that lens: write a rig.toml (a name that ends in .toml), which holds every lens"
)
_COEFFICIENTS = 11
#: Largest condition number of the 3 x 3 part. That of a camera is below the square of its focal length in pixels.
_LARGEST_CONDITION = 1e12
_ARGUS = ("camera", "fx", "w", "h", "cx", "cy", "AR", "k1", "k2", "t1", "t2", "k3")
_POSE = "rot_trans_"
_KEYS = {"intrinsic": "K", "distortion": "D", "R": "R", "T": "t"}


def is_dpjait(text: str) -> bool:
    """Whether the first line of a text names the dataset's column of cameras."""
    return "cam_name" in text.partition("\n")[0]


def read_dpjait(path: Path, text: str) -> Iterator[CameraFields]:
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
        cx, cy = _numbers_of(row, middle)
        values = {
            "K": [[f, 0, cx], [0, f, cy], [0, 0, 1]],
            "D": _numbers_of(row, coefficients),
            "rvec": _numbers_of(row, rotation) * radians,
            # In units of the first column.
            "t": _numbers_of(row, translation) * (metres / metres[0]),
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


def _numbers_of(row: TextRow, columns: list[Column]) -> Float[np.ndarray, " columns"]:
    return np.array([row.number(column) for column in columns], np.float64)


def is_dlt(text: str) -> bool:
    """Whether a text is a table of 11 numbers per camera."""
    return _COEFFICIENTS in _numbers(text)[0].shape


def is_argus(text: str) -> bool:
    """Whether a text is a table of 12 numbers per line, with an image size where Argus has it."""
    values = _numbers(text)[0]
    if values.shape[1] != len(_ARGUS):
        return False
    sizes = values[:, 2:4]
    return bool((sizes >= 1).all() and (sizes == np.round(sizes)).all())


def read_argus(path: Path, text: str) -> Iterator[CameraFields]:
    """Read the lenses; no camera is placed."""
    values = _numbers(text)[0]
    if values.shape[1] != len(_ARGUS):
        raise InputError(path, expected=f"lines of {' '.join(_ARGUS)}", found="other text")
    for number, fx, width, height, cx, cy, aspect, *dist in values.tolist():
        K = [[fx, 0, cx], [0, fx * aspect, cy], [0, 0, 1]]
        name = f"cam{number:.9g}"
        yield CameraFields(path, name, {"size": [width, height], "K": K, "D": dist}, name)


def read_dlt(path: Path, text: str) -> Iterator[CameraFields]:
    """Read DLT coefficients; the unit of length is open."""
    values, header = _numbers(text)
    if _COEFFICIENTS not in values.shape:
        found = " x ".join(map(str, values.shape)) if values.size else "other text"
        raise InputError(path, expected="11 lines of numbers, one column per camera", found=found)
    by_column = len(values) == _COEFFICIENTS
    columns = values.T if by_column else values
    named = by_column and len(header) == len(columns)
    names = header if named else [f"cam{index + 1}" for index in range(len(columns))]
    matrices = [_projection(path, name, column) for name, column in zip(names, columns, strict=True)]
    signs = np.sign([np.linalg.det(matrix[:, :3]) for matrix in matrices])
    if not signs.sum():
        raise InputError(
            path,
            expected="cameras most of which have the world's origin in front of them",
            found="as many with it behind, so that the direction of v is not known",
        )
    upwards = bool(signs.sum() < 0)
    for name, matrix in zip(names, matrices, strict=True):
        K, R, t = _parts_of(matrix * [[1.0], [-1.0], [1.0]] if upwards else matrix)
        values_of = {"K": K, "R": R, "t": t, "rows_upwards": upwards}
        yield CameraFields(path, f"camera {name}", values_of, name)


def _projection(path: Path, name: str, column: Float[np.ndarray, "11"]) -> Float[np.ndarray, "3 4"]:
    """The projection matrix of 11 coefficients."""
    fields = CameraFields(path, f"camera {name}", {"coefficients": column})
    P = np.append(fields.array(("coefficients",), (_COEFFICIENTS,)), 1.0).reshape(3, 4)
    if np.linalg.cond(P[:, :3]) > _LARGEST_CONDITION:
        raise fields.error("", "the coefficients of a camera", "a determinant of 0")
    return P


def _parts_of(
    P: Float[np.ndarray, "3 4"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """K, R and t of a projection matrix, which may have any scale and sign."""
    P = P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3])
    K, R = rq(P[:, :3])
    flip = np.sign(np.diag(K))
    K, R = K * flip, flip[:, None] * R
    return K / K[2, 2], R, np.linalg.solve(K, P[:, 3])


def _numbers(text: str) -> tuple[Float[np.ndarray, "rows columns"], Sequence[str]]:
    """The numbers of a text and the words of a line above them; an empty table if the text is no table of numbers."""
    rows = [
        [word.strip("\"'") for word in re.split(r"[,;\t ]+", line.strip().strip(",;"))]
        for line in text.splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    header: list[str] = []
    if rows and not are_numbers(rows[0]):
        header, *rows = rows
    if not rows or len({len(row) for row in rows}) > 1 or not all(map(are_numbers, rows)):
        return np.zeros((0, 0)), header
    return np.array(rows, np.float64), header


def is_handpose3d(text: str) -> bool:
    """Whether a text has such blocks."""
    return bool(re.match(r"\s*(intrinsic|R):", text)) and bool(re.search(r"^(distortion|T):", text, re.M))


def read_handpose3d(path: Path, text: str) -> Iterator[CameraFields]:
    """Read the cameras of a folder; the unit of length is open."""
    folder, suffix = path.parent, path.suffix
    numbered = re.compile(rf"(?:{_POSE})?(\w*?\d+){re.escape(suffix)}")
    stems = {match[1] for each in folder.iterdir() if (match := numbered.fullmatch(each.name))}
    stems |= {path.stem.removeprefix(_POSE)}
    for stem in sorted(stems, key=lambda stem: (len(stem), stem)):
        paths = [folder / f"{prefix}{stem}{suffix}" for prefix in ("", _POSE)]
        values: dict[str, object] = {}
        for each in paths:
            values |= _blocks(each) if each.exists() else {}
        if values:
            # Videos of handpose3d are named cam0, its calibrations c0.
            name = f"cam{stem[1:]}" if re.fullmatch(r"c\d+", stem) else stem
            yield CameraFields(paths[0], "", values, name)


def _blocks(path: Path) -> dict[str, object]:
    found: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        if words[0].endswith(":"):
            rows = []
            found.setdefault(_KEYS.get(words[0].rstrip(":"), ""), rows)
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            where = f"{path}, line {number}"
            raise InputError(where, expected="numbers", found=repr(line[:60])) from None
    found.pop("", None)
    return {key: value[0] if key == "D" and value else value for key, value in found.items()}
