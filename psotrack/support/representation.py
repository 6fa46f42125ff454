"""A `repr` of records that fits a terminal: arrays by type and shape, long collections by their lengths."""

from __future__ import annotations

from collections.abc import Mapping
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
