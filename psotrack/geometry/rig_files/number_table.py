"""Tables of nothing but numbers, with or without a line of names above them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class NumberTable:
    """A table of numbers.

    Attributes:
        values: (rows, columns).
        header: texts of the line above the numbers; None if there is none.
    """

    values: Float[np.ndarray, "rows columns"]
    header: tuple[str, ...] | None


def parse_numbers(text: str) -> NumberTable | None:
    """The numbers of a text, separated by commas, semicolons, tabs or spaces; None if the text is no such table."""
    lines = [line.strip() for line in text.splitlines()]
    rows = [
        [word.strip("\"'") for word in re.split(r"[,;\t ]+", line.strip(",;"))]
        for line in lines
        if line and not line.startswith("#")
    ]
    header = None
    if rows and not _are_numbers(rows[0]):
        header, rows = tuple(rows[0]), rows[1:]
    if not rows or len({len(row) for row in rows}) > 1 or not all(map(_are_numbers, rows)):
        return None
    return NumberTable(np.array([[float(word) for word in row] for row in rows]), header)


def _are_numbers(words: list[str]) -> bool:
    try:
        [float(word) for word in words]
    except ValueError:
        return False
    return True
