"""Numbers in delimited text, read so that every complaint names its file, line and column.

Lenient where nothing can be misread: a byte order mark, Windows line ends, spaces, a separator at the end of
a line, blank lines, upper case in the header. Strict where something could: a decimal comma is refused,
because 1,156 may be a thousand.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from pathlib import Path

from psotrack.errors import InputError
from psotrack.support.files import read_text, written_whole

#: A column's name and, in brackets, its unit: `pos_x[m]`.
_HEADER = re.compile(r"(?P<name>[^\[]*?)\s*(?:\[(?P<unit>[^\]]*)\])?")


@dataclass(frozen=True)
class Column:
    """A column of a table: where it stands, its name and unit in lower case, and what the file calls it."""

    index: int
    name: str
    unit: str
    header: str


@dataclass(frozen=True)
class TextRow:
    """The cells of a line, and what it takes to say where it stands."""

    path: Path
    line: int
    cells: tuple[str, ...]

    @property
    def where(self) -> str:
        """File and line, for messages."""
        return f"{self.path}, line {self.line}"

    def text(self, column: Column) -> str:
        """The cell as it stands, not empty."""
        cell = self.cells[column.index]
        if not cell:
            raise self.wrong(column, "a value", "nothing")
        return cell

    def number(self, column: Column) -> float:
        """The cell as a finite number."""
        cell = self.text(column)
        try:
            value = float(cell)
        except ValueError:
            remedy = "write decimals with a point" if "," in cell else ""
            raise self.wrong(column, "a number", repr(cell), remedy) from None
        if not math.isfinite(value):
            raise self.wrong(column, "a finite number", repr(cell))
        return value

    def count(self, column: Column) -> int:
        """The cell as a whole number, 0 or more."""
        value = self.number(column)
        if value < 0 or value != int(value):
            raise self.wrong(column, "a whole number, 0 or more", repr(self.cells[column.index]))
        return int(value)

    def wrong(self, column: Column, expected: str, found: str, remedy: str = "") -> InputError:
        """The error that names this line and the column."""
        return InputError(
            f"{self.where}, column {column.header}", expected=expected, found=found, remedy=remedy
        )


@dataclass(frozen=True)
class Table:
    """A header and the rows below it."""

    path: Path
    columns: tuple[Column, ...]
    rows: tuple[TextRow, ...]

    def find(self, name: str) -> Column | None:
        """The column of this name, whatever its unit, or None."""
        return next((column for column in self.columns if column.name == name), None)

    def column(self, name: str) -> Column:
        """The column of this name, whatever its unit."""
        found = self.find(name)
        if found is None:
            raise InputError(
                self.path,
                expected=f"a column {name}",
                found=f"only {', '.join(column.header for column in self.columns)}",
            )
        return found

    def factor(self, column: Column, units: Mapping[str, float]) -> float:
        """What values of the column are multiplied with; `units` has a factor for each known unit."""
        if column.unit not in units:
            known = " or ".join(f"{column.name}[{unit}]" if unit else column.name for unit in units)
            raise InputError(self.path, expected=f"a column {known}", found=column.header)
        return units[column.unit]


def read_rows(path: Path, separator: str) -> list[TextRow]:
    """The lines of a text file that are not blank, cut at the separator.

    Raises:
        InputError: the file cannot be read or is no text.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        cells = tuple(cell.strip() for cell in line.split(separator))
        if any(cells):
            # One separator at the end of a line ends its last cell and starts none.
            rows.append(TextRow(path, number, cells[:-1] if len(cells) > 1 and not cells[-1] else cells))
    return rows


def read_table(path: Path, separator: str = ";") -> Table:
    """The table in a text file, whose first line names its columns.

    Raises:
        InputError: the file cannot be read, has fewer than two columns or one twice, no rows, or a row
            of another length than its header.
    """
    header, *rows = read_rows(path, separator) or [TextRow(path, 1, ("",))]
    if len(header.cells) < 2:
        found = repr(header.cells[0][:60]) if header.cells[0] else "an empty file"
        raise InputError(header.where, expected=f"columns separated by {separator!r}", found=found)
    columns = tuple(_column(index, cell) for index, cell in enumerate(header.cells))
    names = [column.name for column in columns]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(header.where, expected="each column once", found=f"{', '.join(twice)} again")
    if not rows:
        raise InputError(path, expected="rows below the header", found="none")
    for row in rows:
        if len(row.cells) != len(columns):
            raise InputError(
                row.where, expected=f"{len(columns)} values as in the header", found=f"{len(row.cells)}"
            )
    return Table(path, columns, tuple(rows))


def write_rows(path: Path, rows: Iterable[Ordered[object]], separator: str = ";") -> None:
    """Write lines of cells; floats with all their digits, so that reading gives the same numbers.

    Raises:
        OutputError: the file cannot be written.
    """
    with written_whole(path) as temporary:
        lines = (separator.join(_cell(value) for value in row) for row in rows)
        temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _cell(value: object) -> str:
    # float() because the repr of NumPy's scalars names their type.
    return repr(float(value)) if isinstance(value, float) else str(value)


def _column(index: int, cell: str) -> Column:
    match = _HEADER.fullmatch(cell.lower())
    name, unit = (match["name"], match["unit"] or "") if match else (cell.lower(), "")
    return Column(index, name, unit, cell)
