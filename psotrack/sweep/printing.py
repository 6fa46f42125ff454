"""Print tables of `pivot` as text, Markdown, LaTeX or CSV."""

from __future__ import annotations

import itertools
import math
import re
from typing import Any

import numpy as np
import pandas as pd

from psotrack.errors import SettingsError
from psotrack.support import nearest
from psotrack.sweep.tables import FIGURES

FORMATS = ("text", "markdown", "latex", "csv")

#: Largest width of a table in the format "text", characters.
WIDTH = 80

#: Number of significant digits of a usual mean.
_DIGITS = 3


def render_table(table: pd.DataFrame, format: str = "text", *, decimals: int | None = None) -> str:
    """Text of a table of `pivot`, with a line break at the end.

    Args:
        table: a table of `pivot`.
        format: "text", for a terminal: columns beyond 80 characters are continued below; "markdown"; "latex", a tabular
            for the package booktabs; or "csv", with all digits, and with mean, standard deviation and number of runs in
            columns of their own.
        decimals: number of decimals; None gives three significant digits to a usual mean. CSV always has all digits.

    Raises:
        SettingsError: there is no such format.
    """
    if format not in FORMATS:
        near = nearest(format, FORMATS)
        remedy = f"did you mean {near}?" if near else ""
        raise SettingsError("format", expected=f"one of {', '.join(FORMATS)}", found=format, remedy=remedy)
    if format == "csv":
        return _csv(table)
    writer = {"text": _text, "markdown": _markdown, "latex": _latex}[format]
    return writer(table, _decimals(table) if decimals is None else decimals)


def _text(table: pd.DataFrame, decimals: int) -> str:
    for sign in (" ± ", "±"):
        cells = _cells(table, f"{{}}{sign}{{}}", decimals)
        text = cells.to_string(sparsify=True)
        if max(map(len, text.splitlines())) <= WIDTH:
            break
    else:
        # With `sparsify`, pandas would not repeat the outer labels where columns are continued.
        text = cells.to_string(sparsify=False, line_width=WIDTH)
    lines = [line.rstrip() for line in text.splitlines()]
    return "\n".join([_title(table), "", *lines, ""])


def _markdown(table: pd.DataFrame, decimals: int) -> str:
    # pandas' own writer needs another package for this, and does not escape the signs of Markdown.
    cells = _cells(table, "{} ± {}", decimals)
    head = [*cells.index.names, *_column_titles(cells)]
    rule = [*("---" for _ in cells.index.names), *("---:" for _ in cells.columns)]
    body = [[*_labels(key), *row] for key, row in zip(cells.index, cells.to_numpy(), strict=True)]
    lines = [[_escape_markdown(text) for text in line] for line in (head, *body)]
    lines.insert(1, rule)
    title = _escape_markdown(_title(table))
    return "\n".join([title, "", *(f"| {' | '.join(line)} |" for line in lines), ""])


def _latex(table: pd.DataFrame, decimals: int) -> str:
    cells = _cells(table, r"${} \pm {}$", decimals).replace("-", "--")
    # `format_index` escapes the labels, but not the names of their levels.
    for axis in (cells.index, cells.columns):
        axis.names = [name and f"{name}".replace("_", r"\_") for name in axis.names]
    style = cells.style.format_index(escape="latex").format_index(escape="latex", axis="columns")
    form = "l" * cells.index.nlevels + "r" * len(cells.columns)
    text = style.to_latex(hrules=True, column_format=form, multirow_align="naive", multicol_align="c")
    return f"% {_title(table)}; \\usepackage{{booktabs}}\n{text}"


def _csv(table: pd.DataFrame) -> str:
    cells = _cells(table, "", 0)
    titles = _column_titles(cells) if table.columns.nlevels > 1 else [""]
    head = [f"{title} {figure}".strip() for title, figure in itertools.product(titles, FIGURES)]
    return table.set_axis(cells.index).set_axis(head, axis="columns").to_csv(lineterminator="\n")


def _cells(table: pd.DataFrame, form: str, decimals: int) -> pd.DataFrame:
    """The table with one column of words per label: mean and standard deviation in a form; "-" where runs are missing.

    All labels are words too. A table without labels of columns gets the name of its numbers as the only label.
    """
    rows = [
        [_cell(row[start], row[start + 1], form, decimals) for start in range(0, len(row), len(FIGURES))]
        for row in table.to_numpy(float)
    ]
    columns = [_labels(key)[:-1] for key in table.columns[:: len(FIGURES)]]
    names = list(table.columns.names[:-1])
    if not names:
        columns, names = [(str(table.attrs.get("value", "")),)], [None]
    index = _index([_labels(key) for key in table.index], list(table.index.names))
    return pd.DataFrame(rows, index=index, columns=_index(columns, names))


def _cell(mean: float, std: float, form: str, decimals: int) -> str:
    if math.isnan(mean):
        return "-"
    # For a single run, the form is shortened to one number: the text between the two numbers is left out.
    alone = re.sub(r"\{\}.*\{\}", "{}", form)
    numbers = [f"{value:.{decimals}f}" for value in (mean, std) if not math.isnan(value)]
    return (form if len(numbers) == 2 else alone).format(*numbers)


def _labels(key: Any) -> tuple[str, ...]:
    parts = key if isinstance(key, tuple) else (key,)
    return tuple(f"{part:g}" if isinstance(part, float) else f"{part}" for part in parts)


def _index(labels: list[tuple[str, ...]], names: list[Any]) -> pd.Index:
    if len(names) == 1:
        return pd.Index([label[0] for label in labels], name=names[0])
    return pd.MultiIndex.from_tuples(labels, names=names)


def _column_titles(cells: pd.DataFrame) -> list[str]:
    """Names and labels of each column in one line, such as "method ours, particles 20"."""
    names = cells.columns.names
    return [
        ", ".join(
            f"{name} {label}" if name else label for name, label in zip(names, _labels(key), strict=True)
        )
        for key in cells.columns
    ]


def _decimals(table: pd.DataFrame) -> int:
    """Number of decimals that gives the median of the means its digits; 0 for whole numbers without spread."""
    means, stds = (table.iloc[:, index :: len(FIGURES)].to_numpy(float) for index in (0, 1))
    known = means[np.isfinite(means)]
    sizes = np.abs(known[known != 0])
    if not len(sizes) or (np.all(known == np.round(known)) and not np.any(stds > 0)):
        return 0
    return int(np.clip(_DIGITS - 1 - math.floor(math.log10(float(np.median(sizes)))), 0, 9))


def _title(table: pd.DataFrame) -> str:
    """Name of the numbers, and the number of runs in a cell if it is more than one."""
    value, counts = str(table.attrs.get("value", "")), table.iloc[:, 2 :: len(FIGURES)].to_numpy(int)
    fewest, most = int(counts[counts > 0].min(initial=counts.max(initial=0))), int(counts.max(initial=0))
    if most < 2:
        return value
    return f"{value}: mean ± standard deviation over {most if fewest == most else f'{fewest} to {most}'} runs"


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\|*`<])", r"\\\1", text)
