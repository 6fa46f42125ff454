"""Tables in delimited text (CSV), and lines of numbers, with error messages that name file, line and column.

The readers accept a byte order mark, Windows line ends, spaces, a separator at the end of a line, blank lines, and
upper case in the header. They refuse a decimal comma, because 1,156 may also mean 1156.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.support.files import atomic_write, read_text
from psotrack.support.numbers import MODERATE, is_moderate

_SEPARATOR = re.compile(r"\s*,\s*|\s+")


def number_words(line: str) -> list[str]:
    """The words of a line."""
    return [word for word in _SEPARATOR.split(line.strip()) if word]


def are_numbers(words: list[str]) -> bool:
    """Whether all words are numbers, and there is at least one."""
    try:
        return bool([float(word) for word in words])
    except ValueError:
        return False


def first_line(path: Path) -> str:
    """The first line that is neither empty nor a comment; empty if there is none.

    Raises:
        InputError: the file cannot be read as text.
    """
    lines = (line.strip() for line in read_text(path).splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "")


@dataclass(frozen=True)
class NumberLines:
    """The numbers of a file.

    Attributes:
        path: the file.
        values: (rows, columns), the numbers of the lines that are neither empty nor comments.
        lines: numbers of these lines in the file, from 1.
    """

    path: Path
    values: Float[np.ndarray, "rows columns"]
    lines: list[int]

    def error(self, row: int, *, expected: str, found: str) -> InputError:
        """Error whose message names file and line of a row."""
        return InputError(f"{self.path}, line {self.lines[row]}", expected=expected, found=found)


def read_numbers(path: Path, columns: int, expected: str, *, more: bool = False) -> NumberLines:
    """The numbers of all lines that are neither empty nor comments.

    Args:
        path: the file.
        columns: numbers per line.
        expected: noun phrase for a line, for messages.
        more: whether lines may have further numbers, which are ignored.

    Raises:
        InputError: the file cannot be read, has no line with numbers, or a line has too few or too many numbers, or a
            number that is not finite. The message names file and line.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = number_words(line)
        values = [float(word) for word in words[:columns]] if are_numbers(words[:columns]) else []
        if len(values) < columns or (len(words) > columns and not more) or not all(map(is_moderate, values)):
            found = repr(line.strip()[:80])
            # Decimal commas look like twice the numbers.
            points = ", with decimal points" if len(line.split()) == columns < len(words) else ""
            raise InputError(f"{path}, line {number}", expected=f"{expected}{points}", found=found)
        rows.append(values)
        lines.append(number)
    if not rows:
        raise InputError(path, expected="at least one line with numbers", found="none")
    return NumberLines(path, np.array(rows), lines)


