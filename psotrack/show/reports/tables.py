"""Tables of pages: columns of text and numbers, in the units that people read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class PageColumn:
    """A column of a table.

    Attributes:
        heading: name of the column, with its unit.
        key: where the values are in the data.
        decimals: number of decimals; None for text.
        factor: what is shown per unit of the data.
        unit: what stands behind each number.
    """

    heading: str
    key: str
    decimals: int | None = None
    factor: float = 1.0
    unit: str = ""

    def text(self, value: Any) -> str:
        """How a value is shown; a dash where it is not known."""
        if value is None or value == "" or (isinstance(value, float) and not np.isfinite(value)):
            return "–"  # noqa: RUF001  a dash in print
        return f"{value}" if self.decimals is None else f"{self.factor * value:.{self.decimals}f}{self.unit}"


def percent(heading: str, key: str, decimals: int = 1) -> PageColumn:
    """A column of shares as percentages."""
    return PageColumn(heading, key, decimals, 100.0, " %")


@dataclass(frozen=True)
class PageTable:
    """A table that sorts by a click on a heading.

    Attributes:
        headings: names of the columns.
        rows: of each row the cells: what is shown, and the number by which it is sorted; None sorts by the text.
        colours: colour of a dot at the begin of each row, as #rrggbb; empty for none.
        note: a sentence below the table; empty for none.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[tuple[str, float | None], ...], ...]
    colours: tuple[str, ...] = ()
    note: str = ""


def make_table(
    columns: Iterable[PageColumn],
    rows: Iterable[Mapping[Any, Any]],
    note: str = "",
    colours: tuple[str, ...] = (),
) -> PageTable:
    """A table of some columns of data.

    Args:
        columns: the columns.
        rows: values by the keys of the columns.
        note: a sentence below the table.
        colours: colour of a dot at the begin of each row.
    """
    columns = tuple(columns)
    cells = tuple(tuple(_cell(column, row[column.key]) for column in columns) for row in rows)
    return PageTable(tuple(column.heading for column in columns), cells, colours, note)


def _cell(column: PageColumn, value: Any) -> tuple[str, float | None]:
    text = column.text(value)
    is_number = isinstance(value, int | float) and np.isfinite(value)
    return text, float(value) if is_number else None
