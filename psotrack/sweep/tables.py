"""Tables of results: mean and sample standard deviation over runs."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from psotrack.errors import SettingsError
from psotrack.support import nearest, whole_number

logger = logging.getLogger(__name__)

#: Columns of a table for each combination of labels.
FIGURES = ("mean", "std", "runs")

#: Columns that describe a run, besides `settings.*` and `perturbation.*`; then the columns that only choose random
#: numbers.
_DESCRIBING = ("sequence", "method", "cameras", "frames", "extrinsics_deg", "clock_frames", "flipped")
_RANDOM = ("settings.seed", "perturbation.draw")


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
    keys = list(zip(*(_labels(rows[name]) for name in axes), strict=True))
    _warn_if_mixed(rows, keys, [name for name in names if name not in axes])

    groups: dict[tuple[Any, ...], list[float]] = {key: [] for key in keys}
    for key, number in zip(keys, numbers, strict=True):
        if not math.isnan(number):
            groups[key].append(scale * number)
    num_rows_by = len(rows_by)
    down = sorted({key[:num_rows_by] for key in keys}, key=_natural)
    across = sorted({key[num_rows_by:] for key in keys}, key=_natural)
    table = [
        [figure for column in across for figure in _figures(groups.get((*row, *column), []))] for row in down
    ]
    result = pd.DataFrame(
        table,
        index=_index(down, rows_by),
        columns=_index([(*column, name) for column in across for name in FIGURES], [*columns_by, "figure"]),
    )
    result.attrs["value"] = _scaled(value, scale)
    return result


def _find_column(where: str, name: str, names: list[str]) -> str:
    """The column with a name, or the only column whose name ends with it."""
    ends = [other for other in names if other == name] or [
        other for other in names if other.endswith(f".{name}")
    ]
    if len(ends) == 1:
        return ends[0]
    near = nearest(name, names)
    begin = [other for other in names if name and other.rpartition(".")[2].startswith(name)]
    if ends:
        remedy = f"it may be {' or '.join(ends)}"
    elif near:
        remedy = f"did you mean {near}?"
    else:
        remedy = f"it may be {' or '.join(begin)}" if begin else f"there are {', '.join(names)}"
    raise SettingsError(where, expected="the name of one column", found=name, remedy=remedy)


def _labels(column: Iterable[Any]) -> list[Any]:
    """Labels that can be compared and printed: numbers and words, "-" for missing values."""
    return [_label(value) for value in column]


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


def _natural(key: tuple[Any, ...]) -> list[Any]:
    """A key for sorting: numbers before words, and numbers in words as numbers."""
    return [
        (0, value, [])
        if isinstance(value, int | float)
        else (
            1,
            0,
            [(whole_number(part) is None, whole_number(part) or 0, part) for part in _parts(value)],
        )
        for value in key
    ]


def _parts(value: Any) -> list[str]:
    return re.findall(r"[0-9]+|[^0-9]+", f"{value}")


def _figures(numbers: list[float]) -> tuple[float, float, int]:
    mean = float(np.mean(numbers)) if numbers else math.nan
    return mean, float(np.std(numbers, ddof=1)) if len(numbers) > 1 else math.nan, len(numbers)


def _index(keys: list[tuple[Any, ...]], names: list[str]) -> pd.Index:
    if len(names) == 1:
        return pd.Index([key[0] for key in keys], name=names[0])
    return pd.MultiIndex.from_tuples(keys, names=names)


def _warn_if_mixed(rows: pd.DataFrame, keys: list[tuple[Any, ...]], others: list[str]) -> None:
    """Log a warning with the columns that describe runs and differ within a figure of the table."""
    describing = [
        name
        for name in others
        if name in _DESCRIBING or (name.startswith(("settings.", "perturbation.")) and name not in _RANDOM)
    ]
    num_groups = len(set(keys))
    mixed = [
        name for name in describing if len(set(zip(keys, _labels(rows[name]), strict=True))) > num_groups
    ]
    if mixed:
        logger.warning("figures are not only over runs: they mix different %s", ", ".join(mixed))


def _scaled(value: str, scale: float) -> str:
    """Name of the scaled numbers: metres become millimetres and seconds milliseconds if the scale is 1000."""
    if scale == 1:
        return value
    thousandths = re.fullmatch(r"(.*(?<!_m)_)([ms])", value) if scale == 1000 else None
    return f"{thousandths[1]}m{thousandths[2]}" if thousandths else f"{value} x {scale:g}"
