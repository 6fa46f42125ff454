"""Text files with numbers in every line, separated by spaces or commas."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.support import is_moderate, read_text

_SEPARATOR = re.compile(r"\s*,\s*|\s+")


def number_words(line: str) -> list[str]:
    """The words of a line."""
    return [word for word in _SEPARATOR.split(line.strip()) if word]


def are_numbers(words: list[str]) -> bool:
    """Whether all words are numbers, and there is at least one."""
    try:
        return bool(words) and bool([float(word) for word in words])
    except ValueError:
        return False


def first_line(path: Path) -> str:
    """The first line that is neither empty nor a comment; empty if there is none.

    Raises:
        InputError: the file cannot be read as text.
    """
    lines = (line.strip() for line in read_text(path).splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "")


def read_numbers(
    path: Path, columns: int, expected: str, *, more: bool = False
) -> Float[np.ndarray, "rows columns"]:
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
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        place = f"{path}, line {number}"
        words = number_words(line)
        try:
            values = [float(word) for word in words[:columns]]
        except ValueError:
            raise InputError(place, expected=expected, found=repr(line.strip()[:80])) from None
        if len(words) < columns or (len(words) > columns and not more) or not all(map(is_moderate, values)):
            raise InputError(place, expected=expected, found=repr(line.strip()[:80]))
        rows.append(values)
    if not rows:
        raise InputError(path, expected="at least one line with numbers", found="none")
    return np.array(rows)
