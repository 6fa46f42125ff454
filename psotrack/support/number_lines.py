"""Text files with numbers in every line, separated by spaces or commas."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.support.files import read_text
from psotrack.support.numbers import is_moderate

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
