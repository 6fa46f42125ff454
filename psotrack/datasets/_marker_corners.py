"""The table of ArUco markers on the walls: the corners of each in the world.

How the dataset publishes it is not known; this is the layout that is written here: `id`, then `x1[m]`,
`y1[m]`, `z1[m]` to `x4[m]`, `y4[m]`, `z4[m]`: the corners as OpenCV's ArUco counts them, clockwise from the
marker's own top left when it is looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.datasets._calibration import LENGTHS
from psotrack.delimited import read_table, write_rows

_CORNERS = [f"{axis}{corner}" for corner in range(1, 5) for axis in "xyz"]


def read_marker_corners(path: Path) -> dict[int, Float[np.ndarray, "4 3"]]:
    """Corners, (4, 3), world, metres, by marker id.

    Raises:
        InputError: the file cannot be read, a column is missing, an id is there twice, or a value is no
            number.
    """
    table = read_table(path)
    id_column = table.column("id")
    columns = [table.column(name) for name in _CORNERS]
    metres = np.array([table.factor(column, LENGTHS) for column in columns])
    corners: dict[int, Float[np.ndarray, "4 3"]] = {}
    for row in table.rows:
        marker = row.count(id_column)
        if marker in corners:
            raise row.wrong(id_column, "each marker once", f"{marker} again")
        corners[marker] = (np.array([row.number(column) for column in columns]) * metres).reshape(4, 3)
    return corners


def write_marker_corners(path: Path, corners_m: Mapping[int, Float[np.ndarray, "4 3"]]) -> None:
    """Write corners, (4, 3), world, metres, by marker id.

    Raises:
        OutputError: the file cannot be written.
    """
    header = ["id", *(f"{name}[m]" for name in _CORNERS)]
    write_rows(path, [header, *([marker, *corners_m[marker].ravel()] for marker in sorted(corners_m))])
