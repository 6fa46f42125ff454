"""Tables of pages: columns of text and numbers, in the units that people read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np


class PageColumn(NamedTuple):
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
    """A column of fractions as percentages."""
    return PageColumn(heading, key, decimals, 100.0, " %")


def make_table(
    columns: Sequence[PageColumn],
    rows: Iterable[Mapping[Any, Any]],
    note: str = "",
    colours: tuple[str, ...] = (),
) -> dict[str, Any]:
    """A table that sorts by a click on a heading, for the template's `show_table`.

    Args:
        columns: the columns.
        rows: values by the keys of the columns.
        note: a sentence below the table; empty for none.
        colours: colour of a dot at the begin of each row, as #rrggbb; empty for none.

    Returns:
        `headings`, `note` and `colours`, and `rows`, of each row the cells: what is shown, and the number that
        sorts it; None sorts by the text.
    """
    cells = [[(column.text(row[column.key]), _number(row[column.key])) for column in columns] for row in rows]
    return {"headings": [each.heading for each in columns], "rows": cells, "colours": colours, "note": note}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and np.isfinite(value) else None
