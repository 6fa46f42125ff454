"""Tables and numbers as text, as results show themselves in terminals."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

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
