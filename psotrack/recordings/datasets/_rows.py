"""Numbers of the rows of a table, and rows by the numbers of their frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from psotrack.geometry.rig_files import UNITS_M
from psotrack.support import Table, TextRow


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
