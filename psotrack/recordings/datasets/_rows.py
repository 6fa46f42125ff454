"""Numbers of the rows of a table, and rows by the numbers of their frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from psotrack.geometry.rig_files import UNITS_M
from psotrack.support import Table, TextRow

#: Largest number of a frame, whatever the number of rows, and per row: arrays over all frames take memory.
_FRAMES, _FRAMES_PER_ROW = 1_000_000, 100


def lengths_of(
    table: Table, names: Sequence[str], units: Mapping[str, float] = UNITS_M
) -> Callable[[TextRow], Float[np.ndarray, " names"]]:
    """A function that gives the lengths in some columns of a row, metres.

    Raises:
        InputError: a column is missing, or has another unit; in a row: a value is not a number.
    """
    columns = [table.column(name) for name in names]
    metres = np.array([table.factor(column, units) for column in columns])
    return lambda row: np.array([row.number(column) for column in columns]) * metres


def rows_by_frame(table: Table) -> dict[int, TextRow]:
    """Rows by the numbers of the frames in the column `id`.

    Raises:
        InputError: a number is no whole number or is far above the number of rows, or a frame occurs twice. The message
            names the line.
    """
    column = table.column("id")
    rows: dict[int, TextRow] = {}
    for row in table.rows:
        frame = row.count(column)
        if frame in rows:
            raise row.error(column, "each frame once", f"{frame} again, after line {rows[frame].line}")
        rows[frame] = row
    last, most = max(rows), max(_FRAMES, _FRAMES_PER_ROW * len(rows))
    if last > most:
        expected = f"a frame number of at most {most} in a file of {len(rows)} rows"
        raise rows[last].error(column, expected, f"{last}")
    return rows
