"""Tables of `pivot` as people paste them: text, markdown, LaTeX, CSV."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from psotrack.errors import SettingsError
from psotrack.support import nearest
from psotrack.sweep.tables import FIGURES

FORMATS = ("text", "markdown", "latex", "csv")

#: What text fits in, where it can.
WIDTH = 80

#: Mean numbers have so many digits that count.
_DIGITS = 3

_LATEX = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


@dataclass(frozen=True)
class _Words:
    """A table in words.

    Attributes:
        title: what the numbers are.
        row_names, column_names: of the labels' levels.
        row_labels, column_labels: one tuple per row and per column.
        cells: (mean, standard deviation) as text, "" for none, by row and column.
    """

    title: str
    row_names: list[str]
    column_names: list[str]
    row_labels: list[tuple[str, ...]]
    column_labels: list[tuple[str, ...]]
    cells: list[list[tuple[str, str]]]


def render(table: pd.DataFrame, format: str = "text", *, decimals: int | None = None) -> str:
    """A table of `pivot` in words, with a line's end after each line.

    Args:
        table: what `pivot` yields.
        format: "text", for a terminal: where 80 columns do not hold the table, its columns are continued below;
            "markdown"; "latex", a tabular for the package booktabs; or "csv", all digits, mean, standard deviation and
            number of runs beside one another.
        decimals: of the numbers; None is three digits of a usual mean. CSV has all.

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
    return writer(_in_words(table, decimals))


def _in_words(table: pd.DataFrame, decimals: int | None) -> _Words:
    means, stds = (table.iloc[:, index :: len(FIGURES)].to_numpy(float) for index in (0, 1))
    counts = table.iloc[:, 2 :: len(FIGURES)].to_numpy(int)
    places = _decimals(means, stds) if decimals is None else decimals
    return _Words(
        title=_title(str(table.attrs.get("value", "")), counts),
        row_names=[str(name) for name in table.index.names],
        column_names=[str(name) for name in table.columns.names[:-1]],
        row_labels=[_words(key) for key in table.index],
        column_labels=[_words(key)[:-1] for key in table.columns[:: len(FIGURES)]],
        cells=[
            [(_number(mean, places), _number(std, places)) for mean, std in zip(*row, strict=True)]
            for row in zip(means, stds, strict=True)
        ],
    )


def _words(key: Any) -> tuple[str, ...]:
    parts = key if isinstance(key, tuple) else (key,)
    return tuple(f"{part:g}" if isinstance(part, float) else f"{part}" for part in parts)


def _number(value: float, decimals: int) -> str:
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def _decimals(means: np.ndarray, stds: np.ndarray) -> int:
    """As many as give the middle one of the means its digits; none for whole numbers without spread."""
    known = means[np.isfinite(means)]
    sizes = np.abs(known[known != 0])
    if not len(sizes) or (np.all(known == np.round(known)) and not np.any(stds > 0)):
        return 0
    return int(np.clip(_DIGITS - 1 - math.floor(math.log10(float(np.median(sizes)))), 0, 9))


def _title(value: str, counts: np.ndarray) -> str:
    fewest, most = int(counts[counts > 0].min(initial=counts.max(initial=0))), int(counts.max(initial=0))
    if most < 2:
        return value
    return f"{value}: mean ± standard deviation over {most if fewest == most else f'{fewest} to {most}'} runs"


def _cell(cell: tuple[str, str], sign: str) -> str:
    mean, std = cell
    return f"{mean}{sign}{std}" if mean and std else mean or "-"


def _head(words: _Words) -> list[list[str]]:
    """A line per level of the columns, its name before its labels, and one of the rows' names."""
    blank = [""] * (len(words.row_names) - 1)
    lines = [
        [*blank, name, *labels]
        for name, *labels in zip(words.column_names, *_sparse(words.column_labels), strict=True)
    ]
    return [*lines, [*words.row_names, *([""] * len(words.column_labels))]]


def _body(words: _Words, sign: str) -> list[list[str]]:
    return [
        [*label, *(_cell(cell, sign) for cell in row)]
        for label, row in zip(_sparse(words.row_labels), words.cells, strict=True)
    ]


def _sparse(labels: list[tuple[str, ...]]) -> list[list[str]]:
    """Labels without the leading parts that are as in the label before; the last part always stays."""
    sparse = []
    for before, label in zip([(), *labels], labels, strict=False):
        pairs = itertools.zip_longest(label[:-1], before)
        same = len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], pairs)))
        sparse.append([""] * same + list(label[same:]))
    return sparse


