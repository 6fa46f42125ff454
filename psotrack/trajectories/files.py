"""Trajectory files: CSV and Parquet tables with one row per frame and drone.

Written files have the columns of `columns.ALL_COLUMNS` in this order, those of covariances and orientations only
if these are known, so that other programs can rely on them. A file to be read needs only `frame`, `drone` and the
position; rows and columns may have any order, and further columns are ignored.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from psotrack.errors import InputError, check_positive
from psotrack.geometry import LENGTH_TOLERANCE
from psotrack.support import (
    LARGEST,
    MODERATE,
    atomic_write,
    first_repeat,
    first_repeated,
    first_true,
    has_negative_eigenvalue,
    read_text,
    refuse_to_overwrite,
)
from psotrack.trajectories.columns import ALL_COLUMNS, PARTS, columns_of, is_known
from psotrack.trajectories.tracks import Status
from psotrack.trajectories.trajectories import QUANTITIES, Trajectories

if TYPE_CHECKING:
    import pyarrow as pa

_Column = Shaped[np.ndarray, "rows"]
_Columns = Mapping[str, _Column]
#: Version of the columns' names, units and words; a change of meaning needs a new version.
SCHEMA_VERSION = 1

#: Numbers of frames times drones that are never refused, and per row of a file.
_LEAST_CELLS, _CELLS_PER_ROW = 1_000_000, 100
_REQUIRED = ("frame", "drone", "x_m", "y_m", "z_m")
_WORDS = ("drone", "status")
#: Separators of columns that other programs write.
_SEPARATORS = {";": "semicolons", "\t": "tabs"}
#: Index of the covariance column for each element of the matrix.
_PLACES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_STATUS = {status.label: status for status in Status}


def write_trajectories(path: Path | str, trajectories: Trajectories, *, force: bool = False) -> None:
    """Write a table with one row per frame and drone, sorted by frame.

    CSV numbers have the fewest digits that give the same number in the array's own precision, and equal trajectories
    give equal bytes. Parquet has float64, with units and schema version as key-value metadata. Unknown values are empty
    fields. If the status is unknown, drones with a position are `tracked` and drones without a position are `lost`.

    Args:
        path: path that ends in .csv or .parquet.
        trajectories: the trajectories.
        force: replace an existing file.

    Raises:
        InputError: the path has another suffix.
        OutputError: the file exists and `force` is not set, or it cannot be written; an older file is unchanged.
    """
    path = Path(path)
    write = _by_suffix(path, {".csv": _write_csv, ".parquet": _write_parquet})
    refuse_to_overwrite(path, force)
    columns = columns_of(trajectories)
    with atomic_write(path) as temporary:
        write(temporary, columns)


def write_ambiguity(
    path: Path | str,
    time_s: Float[np.ndarray, "frames"],
    pairs: Int[np.ndarray, "pairs 2"],
    ambiguity: Float[np.ndarray, "frames pairs"],
) -> None:
    """Write the probabilities that the labels of two drones are exchanged, one row per frame and pair above 0.

    Args:
        path: path of the CSV file with the columns `frame`, `time_s`, `drone`, `other`, `ambiguity`.
        time_s: (frames,), times of the frames, seconds.
        pairs: (pairs, 2), indices of the two drones.
        ambiguity: (frames, pairs), probability that the labels of a pair are exchanged.

    Raises:
        OutputError: the file cannot be written.
    """
    frame, pair = np.nonzero(ambiguity)
    columns = {
        "frame": frame,
        "time_s": time_s[frame],
        "drone": pairs[pair, 0],
        "other": pairs[pair, 1],
        "ambiguity": ambiguity[frame, pair].astype(np.float32),
    }
    with atomic_write(path) as temporary:
        _write_csv(temporary, columns)


def read_trajectories(path: Path | str, *, fps: float | None = None) -> Trajectories:
    """Read a table with the columns `frame`, `drone`, `x_m`, `y_m`, `z_m`, and optionally the other written columns.

    A drone without a row in a frame, or with an empty position, has the position NaN and the status `lost`. Names of
    drones may be numbers. The drones have the order of their first rows.

    Args:
        path: path that ends in .csv or .parquet.
        fps: frames per second, for rows without `time_s`.

    Raises:
        InputError: the file does not exist, a line is broken, a column is missing, a frame number is not a whole
            number, a frame and drone have two rows, a frame has two times, times do not increase, or
            there is neither a time nor `fps`. The
            message names file and line.
    """
    path = Path(path)
    if fps is not None:
        check_positive("fps", fps)
    read = _by_suffix(path, {".csv": _read_csv, ".parquet": _read_parquet})
    if not path.is_file():
        raise InputError(path, expected="a file of trajectories", found="no such file")
    return from_rows(path, read(path), fps)


@dataclass(frozen=True)
class DroneRows:
    """The rows of a file, each about one drone in one frame.

    Attributes:
        columns: values by column name; `_REQUIRED` at least.
        place: gives file and line of a row, for messages.
    """

    columns: _Columns
    place: Callable[[int], str]

    def error(self, row: int, *, expected: str, found: object) -> InputError:
        """Error whose message names file and line of a row."""
        return InputError(self.place(row), expected=expected, found=f"{found}")


def check_cells(where: object, num_frames: int, num_drones: int, num_rows: int) -> None:
    """Raise `InputError` where arrays over frames and drones would be large and nearly empty.

    Args:
        where: the file, for the message.
        num_frames: number of frames.
        num_drones: number of drones.
        num_rows: number of rows of the file.
    """
    most = max(_LEAST_CELLS, _CELLS_PER_ROW * num_rows)
    if num_frames * num_drones > most:
        found = f"{num_frames} frames and {num_drones} drones in {num_rows} rows"
        raise InputError(where, expected="drones that are there in most frames", found=found)


def _by_suffix(path: Path, functions: Mapping[str, Callable]) -> Callable:
    if path.suffix not in functions:
        expected = f"a name that ends in {' or '.join(functions)}"
        raise InputError(path, expected=expected, found=repr(path.name))
    return functions[path.suffix]


# Writing


def _write_csv(path: Path, columns: _Columns) -> None:
    path.write_text(csv_text(columns), encoding="utf-8", newline="")


def csv_text(columns: _Columns, *, header: bool = True) -> str:
    """The rows of a CSV file, below the names of the columns if there is a header."""
    # NumPy writes the shortest digits that read back as the same number in the array's own precision.
    words = [np.where(is_known(column), column.astype(str), "") for column in columns.values()]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([columns] if header else [])
    writer.writerows(zip(*words, strict=True))
    return text.getvalue()


def _write_parquet(path: Path, columns: _Columns) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {"frame": pa.int64(), "drone": pa.string(), "num_cameras": pa.int32(), "status": pa.string()}
    units = {name: ALL_COLUMNS[name] for name in columns}
    metadata = {"psotrack.schema_version": str(SCHEMA_VERSION), "psotrack.units": json.dumps(units)}
    schema = pa.schema([(name, types.get(name, pa.float64())) for name in columns], metadata)
    arrays = [
        pa.array(columns[field.name], field.type, mask=~is_known(columns[field.name])) for field in schema
    ]
    pq.write_table(pa.table(arrays, schema=schema), path)


# Reading


def _read_csv(path: Path) -> DroneRows:
    reader = csv.reader(io.StringIO(read_text(path)), strict=True)
    lines: list[int] = []
    rows: list[list[str]] = []
    try:
        header = [name.strip() for name in next(reader, [])]
        _check_columns(path, header)
        for row in reader:
            if len(row) not in (0, len(header)):
                expected = f"{len(header)} fields as in the first line"
                raise InputError(f"{path}, line {reader.line_num}", expected=expected, found=f"{len(row)}")
            if row:
                lines.append(reader.line_num)
                rows.append(row)
    except csv.Error as error:
        raise InputError(path, expected="a CSV table", found=f"{error}") from error

    def number(line: int, word: str, name: str) -> float:
        try:
            return float(word or "nan")
        except ValueError:
            remedy = "write decimals with a point" if "," in word else ""
            raise InputError(
                f"{path}, line {line}", expected=f"a number in {name}", found=repr(word), remedy=remedy
            ) from None

    columns: dict[str, np.ndarray] = {}
    for name in [name for name in ALL_COLUMNS if name in header]:
        words = [row[header.index(name)].strip() for row in rows]
        if name in _WORDS:
            columns[name] = np.array(words, object)
        else:
            columns[name] = np.array([number(*item, name) for item in zip(lines, words, strict=True)], float)
    return DroneRows(columns, lambda row: f"{path}, line {lines[row]}")


def _read_parquet(path: Path) -> DroneRows:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # A column of one repeated value takes next to no bytes in the file.
        rows, most = pq.read_metadata(path).num_rows, max(_LEAST_CELLS, path.stat().st_size)
        if rows > most:
            expected = f"at most {most} rows in a file of {path.stat().st_size} bytes"
            raise InputError(path, expected=expected, found=f"{rows}")
        table = pq.read_table(path)
        names = table.column_names
    # A damaged file is also found by errors of Python in the library.
    except (pa.ArrowException, OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(path, expected="a Parquet file", found=f"{error}".partition("\n")[0]) from error
    _check_columns(path, names)
    columns = {name: _parquet_column(path, table, name) for name in ALL_COLUMNS if name in names}
    return DroneRows(columns, lambda row: f"{path}, row {row + 1}")


def _parquet_column(path: Path, table: pa.Table, name: str) -> _Column:
    import pyarrow as pa

    column = table.column(name)
    try:
        if name not in _WORDS:
            return column.cast(pa.float64()).to_numpy().astype(float)
        words = column.cast(pa.string()).to_pylist()
    except (pa.ArrowException, ValueError):
        expected = f"{'words' if name in _WORDS else 'numbers'} in {name}"
        raise InputError(path, expected=expected, found=f"{column.type}") from None
    return np.array([word or "" for word in words], object)


def _check_columns(path: Path, names: list[str]) -> None:
    other = next((word for mark, word in _SEPARATORS.items() if len(names) == 1 and mark in names[0]), "")
    if other:
        remedy = "write commas between columns, and points in decimals"
        raise InputError(path, expected="columns separated by commas", found=other, remedy=remedy)
    missing = [name for name in _REQUIRED if name not in names]
    twice = [name for name in ALL_COLUMNS if names.count(name) > 1]
    if missing or twice:
        raise InputError(
            path,
            expected=f"each of the columns {', '.join(_REQUIRED)} once",
            found=f"{', '.join(missing)} missing" if missing else f"{', '.join(twice)} twice",
        )


def from_rows(path: Path, rows: DroneRows, fps: float | None = None) -> Trajectories:
    """Trajectories of the rows of a file, in any order; the drones have the order of their first rows.

    Args:
        path: the file, for messages.
        rows: the rows.
        fps: frames per second, for rows without `time_s`.

    Raises:
        InputError: see `read_trajectories`.
    """
    columns = rows.columns
    if not len(columns["frame"]):
        raise InputError(path, expected="at least one row", found="none")
    _check_values(rows)
    frame, frame_index = np.unique(columns["frame"].astype(np.int64), return_inverse=True)
    drones: dict[str, int] = {}
    drone_index = np.array([drones.setdefault(name, len(drones)) for name in columns["drone"]])
    check_cells(path, len(frame), len(drones), len(frame_index))
    cell = frame_index * len(drones) + drone_index
    if (row := first_repeated(cell)) is not None:
        found = f"a second row for frame {frame[frame_index[row]]} and drone {columns['drone'][row]}"
        raise rows.error(row, expected="one row per frame and drone", found=found)
    shape = (len(frame), len(drones))
    quantities: dict[str, Any] = {}
    known = {name for name, each in columns.items() if each.dtype == object or np.isfinite(each).any()}
    for name, parts in PARTS.items():
        if name != "position_m" and not known >= {*parts}:
            continue
        values = np.full((len(frame) * len(drones), len(parts)), Status.LOST if name == "status" else np.nan)
        words = [_STATUS[word] for word in columns["status"]] if name == "status" else None
        values[cell] = np.stack([columns[part] if words is None else words for part in parts], axis=-1)
        quantities[name] = values[:, _PLACES] if QUANTITIES[name] == (3, 3) else values
        quantities[name] = quantities[name].reshape(*shape, *QUANTITIES[name])
    for name in {"num_cameras", "status"} & quantities.keys():
        quantities[name] = np.nan_to_num(quantities[name]).astype(np.int64)
    return Trajectories(
        frame=frame, time_s=_times(rows, frame, frame_index, fps), drones=tuple(drones), **quantities
    )


def _check_values(rows: DroneRows) -> None:
    columns = rows.columns
    for name, values in columns.items():
        if name == "drone":
            wrong, expected = values == "", "a name"
        elif name == "status":
            wrong, expected = ~np.isin(values, list(_STATUS)), f"one of {', '.join(_STATUS)}"
        elif name == "frame":
            wrong, expected = ~_whole(values), "a whole number from 0"
        elif name == "num_cameras":
            wrong, expected = ~(_whole(values) | np.isnan(values)), "a whole number from 0, or nothing"
        else:
            wrong, expected = np.abs(values) > LARGEST, f"{MODERATE}, or nothing"
        if (row := first_true(wrong)) is not None:
            raise rows.error(row, expected=f"{expected} in {name}", found=repr(values.tolist()[row]))
    for quantity in ("orientation_wxyz", "covariance_m2", "relative_covariance_m2"):
        names = PARTS[quantity]
        if not all(name in columns for name in names):
            continue
        together = np.stack([columns[name] for name in names], axis=-1)
        length = np.linalg.norm(together, axis=-1)
        if quantity == "orientation_wxyz":
            wrong, expected = np.abs(length - 1) > LENGTH_TOLERANCE, "a unit quaternion"
        else:
            wrong, expected = has_negative_eigenvalue(together[:, _PLACES]), "a covariance"
        if (row := first_true(wrong)) is not None:
            found = f"length {length[row]:g}"
            if quantity != "orientation_wxyz":
                found = f"a matrix with a negative eigenvalue, {together[row].tolist()}"
            raise rows.error(row, expected=f"{expected} in {', '.join(names)}", found=found)


def _whole(values: Float[np.ndarray, "rows"]) -> Bool[np.ndarray, "rows"]:
    # Larger numbers are not exact as floats.
    return (values >= 0) & (values < 2**53) & (values == np.floor(values))


def _times(
    rows: DroneRows, frame: Int[np.ndarray, "frames"], frame_index: Int[np.ndarray, "rows"], fps: float | None
) -> Float[np.ndarray, "frames"]:
    """(frames,), times of the frames, seconds; all rows of a frame must agree."""
    time_s = np.full(len(frame), np.nan) if fps is None else frame / fps
    given_s = rows.columns.get("time_s", np.full(len(frame_index), np.nan))
    known = np.flatnonzero(~np.isnan(given_s))
    # In reverse order, so that the time of a frame's first row is used.
    time_s[frame_index[known[::-1]]] = given_s[known[::-1]]
    wanted_s = time_s[frame_index]
    # The limit is far above rounding errors and far below the time between two frames.
    if (row := first_true(np.abs(wanted_s - given_s) > 1e-3)) is not None:
        expected = f"{wanted_s[row]:g} s as in another row of this frame"
        raise rows.error(row, expected=expected, found=f"{given_s[row]:g} s")
    if (after := first_repeat(time_s)) is not None:
        expected = f"a time after {time_s[after - 1]:g} s, that of frame {frame[after - 1]}"
        raise rows.error(
            int(np.argmax(frame_index == after)), expected=expected, found=f"{time_s[after]:g} s"
        )
    if (row := first_true(np.isnan(wanted_s))) is not None:
        raise rows.error(row, expected="a time_s, or a frame rate to compute it", found="neither")
    return time_s
