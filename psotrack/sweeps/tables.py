"""Tables of results: mean and sample standard deviation over runs, as text, Markdown, LaTeX or CSV."""

from __future__ import annotations

import logging
import math
import re
from typing import Any

import numpy as np
import pandas as pd

from psotrack.errors import SettingsError
from psotrack.support import did_you_mean

logger = logging.getLogger(__name__)

FORMATS = ("text", "markdown", "latex", "csv")

#: Largest width of a table in the format "text", characters.
WIDTH = 80

#: Columns of a table for each combination of labels.
FIGURES = ["mean", "std", "runs"]

#: Beginnings of the columns that say what a run is; then the columns that only choose random numbers.
DESCRIBING = ("sequence", "method", "cameras", "frames", "code", "perturbation.", "settings.")
_RANDOM = ("settings.seed", "perturbation.draw")

#: Number of significant digits of a usual mean.
_DIGITS = 3


def pivot(
    rows: pd.DataFrame, *, rows_by: list[str], columns_by: list[str], value: str, scale: float = 1.0
) -> pd.DataFrame:
    """Mean and sample standard deviation of a value over all rows with the same values in the named columns.

    A name may be the end of a column's name if no other column ends with it: `particles` is `settings.swarm.particles`.
    Rows without the value, of runs that failed, do not count. If the rows of a figure differ in more than seeds and
    draws, a warning in the log names the other columns.

    Args:
        rows: results, one row per cell and run.
        rows_by: columns whose values label the table's rows; at least one.
        columns_by: columns whose values label the table's columns.
        value: the column of numbers.
        scale: factor of the numbers; 1000 turns metres into millimetres, also in the numbers' name.

    Returns:
        Rows and columns sorted by numbers and words. Below each label of the columns there are "mean", "std" (NaN for a
        single run) and "runs", the number of runs. `attrs["value"]` is the numbers' name.

    Raises:
        SettingsError: a column does not exist, its name is ambiguous or given twice, or the value is not numeric.
    """
    names = [str(name) for name in rows.columns]
    axes = [_find_column("rows", name, names) for name in rows_by]
    axes += [_find_column("columns", name, names) for name in columns_by]
    twice = [name for index, name in enumerate(axes) if name in axes[:index]]
    if twice or not rows_by:
        found = f"{twice[0]} twice" if twice else "none"
        raise SettingsError("rows", expected="at least one column, and each only once", found=found)
    measured = _find_column("value", value, names)
    try:
        numbers = pd.to_numeric(rows[measured]).astype(float)
    except (ValueError, TypeError) as error:
        raise SettingsError("value", expected="a column of numbers", found=measured) from error
    labels = rows[axes].map(_label).astype(object)
    _warn_if_mixed(rows, labels)
    groups = labels.assign(value=scale * numbers).groupby(axes, sort=False)["value"]
    table = groups.agg(["mean", "std", "count"]).set_axis(FIGURES, axis="columns")
    if columns_by:
        table = pd.DataFrame(table.unstack(axes[len(rows_by) :]))
        across = sorted({key[1:] for key in table.columns}, key=lambda labels: [*map(natural, labels)])
        table = table[[(figure, *key) for key in across for figure in FIGURES]]
        table.columns = pd.MultiIndex.from_tuples([(*key, figure) for key in across for figure in FIGURES])
        counts = [key for key in table.columns if key[-1] == "runs"]
        table[counts] = table[counts].fillna(0).astype(int)
    table = table.sort_index(key=lambda index: pd.Index([*map(natural, index)], tupleize_cols=False))
    table.index.names = rows_by
    table.columns.names = [*columns_by, "figure"]
    table.attrs["value"] = _scaled(value, scale)
    return table


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
        expected, remedy = f"one of {', '.join(FORMATS)}", did_you_mean(format, FORMATS)
        raise SettingsError("format", expected=expected, found=format, remedy=remedy)
    if format == "csv":
        return _csv(table)
    writer = {"text": _text, "markdown": _markdown, "latex": _latex}[format]
    return writer(_cells(table, _decimals(table) if decimals is None else decimals), _title(table))


def natural(value: Any) -> tuple[tuple[int, Any], ...]:
    """What a label is sorted by: numbers before words, and numbers in words as numbers."""
    if isinstance(value, int | float):
        return ((0, value),)
    parts = re.findall(r"[0-9]+|[^0-9]+", f"{value}")
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts)


def _label(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list | tuple | np.ndarray):
        return " ".join(f"{_label(part)}" for part in value)
    if isinstance(value, dict):
        return f"{value}"
    if pd.isna(value):
        return "-"
    # pandas stores whole numbers as floats in columns with missing values.
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _find_column(where: str, name: str, names: list[str]) -> str:
    """The column with a name, or the only column whose name ends with it."""
    ends = [name] if name in names else [other for other in names if other.endswith(f".{name}")]
    if len(ends) == 1:
        return ends[0]
    may_be = ends or [other for other in names if name and other.rpartition(".")[2].startswith(name)]
    remedy = "" if ends else did_you_mean(name, names)
    remedy = remedy or (f"it may be {' or '.join(may_be)}" if may_be else f"there are {', '.join(names)}")
    raise SettingsError(where, expected="the name of one column", found=name, remedy=remedy)


