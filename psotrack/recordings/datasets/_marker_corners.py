"""The table of the ArUco markers on the walls: positions of the markers' corners in the world.

The layout in the published dataset is unknown. The written layout has the columns `id`, then `x1[m]`, `y1[m]`, `z1[m]`
to `x4[m]`, `y4[m]`, `z4[m]`: the corners in the order of OpenCV's ArUco, clockwise from the marker's own top left, seen
from the front.

The reader accepts all layouts that are unambiguous:

- columns separated by semicolons, commas or tabs;
- lengths in metres, centimetres or millimetres, as in `x1[mm]`, `x1 (mm)` or `x1_mm`; without a unit, metres;
- corners named 1 to 4, 0 to 3, or tl, tr, br, bl, as in `x1`, `corner1_x` or `tl_x`;
- one row per corner: `id`, `corner`, `x`, `y`, `z`;
- tables without a header, with 13 or 5 numbers per row.

A table with one row per marker may have a column `std_m`: the standard deviation of the positions of the marker's
corners along each axis of the world, metres. Other columns are ignored. A table of centres alone has the columns `id`,
`x`, `y` and `z`.
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
from psotrack.recordings.datasets._poses import lengths_of
from psotrack.support import Column, Table, TextRow, are_numbers, first_line, read_rows, write_rows

_Corners = Float[np.ndarray, "4 3"]
_CORNERS = [f"{axis}{corner}" for corner in range(1, 5) for axis in "xyz"]
#: Names of the columns of a table without header, by their number.
_UNNAMED = {13: ["id", *_CORNERS], 5: ["id", "corner", *"xyz"]}
_METRES = UNITS_M | {"": 1.0}
_UNIT = re.compile(r"(?P<name>.*?)\s*(?:[\[(]\s*(?P<bracketed>[^\])]*?)\s*[\])]|_(?P<plain>mm|cm|m))")
_IDS = re.compile("(?:id)?(?:marker|aruco|tag)(?:id)?|id|nr|no|number")
_CORNER = re.compile("(?:corner|vertex|point)(?:id|no|nr|number|index)?")
_NAMED = {"tl": 1, "topleft": 1, "tr": 2, "topright": 2, "br": 3, "bottomright": 3, "bl": 4, "bottomleft": 4}
_WORD = "(?:c|corner|p|pt|point|v|vertex|pos|position|coord)?"
_WHICH = rf"{_WORD}([0-4]|{'|'.join(_NAMED)})?"
#: A coordinate: x alone, or x1 and the like, or 1x and the like.
_COORDINATE = re.compile(rf"{_WHICH}([xyz]){_WHICH}")
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
        std_m: standard deviation of the positions along each axis, metres; 0 where the table has none.
    """

    where: str
    corners_m: _Corners
    std_m: float = 0.0


def read_marker_corners(path: Path | str) -> dict[int, _Corners]:
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
    std_m = lengths_of(table, ["std"], _METRES) if table.find("std") else None
    found = {}
    for marker, row in rows.items():
        value_m = 0.0 if std_m is None else float(std_m(row)[0])
        if value_m < 0:
            raise row.error(table.column("std"), "a standard deviation of 0 or more", f"{value_m:g}")
        found[marker] = MarkerRow(row.where, corners_m(row).reshape(4, 3), value_m)
    return found


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


def write_marker_corners(
    path: Path | str,
    corners_m: Mapping[int, _Corners],
    std_m: Mapping[int, float] | None = None,
) -> None:
    """Write corners (4, 3) in the world and, if given, their standard deviations along each axis, metres, by marker id.

    Raises:
        OutputError: the file cannot be written.
    """
    rows: list[list[object]] = [["id", *(f"{name}[m]" for name in _CORNERS)]]
    rows += [[marker, *corners_m[marker].ravel()] for marker in sorted(corners_m)]
    if std_m is not None:
        ends: list[object] = ["std_m", *(std_m[marker] for marker in sorted(corners_m))]
        rows = [[*row, end] for row, end in zip(rows, ends, strict=True)]
    write_rows(path, rows)


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
    id_column, column = table.column("id"), table.column("corner")
    point_m = lengths_of(table, "xyz", _METRES)
    # The first corner may have number 0 or 1.
    first = 0 if any(row.text(column) == "0" for row in table.rows) else 1
    numbers = _NAMED | {f"{first + index}": 1 + index for index in range(4)}
    rows: dict[int, dict[int, TextRow]] = {}
    for row in table.rows:
        text, marker = row.text(column), _marker(row, id_column)
        of_marker = rows.setdefault(marker, {})
        corner = numbers.get(_bare(text))
        if corner is None:
            raise row.error(column, f"a corner, {first} to {first + 3}, or tl, tr, br or bl", repr(text))
        if corner in of_marker:
            found_again = f"corner {text} of marker {marker} again"
            raise row.error(column, "each corner of a marker once", found_again)
        of_marker[corner] = row
    found = {}
    for marker, of_marker in rows.items():
        lines = [row.line for row in of_marker.values()]
        where = f"{table.path}, line {min(lines)}" + (f" to {max(lines)}" if len(lines) > 1 else "")
        missing = [f"{corner - 1 + first}" for corner in range(1, 5) if corner not in of_marker]
        if missing:
            raise InputError(
                f"{where}, marker {marker}",
                expected="4 corners",
                found=f"none of number {', '.join(missing)}",
                remedy="add it, or leave the marker out",
            )
        found[marker] = MarkerRow(where, np.array([point_m(of_marker[corner]) for corner in range(1, 5)]))
    return found


