"""Small pieces of HTML with which results show themselves in notebooks; all text is escaped."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence


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