def _warn_if_mixed(rows: pd.DataFrame, labels: pd.DataFrame) -> None:
    """Log a warning with the columns that describe runs and differ within a figure of the table."""
    names = [str(name) for name in rows]
    others = [name for name in names if name.startswith(DESCRIBING) and name not in (*labels, *_RANDOM)]
    values = rows[others].map(_label).set_axis(labels.index)
    counts = values.groupby([labels[name] for name in labels], sort=False).nunique()
    mixed = counts.columns[(counts > 1).any()]
    if len(mixed):
        logger.warning("figures are not only over runs: they mix different %s", ", ".join(mixed))


def _by_figure(table: pd.DataFrame) -> list[pd.DataFrame]:
    """Mean, standard deviation and number of runs, each as a table with one column per label."""
    if table.columns.nlevels > 1:
        names = table.columns.get_level_values("figure")
        return [table.loc[:, names == figure].droplevel("figure", axis="columns") for figure in FIGURES]
    # Without labels, the name of the numbers is the only one.
    return [table[[figure]].set_axis([table.attrs["value"]], axis="columns") for figure in FIGURES]


def _words(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else f"{value}"


def _cells(table: pd.DataFrame, decimals: int) -> pd.DataFrame:
    """The table in words with one column per label: mean ± standard deviation, or "-" where runs are missing."""
    means, stds = (each.map(f"{{:.{decimals}f}}".format) for each in _by_figure(table)[:2])
    cells = means.where(stds == "nan", means + " ± " + stds).replace("nan", "-")
    for axis in ("index", "columns"):
        cells = cells.rename(_words, axis=axis)
    return cells


def _titles(columns: pd.Index) -> list[str]:
    """Names and labels of each column in one line, such as "method ours, particles 20"."""
    keys = [key if isinstance(key, tuple) else (key,) for key in columns]
    return [
        ", ".join(
            f"{name} {label}" if name else label for name, label in zip(columns.names, key, strict=True)
        )
        for key in keys
    ]


def _csv(table: pd.DataFrame) -> str:
    titles = _titles(_cells(table, 0).columns) if table.columns.nlevels > 1 else [""]
    head = [f"{title} {figure}".strip() for title in titles for figure in FIGURES]
    return table.set_axis(head, axis="columns").to_csv(lineterminator="\n")


def _text(cells: pd.DataFrame, title: str) -> str:
    text = cells.to_string()
    if max(map(len, text.splitlines())) > WIDTH:
        # With `sparsify`, pandas would not repeat the outer labels where columns are continued.
        text = cells.to_string(sparsify=False, line_width=WIDTH)
    return "\n".join([title, "", *(line.rstrip() for line in text.splitlines()), ""])


def _markdown(cells: pd.DataFrame, title: str) -> str:
    # pandas' own writer needs another package for this, and does not escape the signs of Markdown.
    by_words = cells.set_axis(_titles(cells.columns), axis="columns").reset_index()
    rule = ["---"] * cells.index.nlevels + ["---:"] * len(cells.columns)
    head, *body = (
        [re.sub(r"([\\|*`<])", r"\\\1", f"{text}") for text in line]
        for line in (by_words.columns, *by_words.to_numpy())
    )
    lines = [f"| {' | '.join(line)} |" for line in (head, rule, *body)]
    return "\n".join([title, "", *lines, ""])


def _latex(cells: pd.DataFrame, title: str) -> str:
    cells = cells.replace({r"(.*) ± (.*)": r"$\1 \\pm \2$", "^-$": "--"}, regex=True)
    # `format_index` escapes the labels, but not the names of their levels.
    for axis in (cells.index, cells.columns):
        axis.names = [name and f"{name}".replace("_", r"\_") for name in axis.names]
    style = cells.style.format_index(escape="latex").format_index(escape="latex", axis="columns")
    form = "l" * cells.index.nlevels + "r" * len(cells.columns)
    text = style.to_latex(hrules=True, column_format=form, multirow_align="naive", multicol_align="c")
    return f"% {title}; \\usepackage{{booktabs}}\n{text}"


def _decimals(table: pd.DataFrame) -> int:
    """Number of decimals that gives the median of the means its digits; 0 for whole numbers without spread."""
    means, stds, _ = (each.to_numpy(float) for each in _by_figure(table))
    sizes = np.abs(means[np.isfinite(means) & (means != 0)])
    if not len(sizes) or (np.all(sizes == np.round(sizes)) and not np.any(stds > 0)):
        return 0
    return int(np.clip(_DIGITS - 1 - math.floor(math.log10(float(np.median(sizes)))), 0, 9))


def _title(table: pd.DataFrame) -> str:
    """Name of the numbers, and the number of runs in a cell if it is more than one."""
    counts = _by_figure(table)[2].to_numpy(int)
    most, fewest = counts.max(initial=0), counts[counts > 0].min(initial=counts.max(initial=0))
    if most < 2:
        return str(table.attrs["value"])
    runs = f"{most}" if fewest == most else f"{fewest} to {most}"
    return f"{table.attrs['value']}: mean ± standard deviation over {runs} runs"


def _scaled(value: str, scale: float) -> str:
    """Name of the scaled numbers: metres become millimetres and seconds milliseconds if the scale is 1000."""
    if scale == 1:
        return value
    thousandths = re.fullmatch(r"(.*(?<!_m)_)([ms])", value) if scale == 1000 else None
    return f"{thousandths[1]}m{thousandths[2]}" if thousandths else f"{value} x {scale:g}"
