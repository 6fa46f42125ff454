"""Tables of pages: cells of text and numbers, in the units that people read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PageCell:
    """A cell of a table.

    Attributes:
        text: what is shown.
        value: the number by which the table is sorted; None sorts by the text.
        colour: colour of a dot before the text, as #rrggbb; empty for none.
    """

    text: str
    value: float | None = None
    colour: str = ""


@dataclass(frozen=True)
class PageTable:
    """A table that sorts by a click on a heading.

    Attributes:
        headings: names of the columns, with units.
        rows: rows of cells.
        note: a sentence below the table; empty for none.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[PageCell, ...], ...]
    note: str = ""


def number(value: float | int | None, decimals: int = 0, *, factor: float = 1.0, unit: str = "") -> PageCell:
    """A cell with a number; a dash where it is not known."""
    if value is None or not np.isfinite(value):
        return PageCell("–")  # noqa: RUF001  a dash in print
    return PageCell(f"{factor * value:.{decimals}f}{unit}", float(value))


def percent(value: float | int | None, decimals: int = 1) -> PageCell:
    """A cell with a share as a percentage."""
    return number(value, decimals, factor=100.0, unit=" %")


def words(texts: Sequence[str]) -> tuple[PageCell, ...]:
    """Cells of text."""
    return tuple(PageCell(text) for text in texts)