def _text(words: _Words) -> str:
    """The widest spacing that fits; columns that do not fit by any are continued below."""
    num_labels = len(words.row_names)
    for sign, gap in ((" ± ", "  "), ("±", "  "), ("±", " ")):
        widths = [
            _width(column) + len(gap) for column in zip(*_head(words), *_body(words, sign), strict=True)
        ]
        if sum(widths) - len(gap) <= WIDTH:
            break
    room = WIDTH + len(gap) - sum(widths[:num_labels])
    blocks = [slice(0, 0)]
    for index in range(len(words.column_labels)):
        start = blocks[-1].start
        if index > start and sum(widths[num_labels:][start : index + 1]) > room:
            blocks.append(slice(index, index + 1))
        blocks[-1] = slice(blocks[-1].start, index + 1)
    return "\n\n".join([words.title, *(_block(_part(words, block), sign, gap) for block in blocks)]) + "\n"


def _part(words: _Words, columns: slice) -> _Words:
    return replace(
        words,
        column_labels=words.column_labels[columns],
        cells=[row[columns] for row in words.cells],
    )


def _block(words: _Words, sign: str, gap: str) -> str:
    head, num_labels = _head(words), len(words.row_names)
    columns = [
        _padded(column, left=index < num_labels)
        for index, column in enumerate(zip(*head, *_body(words, sign), strict=True))
    ]
    lines = [gap.join(line) for line in zip(*columns, strict=True)]
    lines.insert(len(head), "-" * len(lines[0]))
    return "\n".join(line.rstrip() for line in lines)


def _padded(column: tuple[str, ...], *, left: bool) -> list[str]:
    width = _width(column)
    return [text.ljust(width) if left else text.rjust(width) for text in column]


def _width(column: tuple[str, ...]) -> int:
    return max(map(len, column))


def _markdown(words: _Words) -> str:
    head = [*words.row_names, *_joined(words, words.title.partition(":")[0])]
    rule = [*("---" for _ in words.row_names), *("---:" for _ in words.column_labels)]
    body = [
        [*label, *(_cell(cell, " ± ") for cell in row)]
        for label, row in zip(words.row_labels, words.cells, strict=True)
    ]
    lines = [[_in_markdown(text) for text in line] for line in (head, *body)]
    lines.insert(1, rule)
    return "\n".join([_in_markdown(words.title), "", *(f"| {' | '.join(line)} |" for line in lines), ""])


def _joined(words: _Words, otherwise: str) -> list[str]:
    """The columns' labels in one line each."""
    names = [
        ", ".join(map(" ".join, zip(words.column_names, label, strict=True))) for label in words.column_labels
    ]
    return [name or otherwise for name in names]


def _latex(words: _Words) -> str:
    num_labels = len(words.row_names)
    *levels, names = _head(words)
    for level, line in enumerate(levels[:-1]):
        spans = itertools.groupby(label[: level + 1] for label in words.column_labels)
        line[num_labels:] = [
            f"\\multicolumn{{{len(list(group))}}}{{c}}{{{_in_latex(label[-1])}}}" for label, group in spans
        ]
        line[:num_labels] = map(_in_latex, line[:num_labels])
    body = _body(words, r" \pm ")
    for line in body:
        line[:num_labels] = map(_in_latex, line[:num_labels])
        line[num_labels:] = ["--" if text == "-" else f"${text}$" for text in line[num_labels:]]
    plain = [[_in_latex(text) for text in line] for line in (*levels[-1:], names)]
    head, rows = ([" & ".join(line) + r" \\" for line in part] for part in ([*levels[:-1], *plain], body))
    form = "l" * num_labels + "r" * len(words.column_labels)
    lines = [f"% {words.title}; \\usepackage{{booktabs}}", f"\\begin{{tabular}}{{{form}}}", r"\toprule"]
    return "\n".join([*lines, *head, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}", ""])


def _in_latex(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in text)


def _in_markdown(text: str) -> str:
    return re.sub(r"([\\|*`<])", r"\\\1", text)


def _csv(table: pd.DataFrame) -> str:
    """A line per row, all digits; mean, standard deviation and runs of every column beside one another."""
    words = _in_words(table, 0)
    head = [
        " ".join(part for part in pair if part) for pair in itertools.product(_joined(words, ""), FIGURES)
    ]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*words.row_names, *head])
    for label, row in zip(words.row_labels, table.to_numpy(float), strict=True):
        numbers = ["" if math.isnan(value) else repr(float(value)).removesuffix(".0") for value in row]
        writer.writerow([*label, *numbers])
    return text.getvalue()