#: Largest number of characters of a cell, so that no search in a cell takes long.
_LONGEST_CELL = 1000
#: Largest whole number: NumPy's integers of any size hold it.
_LARGEST_COUNT = 2**31 - 1
#: A column's name and, in brackets, its unit: `pos_x[m]`.
_HEADER = re.compile(r"(?P<name>[^\[]*?)\s*(?:\[(?P<unit>[^\]]*)\])?")


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        index: number of the column in a row, from 0.
        name: name in lower case, without the unit.
        unit: unit in lower case; "" if the header has none.
        header: text of the header's cell, for messages.
    """

    index: int
    name: str
    unit: str
    header: str


@dataclass(frozen=True)
class TextRow:
    """The cells of one line.

    Attributes:
        path: file of the line.
        line: number of the line in the file, from 1.
        cells: texts of the cells, without spaces around them.
    """

    path: Path
    line: int
    cells: tuple[str, ...]

    @property
    def where(self) -> str:
        """File and line, for messages."""
        return f"{self.path}, line {self.line}"

    def text(self, column: Column) -> str:
        """Text of a cell. An empty cell is an error."""
        cell = self.cells[column.index]
        if not cell:
            raise self.error(column, "a value", "nothing")
        return cell

    def number(self, column: Column) -> float:
        """Value of a cell as a finite number."""
        cell = self.text(column)
        try:
            value = float(cell)
        except ValueError:
            remedy = "write decimals with a point" if "," in cell else ""
            raise self.error(column, "a number", repr(cell), remedy) from None
        if not math.isfinite(value):
            raise self.error(column, "a finite number", repr(cell))
        if not is_moderate(value):
            raise self.error(column, MODERATE, repr(cell))
        return value

    def count(self, column: Column) -> int:
        """Value of a cell as a whole number, 0 or more."""
        value = self.number(column)
        if value < 0 or value != int(value):
            raise self.error(column, "a whole number, 0 or more", repr(self.cells[column.index]))
        if value > _LARGEST_COUNT:
            raise self.error(
                column, f"a whole number of at most {_LARGEST_COUNT}", repr(self.cells[column.index])
            )
        return int(value)

    def error(self, column: Column, expected: str, found: str, remedy: str = "") -> InputError:
        """Error whose message names this line and the column."""
        return InputError(
            f"{self.where}, column {column.header}", expected=expected, found=found, remedy=remedy
        )


@dataclass(frozen=True)
class Table:
    """A table: the columns of the header, and the rows below the header."""

    path: Path
    columns: tuple[Column, ...]
    rows: tuple[TextRow, ...]

    def find(self, name: str) -> Column | None:
        """Column with this name and any unit, or None."""
        return next((column for column in self.columns if column.name == name), None)

    def column(self, name: str) -> Column:
        """Column with this name and any unit. A missing column is an error."""
        found = self.find(name)
        if found is None:
            raise InputError(
                self.path,
                expected=f"a column {name}",
                found=f"only {', '.join(column.header for column in self.columns)}",
            )
        return found

    def factor(self, column: Column, units: Mapping[str, float]) -> float:
        """Factor that converts the column's values to the unit that has the factor 1 in `units`.

        Args:
            column: the column.
            units: factor of each unit that is allowed.
        """
        if column.unit not in units:
            allowed = " or ".join(f"{column.name}[{unit}]" if unit else column.name for unit in units)
            raise InputError(self.path, expected=f"a column {allowed}", found=column.header)
        return units[column.unit]


def read_rows(path: Path | str, separator: str) -> list[TextRow]:
    """Read the lines of a text file that are not blank, split at the separator.

    Raises:
        InputError: the file cannot be read, is not text, or has a cell of more than 1000 characters.
    """
    path = Path(path)
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        cells = tuple(cell.strip() for cell in line.split(separator))
        if max(map(len, cells)) > _LONGEST_CELL:
            expected = f"cells of at most {_LONGEST_CELL} characters, separated by {separator!r}"
            raise InputError(f"{path}, line {number}", expected=expected, found="a longer one")
        if any(cells):
            # A separator at the end of a line ends the last cell; no empty cell follows.
            rows.append(TextRow(path, number, cells[:-1] if len(cells) > 1 and not cells[-1] else cells))
    return rows


def read_table(path: Path | str, separator: str = ";", *, has_gaps: bool = False) -> Table:
    """Read a table from a text file whose first line names the columns.

    Args:
        path: the file.
        separator: what stands between cells.
        has_gaps: whether the last cell of a row may be empty.

    Raises:
        InputError: the file cannot be read, has fewer than two columns, one column twice, no rows, or a row
            whose length differs from the header's.
    """
    path = Path(path)
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
    if has_gaps:
        short = len(columns) - 1
        rows = [replace(row, cells=(*row.cells, "")) if len(row.cells) == short else row for row in rows]
    for row in rows:
        if len(row.cells) != len(columns):
            raise InputError(
                row.where, expected=f"{len(columns)} values as in the header", found=f"{len(row.cells)}"
            )
    return Table(path, columns, tuple(rows))


def write_rows(path: Path | str, rows: Iterable[Sequence[object]], separator: str = ";") -> None:
    """Write rows of cells as lines. Floats have all their digits, so that reading gives the same numbers.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        lines = (separator.join(_cell(value) for value in row) for row in rows)
        temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _cell(value: object) -> str:
    # float() because the repr of a NumPy scalar contains the type's name.
    return repr(float(value)) if isinstance(value, float) else str(value)


def _column(index: int, cell: str) -> Column:
    match = _HEADER.fullmatch(cell.lower())
    name, unit = (match["name"], match["unit"] or "") if match else (cell.lower(), "")
    return Column(index, name, unit, cell)
