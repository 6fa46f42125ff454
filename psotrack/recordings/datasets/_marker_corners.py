"""The table of the ArUco markers on the walls: positions of the markers' corners in the world.

The layout in the published dataset is unknown. The written layout has the columns `id`, then `x1[m]`, `y1[m]`, `z1[m]`
to `x4[m]`, `y4[m]`, `z4[m]`: the corners in the order of OpenCV's ArUco, clockwise from the marker's own top left, seen
from the front.

The reader also takes:

- columns separated by commas or tabs;
- lengths in centimetres or millimetres, as in `x1[mm]`, `x1 (mm)` or `x1_mm`; without a unit, metres;
- corners 0 to 3 instead of 1 to 4, and names such as `corner1_x`;
- one row per corner: `id`, `corner`, `x`, `y`, `z`;
- markers such as `Marker_7` instead of 7.

Other columns are ignored. A table of centres alone has the columns `id`, `x`, `y` and `z`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.geometry.rig_files import UNITS_M
from psotrack.recordings.datasets._rows import lengths_of
from psotrack.support import Column, Table, TextRow, read_table, read_text, write_rows

_CORNERS = [f"{axis}{corner}" for corner in range(1, 5) for axis in "xyz"]
_METRES = UNITS_M | {"": 1.0}
#: A unit that is not in square brackets.
_UNIT = re.compile(r"(?P<name>.*?)\s*(?:\((?P<bracketed>\w+)\)|_(?P<plain>mm|cm|m))")
_IDS = re.compile("(?:id)?(?:marker|aruco|tag)(?:id)?|id|number")
_COORDINATE = re.compile("(?:corner|point|pos|c|p)?(?P<first>[0-4]?)(?P<axis>[xyz])(?P<last>[0-4]?)")
_LABEL = re.compile(
    r"(?:marker|aruco|tag|id|m)?[ _]*(\d{1,9})[ ]?[:_. -][ ]?(?:corner|c)?([0-4])", re.IGNORECASE
)
_ID = re.compile(r"(?:[a-z][a-z _:-]*)?(?P<number>\d{1,9})(?:\.0*)?", re.IGNORECASE)


@dataclass(frozen=True)
class MarkerRow:
    """The corners of a marker and their place in the file.

    Attributes:
        where: file and line, for messages.
        corners_m: (4, 3), positions in the world, metres.
    """

    where: str
    corners_m: Float[np.ndarray, "4 3"]


def read_marker_corners(path: Path | str) -> dict[int, Float[np.ndarray, "4 3"]]:
    """Read corners (4, 3) in the world, metres, by marker id.

    The shape of the markers is not checked here, but by `inside_out.marker_map`.

    Raises:
        InputError: the file cannot be read, a column or a corner is missing, an id occurs twice, or a value is not a
            number. The message names the line.
    """
    return {marker: row.corners_m for marker, row in read_marker_rows(path).items()}


def read_marker_rows(path: Path | str) -> dict[int, MarkerRow]:
    """Read corners by marker id, with their places in the file.

    Raises:
        InputError: as `read_marker_corners`.
    """
    table = _read_normalised(Path(path))
    if table.find("corner") and not table.find("x1"):
        return _rows_per_corner(table)
    corners_m = lengths_of(table, _CORNERS, _METRES)
    rows = _rows_by_marker(table)
    return {marker: MarkerRow(row.where, corners_m(row).reshape(4, 3)) for marker, row in rows.items()}


def read_marker_centres(path: Path | str) -> dict[int, Float[np.ndarray, "3"]] | None:
    """Read centres (3,) in the world, metres, by marker id, from a table with the columns `id`, `x`, `y` and `z`.

    Returns:
        The centres; None where the table is one of corners.

    Raises:
        InputError: the file cannot be read, an id occurs twice, or a value is not a number. The message names the line.
    """
    table = _read_normalised(Path(path))
    if table.find("corner") or table.find("x1") or not all(table.find(name) for name in ("id", *"xyz")):
        return None
    point_m = lengths_of(table, "xyz", _METRES)
    return {marker: point_m(row) for marker, row in _rows_by_marker(table).items()}


def split_label(label: str) -> tuple[int, int] | None:
    """Numbers of the marker and of the corner in a label such as `Marker7:1`, `M7_1` or `7.1`; None for other labels.

    The number of the corner is the label's own number; the first corner may have number 0 or 1.
    """
    match = _LABEL.fullmatch(label.strip())
    return (int(match[1]), int(match[2])) if match else None


def write_marker_corners(path: Path | str, corners_m: Mapping[int, Float[np.ndarray, "4 3"]]) -> None:
    """Write corners (4, 3) in the world, metres, by marker id.

    Raises:
        OutputError: the file cannot be written.
    """
    header = ["id", *(f"{name}[m]" for name in _CORNERS)]
    write_rows(path, [header, *([marker, *corners_m[marker].ravel()] for marker in sorted(corners_m))])


def _rows_by_marker(table: Table) -> dict[int, TextRow]:
    """Rows of a table with one row per marker."""
    column = table.column("id")
    found: dict[int, TextRow] = {}
    for row in table.rows:
        marker = _marker(row, column)
        if marker in found:
            raise row.error(column, "each marker once", f"{marker} again")
        found[marker] = row
    return found


def _rows_per_corner(table: Table) -> dict[int, MarkerRow]:
    """Corners from a table with one row per corner."""
    id_column, corner_column = table.column("id"), table.column("corner")
    point_m = lengths_of(table, "xyz", _METRES)
    first = min(1, *(row.count(corner_column) for row in table.rows))
    rows: dict[int, dict[int, TextRow]] = {}
    for row in table.rows:
        marker, corner = _marker(row, id_column), row.count(corner_column)
        if not first <= corner < first + 4:
            raise row.error(corner_column, f"a corner, {first} to {first + 3}", f"{corner}")
        if corner in rows.setdefault(marker, {}):
            expected = "each corner of a marker once"
            raise row.error(corner_column, expected, f"corner {corner} of marker {marker} again")
        rows[marker][corner] = row
    found = {}
    for marker, of_marker in rows.items():
        lines = [row.line for row in of_marker.values()]
        where = f"{table.path}, line {min(lines)}" + (f" to {max(lines)}" if len(lines) > 1 else "")
        corners = range(first, first + 4)
        missing = [f"{corner}" for corner in corners if corner not in of_marker]
        if missing:
            raise InputError(
                f"{where}, marker {marker}",
                expected="4 corners",
                found=f"none of number {', '.join(missing)}",
                remedy="add it, or leave the marker out",
            )
        found[marker] = MarkerRow(where, np.array([point_m(of_marker[corner]) for corner in corners]))
    return found


def _marker(row: TextRow, column: Column) -> int:
    match = _ID.fullmatch(row.text(column))
    if match is None:
        raise row.error(column, "a marker's number", repr(row.text(column)))
    return int(match["number"])


def _read_normalised(path: Path) -> Table:
    """Read a table and name its columns `id` and `x1` to `z4`, or `id`, `corner`, `x`, `y` and `z`."""
    header = next((line for line in read_text(path).splitlines() if line.strip(" ;,\t")), "")
    table = read_table(path, max(";,\t", key=header.count))
    columns = tuple(_named(column) for column in table.columns)
    if any(column.name == "x0" for column in columns):
        from_0 = {f"{axis}{corner}": f"{axis}{corner + 1}" for axis in "xyz" for corner in range(4)}
        columns = tuple(replace(column, name=from_0.get(column.name, column.name)) for column in columns)
    names = [column.name for column in columns]
    known = ("id", "corner", *"xyz", *_CORNERS)
    twice = [column.header for column in columns if names.count(column.name) > 1 and column.name in known]
    if twice:
        raise InputError(path, expected="each column once", found=" and ".join(twice))
    return replace(table, columns=columns)


def _named(column: Column) -> Column:
    """A column with its name as the written layout has it, and its unit; other columns keep their names."""
    name, unit = column.name, column.unit
    match = None if unit else _UNIT.fullmatch(name)
    if match is not None:
        name, unit = match["name"], match["bracketed"] or match["plain"]
    bare = re.sub(r"[\W_]", "", name)
    if _IDS.fullmatch(bare):
        return replace(column, name="id")
    if bare in ("corner", "cornerid"):
        return replace(column, name="corner")
    place = _COORDINATE.fullmatch(bare)
    if place is None:
        return column
    return replace(column, name=place["axis"] + place["first"] + place["last"], unit=unit)
