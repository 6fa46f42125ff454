"""Tables of results: mean and sample standard deviation over runs, as papers print them."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from psotrack.errors import SettingsError
from psotrack.support import nearest

logger = logging.getLogger(__name__)

#: What a table has of each combination.
FIGURES = ("mean", "std", "runs")

#: Columns that say what was run, besides `settings.*` and `perturbation.*`; `draw` and seeds are chance.
_DESCRIBING = ("sequence", "method", "cameras", "frames", "extrinsics_deg", "clock_frames", "flipped")
_CHANCE = ("settings.seed", "perturbation.draw")


def pivot(
    rows: pd.DataFrame, *, rows_by: list[str], columns_by: list[str], value: str, scale: float = 1.0
) -> pd.DataFrame:
    """Mean and sample standard deviation of a value over the rows that are alike in the named columns.

    Names may leave out their leading parts where one column only ends so: `particles` is `settings.swarm.particles`.
    Rows without the value, of runs that failed, do not count. Where figures are over more than runs and draws, a
    warning in the log says over what.

    Args:
        rows: of results, one per cell and run.
        rows_by: columns whose values label the table's rows; at least one.
        columns_by: columns whose values label its columns.
        value: the column of numbers.
        scale: their factor; 1000 makes metres millimetres, in their name too.

    Returns:
        Rows and columns in the order of numbers and of words; below each label of the columns "mean", "std" (NaN for a
        single run) and "runs", how many counted. `attrs["value"]` names the numbers.

    Raises:
        SettingsError: a column does not exist, is named twice or by too little of its name, or is none of numbers.
    """
    names = [str(name) for name in rows.columns]
    axes = [_resolved("rows", name, names) for name in rows_by]
    axes += [_resolved("columns", name, names) for name in columns_by]
    twice = [name for index, name in enumerate(axes) if name in axes[:index]]
    if twice or not rows_by:
        found = f"{twice[0]} twice" if twice else "none"
        raise SettingsError("rows", expected="at least one column, and each only once", found=found)
    measured = _resolved("value", value, names)
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


def _resolved(where: str, name: str, names: list[str]) -> str:
    """The column of that name, or the only one whose name ends so."""
    ends = [other for other in names if other == name] or [
        other for other in names if other.endswith(f".{name}")
    ]
    if len(ends) == 1:
        return ends[0]
    near = nearest(name, names)
    remedy = f"did you mean {near}?" if near else f"there are {', '.join(names)}"
    if ends:
        remedy = f"it may be {' or '.join(ends)}"
    raise SettingsError(where, expected="the name of one column", found=name, remedy=remedy)


def _labels(column: Iterable[Any]) -> list[Any]:
    """Numbers and words that can be compared and printed; "-" for nothing."""
    return [_label(value) for value in column]


def _label(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list | tuple | np.ndarray):
        return " ".join(f"{_label(part)}" for part in value)
    if pd.isna(value):
        return "-"
    # Columns with gaps hold whole numbers as floats.
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _natural(key: tuple[Any, ...]) -> list[Any]:
    """A key for sorting: numbers before words, and numbers in words as numbers."""
    return [
        (0, value, [])
        if isinstance(value, int | float)
        else (
            1,
            0,
            [(not part.isdigit(), int(part) if part.isdigit() else 0, part) for part in _parts(value)],
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
    """Say which columns that describe runs differ within a figure of the table."""
    describing = [
        name
        for name in others
        if name in _DESCRIBING or (name.startswith(("settings.", "perturbation.")) and name not in _CHANCE)
    ]
    num_groups = len(set(keys))
    mixed = [
        name for name in describing if len(set(zip(keys, _labels(rows[name]), strict=True))) > num_groups
    ]
    if mixed:
        logger.warning("figures are not only over runs: they mix different %s", ", ".join(mixed))


def _scaled(value: str, scale: float) -> str:
    """The name of the numbers: of thousandths where that is what the scale makes."""
    if scale == 1:
        return value
    thousandths = re.fullmatch(r"(.*(?<!_m)_)([ms])", value) if scale == 1000 else None
    return f"{thousandths[1]}m{thousandths[2]}" if thousandths else f"{value} x {scale:g}"
