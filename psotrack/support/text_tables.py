"""How results show themselves: text in terminals, a short `repr`, and HTML in notebooks, whose text is escaped."""

from __future__ import annotations

import html
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

#: Longest text of one field; longer texts are cut.
_MOST_CHARACTERS = 60


def short_repr(record: Any) -> str:
    """Name of a dataclass and one short text per field, on one line per field.

    >>> import numpy as np
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, repr=False)
    ... class Pair:
    ...     name: str
    ...     values: np.ndarray
    ...     __repr__ = short_repr
    >>> Pair("left", np.zeros((3, 2)))
    Pair(
      name='left',
      values=float64 (3, 2))
    """
    lines = [f"\n  {each.name}={short_text(getattr(record, each.name))}" for each in fields(record)]
    return f"{type(record).__name__}({','.join(lines)})"


def short_text(value: Any) -> str:
    """A value in at most 60 characters: an array by type and shape, a long collection by its length."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype} {tuple(value.shape)}" if value.shape else f"{value}"
    if isinstance(value, Mapping) and len(value) > 3:
        return f"{{{next(iter(value))!r}, ...}} ({len(value)} entries)"
    if isinstance(value, tuple | list) and len(value) > 8:
        return f"{type(value).__name__} of {len(value)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 3]}..."


def html_block(title: str, *parts: str) -> str:
    """A title above parts, which are HTML."""
    return f"<div><div><b>{html.escape(title)}</b></div>{''.join(parts)}</div>"


def html_lines(lines: Mapping[str, str]) -> str:
    """One line for each label: the label and its text; nothing without lines."""
    rows = [(label, text) for label, text in lines.items() if text]
    return _table(("", ""), rows, header=False) if rows else ""


def html_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of texts.

    Args:
        headings: one per column.
        rows: texts of the cells.
    """
    return _table(headings, list(rows), header=True)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], *, header: bool) -> str:
    import pandas as pd

    # pandas cuts long texts otherwise.
    with pd.option_context("display.max_colwidth", None):
        return pd.DataFrame(rows, columns=list(headings)).to_html(index=False, header=header, border=0)


#: Heading of a column of positions; each of its cells stays on one line.
POSITION = "centre (m)"


def text_table(
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str = "",
    whole: Collection[str] = (POSITION,),
    least_width: int = 0,
) -> str:
    """A table with names in the first column and numbers in the others, as wide as the terminal or narrower.

    Args:
        headings: one per column.
        rows: texts of the cells.
        title: a line above the table.
        whole: headings of the columns whose cells are not broken into lines.
        least_width: room that there is at least where the text goes to no terminal, characters.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    tight: Any = {"show_edge": False, "pad_edge": False, "padding": (0, 0, 0, 1)}
    table = Table(box=box.HORIZONTALS, title=title or None, title_justify="left", **tight)
    for index, heading in enumerate(headings):
        style: Any = {"justify": "right"} if index else {"min_width": 5}
        table.add_column(heading, no_wrap=index > 0 and heading in whole, overflow="fold", **style)
    for row in rows:
        table.add_row(*map(Text, row))
    console = Console(color_system=None)
    if not console.is_terminal:
        console.width = max(console.width, least_width)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def format_numbers(values: Iterable[float], digits: int) -> str:
    """Numbers with `digits` decimals and spaces between them."""
    # Adding 0 makes -0 to 0.
    return " ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)


def finite_or_none(value: float) -> float | None:
    """The number, or None (null in JSON) for NaN and infinities."""
    return float(value) if math.isfinite(value) else None
