"""Where drones are over time: pose files of the DPJAIT dataset, and files of a reference in any format.

In `dronN_pos_25.csv`, the poses of one simulated drone, row i belongs to video frame i. Row 0 is a placeholder,
(0, 0, -0), so that frame 0 has no pose. The names of the orientation columns in the published files are unknown. The
reader uses four columns that end in `w`, `x`, `y`, `z` after a word with a `q` (`q_w`, `qw`, `quat_w`, ...) as the
quaternion, which turns body into world coordinates. Euler angles are not read: beside a quaternion they are redundant,
and without a quaternion their order would be a guess. The written columns are `rot_x[rad]`, `rot_y[rad]`, `rot_z[rad]`,
with R = Rz Ry Rx, and `q_w`, `q_x`, `q_y`, `q_z`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import LENGTH_TOLERANCE
from psotrack.geometry.rig_files import UNITS_M
from psotrack.recordings import Reference, Timeline
from psotrack.recordings.mocap import marker_bodies, read_c3d
from psotrack.support import Column, Table, TextRow, first_line, read_table, write_rows
from psotrack.trajectories import Trajectories, merged, read_trajectories, resample
from psotrack.trajectories.tum import read_tum


def lengths_of(
    table: Table, names: Sequence[str], units: Mapping[str, float] = UNITS_M
) -> Callable[[TextRow], Float[np.ndarray, " names"]]:
    """A function that gives the lengths in some columns of a row, metres.

    Raises:
        InputError: a column is missing, or has another unit; in a row: a value is not a number.
    """
    columns = [table.column(name) for name in names]
    metres = np.array([table.factor(column, units) for column in columns])
    return lambda row: np.array([row.number(column) for column in columns]) * metres


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
    euler_rad = Rotation.from_quat(orientation_wxyz, scalar_first=True).as_euler("xyz")
    poses = np.hstack([position_m, euler_rad, orientation_wxyz])
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


_logger = logging.getLogger(__name__)
#: Ending of a pose file's name that states its rate, such as `dron1_pos_25`.
_RATE = re.compile(r"_(?:pos|cam)_(?P<rate>\d+(?:\.\d+)?)$")
#: Names of drones in the dataset; `drone_1` is `dron1`.
_DRONE = re.compile(r"drone?_?(?=\d+$)", re.IGNORECASE)
_SUFFIXES = (".csv", ".parquet", ".tum", ".txt", ".c3d")


#: Labels of the markers of each drone, as the user says.
Bodies = Mapping[str, Sequence[str]]


def read_reference(
    files: Sequence[Path], timeline: Timeline, bodies: Bodies | None = None, offset_s: float = 0.0
) -> Reference:
    """The reference that is in some files; each file is read once.

    Args:
        files: C3D files, TUM files, pose files of the dataset, or files of tracks.
        timeline: the recording's instants. Their rate is that of pose files whose name does not end in the rate, such
            as `dron1_pos_25.csv`, and of tracks without times.
        bodies: labels of the markers of each drone in the C3D file; None or empty: by the labels.
        offset_s: time on the recording's clock at which the files' clock shows 0, seconds.

    Raises:
        InputError: a file cannot be read, or a drone has two files.
    """
    time_s = timeline.time_s
    found = _read_files(files, timeline.rate_hz, bodies)
    truth = _at_times(found, np.arange(len(time_s)), time_s, later_s=-offset_s)
    if not truth.seen.any():
        begin_s = min(each.time_s[0] for each in found) + offset_s
        end_s = max(each.time_s[-1] for each in found) + offset_s
        _logger.warning(
            "the reference says nothing about the recording, which lasts from %.3f to %.3f s: it lasts from %.3f to "
            "%.3f s on the recording's clock; see [reference] time_offset_s",
            time_s[0], time_s[-1], begin_s, end_s,
        )  # fmt: skip
    for path, each in zip(files, found, strict=True):
        if unit := timeline.unit_of(each.time_s):
            _logger.warning("%s: its times look like %s: write seconds", path, unit)
    own = finest = max(found, key=lambda each: each.num_frames)
    if len(found) > 1:
        own = _at_times(found, finest.frame, finest.time_s, later_s=0.0)
    own = replace(own, time_s=own.time_s + offset_s)
    return Reference(truth, own, tuple(files), bodies or {}, offset_s)


def _read_files(paths: Sequence[Path], fps: float, bodies: Bodies | None) -> list[Trajectories]:
    """The reference of each file, at its own rate and with its own clock."""
    recorded = [path for path in paths if path.suffix.lower() == ".c3d"]
    if bodies and len(recorded) != 1:
        found_files = ", ".join(path.name for path in recorded) or "none"
        raise InputError(
            f"bodies {', '.join(bodies)}", expected="one C3D file that holds their markers", found=found_files
        )
    found = [_read(path, fps, bodies) for path in paths]
    places: dict[str, Path] = {}
    for path, reference in zip(paths, found, strict=True):
        for drone in reference.drones:
            if drone in places:
                raise InputError(
                    path, expected="one file per drone", found=f"{drone} in {places[drone]} as well"
                )
            places[drone] = path
    return found


def _at_times(
    references: Sequence[Trajectories],
    frame: Int[np.ndarray, "frames"],
    time_s: Float[np.ndarray, "frames"],
    *,
    later_s: float,
) -> Trajectories:
    """One reference of all drones at given times; NaN where a file says nothing.

    Args:
        references: references of different drones, at least one.
        frame: (frames,), numbers of the frames.
        time_s: (frames,), times of the frames, seconds.
        later_s: the clock of the references shows t + `later_s` at time t, seconds.
    """
    parts = [resample(reference, frame, time_s, later_s=later_s) for reference in references]
    return merged(parts, [frame] * len(parts), lambda _: time_s)


def _read(path: Path, fps: float, bodies: Bodies | None) -> Trajectories:
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        return marker_bodies(read_c3d(path), path, bodies)
    if suffix in (".tum", ".txt"):
        return read_tum(path)
    if suffix == ".parquet" or (suffix == ".csv" and "x_m" in first_line(path)):
        return read_trajectories(path, fps=fps)
    if suffix == ".csv":
        return _read_pose_file(path, fps)
    raise InputError(path, expected=f"a file that ends in {', '.join(_SUFFIXES)}", found=path.name)


def _read_pose_file(path: Path, fps: float) -> Trajectories:
    rate = _RATE.search(path.stem)
    position_m, orientation_wxyz = read_poses(path)
    frame = np.arange(len(position_m))
    return Trajectories(
        frame,
        frame / (fps if rate is None else float(rate["rate"])),
        (_DRONE.sub("dron", path.stem if rate is None else path.stem[: rate.start()]),),
        position_m[:, None],
        orientation_wxyz=None if orientation_wxyz is None else orientation_wxyz[:, None],
    )