def _marker(row: TextRow, column: Column) -> int:
    match = _ID.fullmatch(row.text(column))
    if match is None:
        raise row.error(column, "a marker's number", repr(row.text(column)))
    return int(match["number"])


def _read_normalised(path: Path) -> Table:
    """Read a table and name its columns `id` and `x1` to `z4`, or `id`, `corner`, `x`, `y` and `z`."""
    line = first_line(path)
    rows = read_rows(path, next((mark for mark in ";\t" if mark in line), ","))
    if not rows:
        raise InputError(path, expected="a table of marker corners", found="an empty file")
    header = rows[0]
    if are_numbers([*header.cells]):
        if len(header.cells) not in _UNNAMED:
            expected = "a header, or numbers in rows of 13 (id, 4 corners) or 5 (id, corner, x, y, z)"
            raise InputError(header.where, expected=expected, found=f"{len(header.cells)} numbers")
        names = _UNNAMED[len(header.cells)]
        columns = tuple(Column(index, name, "", name) for index, name in enumerate(names))
    else:
        columns, rows = _columns(header), rows[1:]
    if not rows:
        raise InputError(path, expected="rows below the header", found="none")
    return Table(path, columns, tuple(_with_last_cell(row, len(columns)) for row in rows))


def _with_last_cell(row: TextRow, count: int) -> TextRow:
    # `read_rows` drops an empty cell at the end of a line.
    cells = row.cells + ("",) * (len(row.cells) == count - 1)
    if len(cells) != count:
        remedy = "a marker has four corners of three coordinates" if count >= 13 else ""
        raise InputError(row.where, expected=f"{count} values", found=f"{len(row.cells)}", remedy=remedy)
    return replace(row, cells=cells)


def _columns(header: TextRow) -> tuple[Column, ...]:
    """Columns of a header with normalised names; unknown columns keep their names."""
    columns = []
    for index, cell in enumerate(header.cells):
        text = cell.lower().strip("\"' ")
        match = _UNIT.fullmatch(text)
        name, unit = (match["name"], match["bracketed"] or match["plain"] or "") if match else (text, "")
        columns.append(Column(index, _canonical(_bare(name)), unit.removesuffix("etres"), cell))
    names = [column.name for column in columns]
    if "x0" in names and "x4" not in names:
        from_1 = {f"{axis}{number}": f"{axis}{number + 1}" for axis in "xyz" for number in range(4)}
        columns = [replace(column, name=from_1.get(column.name, column.name)) for column in columns]
    known = {"id", "corner", *"xyz", *_CORNERS}
    twice = [column.header for column in columns if names.count(column.name) > 1 and column.name in known]
    if twice:
        raise InputError(header.where, expected="each column once", found=f"{' and '.join(twice)}")
    return tuple(columns)


def _canonical(name: str) -> str:
    if _IDS.fullmatch(name):
        return "id"
    if _CORNER.fullmatch(name):
        return "corner"
    match = _COORDINATE.fullmatch(name)
    if match is None or (match[1] and match[3]):
        return name
    which = match[1] or match[3] or ""
    return f"{match[2]}{_NAMED.get(which, which)}"


def _bare(name: str) -> str:
    """A name without separators; upper and lower are top and bottom, and `left top` is `top left`."""
    name = re.sub(r"[\s_.:\"'-]", "", name.lower()).replace("upper", "top").replace("lower", "bottom")
    return re.sub("(left|right)(top|bottom)", r"\2\1", name)
