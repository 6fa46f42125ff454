"""`dronN_pos_25.csv` of the DPJAIT dataset: the poses of one simulated drone, one line per video frame.

Row i belongs to video frame i. Row 0 is a placeholder, (0, 0, -0), so that frame 0 has no pose. The names of the
orientation columns in the published files are unknown. The reader uses four columns that end in `w`, `x`, `y`, `z`
after a word with a `q` (`q_w`, `qw`, `quat_w`, ...) as the quaternion, which turns body into world coordinates. Euler
angles are not read: beside a quaternion they are redundant, and without a quaternion their order would be a guess. The
written columns are `rot_x[rad]`, `rot_y[rad]`, `rot_z[rad]`, with R = Rz Ry Rx, and `q_w`, `q_x`, `q_y`, `q_z`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.geometry import LENGTH_TOLERANCE
from psotrack.recordings.datasets._rows import lengths_of
from psotrack.support import Column, Table, TextRow, read_table, write_rows

#: Largest number of a frame, whatever the number of rows, and per row: arrays over all frames take memory.
_FRAMES, _FRAMES_PER_ROW = 1_000_000, 100

Positions = Float[np.ndarray, "frames 3"]
Orientations = Float[np.ndarray, "frames 4"]

_QUATERNION = re.compile(r"(?P<stem>[a-z_ .]*q[a-z_ .]*?)[_ .]?(?P<axis>[wxyz])")


def read_poses(path: Path | str) -> tuple[Positions, Orientations | None]:
    """Read positions (metres) and orientations (w, x, y, z) at frames 0, 1, ...; NaN for frames without a row.

    The orientations are None if the file has no quaternions.

    Raises:
        InputError: the file cannot be read, a column is missing, a frame occurs twice, or a value is not a finite
            number. The message names line and column.
    """
    table = read_table(path)
    lengths_m = lengths_of(table, ["pos_x", "pos_y", "pos_z"])
    quaternion = _quaternion_columns(table)
    rows = _rows_by_frame(table)
    position_m = np.full((max(rows) + 1, 3), np.nan)
    orientation_wxyz = np.full((max(rows) + 1, 4), np.nan)
    for frame, row in rows.items():
        here_m = lengths_m(row)
        if frame == 0 and not here_m.any():
            continue
        position_m[frame] = here_m
        if quaternion:
            orientation_wxyz[frame] = unit_quaternion(row, quaternion)
    return position_m, orientation_wxyz if quaternion else None


def poses_of_frames(path: Path, num_frames: int) -> tuple[Positions, Orientations]:
    """Positions and orientations at the first frames of a video; NaN where the file says nothing.

    Arguments and errors: see `read_poses`.
    """
    position_m, orientation_wxyz = np.full((num_frames, 3), np.nan), np.full((num_frames, 4), np.nan)
    position, orientation = read_poses(path)
    position_m[: len(position)] = position[:num_frames]
    if orientation is not None:
        orientation_wxyz[: len(position)] = orientation[:num_frames]
    return position_m, orientation_wxyz


def write_poses(path: Path | str, position_m: Positions, orientation_wxyz: Orientations) -> None:
    """Write the poses of one drone at all video frames; the pose of frame 0 is replaced by the layout's placeholder.

    Args:
        path: path of the file, with a name from `pose_file`.
        position_m: (frames, 3), positions in the world, metres.
        orientation_wxyz: (frames, 4), unit quaternions that turn body into world coordinates.

    Raises:
        SettingsError: the numbers of frames differ, there is no frame, or a number is not finite.
        OutputError: the file cannot be written.
    """
    if len(position_m) != len(orientation_wxyz) or len(position_m) == 0:
        raise SettingsError(
            "poses",
            expected="equal numbers of positions and orientations, at least one",
            found=f"{len(position_m)} positions and {len(orientation_wxyz)} orientations",
        )
    poses = np.hstack([position_m, _euler_rad(orientation_wxyz), orientation_wxyz])
    if not np.isfinite(poses[1:]).all():
        frame = int(np.argmin(np.isfinite(poses[1:]).all(axis=1))) + 1
        raise SettingsError("poses", expected="finite numbers", found=f"NaN or infinity at frame {frame}")
    header = [
        "id",
        *(f"pos_{axis}[m]" for axis in "xyz"),
        *(f"rot_{axis}[rad]" for axis in "xyz"),
        *(f"q_{axis}" for axis in "wxyz"),
    ]
    placeholder = [0, *(0.0, 0.0, -0.0), *(0.0, 0.0, 0.0), *(1.0, 0.0, 0.0, 0.0)]
    write_rows(path, [header, placeholder, *([frame, *poses[frame]] for frame in range(1, len(poses)))])


def pose_file(number: int, fps: float = 25.0) -> str:
    """Name of the pose file of drone `number`, 1-based."""
    return f"dron{number}_pos_{fps:g}.csv"


def _euler_rad(orientation_wxyz: Orientations) -> Positions:
    """Angles about x, y, z in radians, with R = Rz Ry Rx."""
    return Rotation.from_quat(orientation_wxyz, scalar_first=True).as_euler("xyz")


def _quaternion_columns(table: Table) -> list[Column]:
    """The columns of w, x, y, z, or an empty list."""
    stems: dict[str, dict[str, Column]] = {}
    for column in table.columns:
        match = _QUATERNION.fullmatch(column.name)
        if match:
            stems.setdefault(match["stem"], {})[match["axis"]] = column
    complete = [axes for axes in stems.values() if len(axes) == 4]
    return [complete[0][axis] for axis in "wxyz"] if complete else []


def unit_quaternion(row: TextRow, columns: list[Column]) -> Float[np.ndarray, "4"]:
    """The quaternion in four columns of a row, with length 1; raise `InputError` for another length."""
    quaternion = np.array([row.number(column) for column in columns])
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > LENGTH_TOLERANCE:
        raise row.error(columns[0], "a quaternion of length 1", f"length {norm:g}")
    return quaternion / norm


def _rows_by_frame(table: Table) -> dict[int, TextRow]:
    """Rows by the numbers of the frames in the column `id`.

    Raises:
        InputError: a number is no whole number or is far above the number of rows, or a frame occurs twice. The message
            names the line.
    """
    column = table.column("id")
    rows: dict[int, TextRow] = {}
    for row in table.rows:
        frame = row.count(column)
        if frame in rows:
            raise row.error(column, "each frame once", f"{frame} again, after line {rows[frame].line}")
        rows[frame] = row
    last, most = max(rows), max(_FRAMES, _FRAMES_PER_ROW * len(rows))
    if last > most:
        expected = f"a frame number of at most {most} in a file of {len(rows)} rows"
        raise rows[last].error(column, expected, f"{last}")
    return rows


#: Columns of the positions of a drone's motion-capture markers in the world, after `id`, the number of the frame. The
#: published layout is unknown. Unlike in the pose files, the line of frame 0 is a measurement, not a placeholder.
_MARKER_COLUMNS = [f"{marker}_{axis}[m]" for marker in "ABCD" for axis in "xyz"]


def mocap_markers_file(number: int, fps: float = 25.0) -> str:
    """Name of the file of drone `number`, 1-based."""
    return f"dron{number}_markers_{fps:g}.csv"


def write_mocap_markers(path: Path | str, markers_m: Float[np.ndarray, "frames 4 3"]) -> None:
    """Write the marker positions of one drone, (frames, 4, 3), in the world, metres.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = ([frame, *values] for frame, values in enumerate(markers_m.reshape(-1, len(_MARKER_COLUMNS))))
    write_rows(path, [["id", *_MARKER_COLUMNS], *rows])
