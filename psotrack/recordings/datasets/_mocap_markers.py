"""`dronN_markers_25.csv`: positions of the motion-capture markers of one simulated drone, one line per video frame.

The layout in the published dataset is unknown. The written layout has the columns `id` (the number of the frame), then
`A_x[m]`, `A_y[m]`, `A_z[m]` to `D_x[m]`, `D_y[m]`, `D_z[m]` in world coordinates. Unlike in the pose files, the line of
frame 0 is a measurement, not a placeholder.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.recordings.datasets._rows import lengths_of, rows_by_frame
from psotrack.support import read_table, write_rows

#: Names of a drone's markers, in the order of the columns.
MOCAP_MARKERS = "ABCD"
_COLUMNS = [f"{marker}_{axis}" for marker in MOCAP_MARKERS for axis in "xyz"]


def mocap_markers_file(number: int, fps: float = 25.0) -> str:
    """Name of the file of drone `number`, 1-based."""
    return f"dron{number}_markers_{fps:g}.csv"


def write_mocap_markers(path: Path | str, markers_m: Float[np.ndarray, "frames 4 3"]) -> None:
    """Write the marker positions of one drone, (frames, 4, 3), in the world, metres.

    Raises:
        OutputError: the file cannot be written.
    """
    header = ["id", *(f"{column}[m]" for column in _COLUMNS)]
    rows = ([frame, *values] for frame, values in enumerate(markers_m.reshape(-1, len(_COLUMNS))))
    write_rows(path, [header, *rows])


def read_mocap_markers(path: Path | str) -> Float[np.ndarray, "frames 4 3"]:
    """Read the marker positions of one drone, (frames, 4, 3), in the world, metres; NaN for frames without a row.

    Raises:
        InputError: the file cannot be read, a column is missing, a frame occurs twice, or a value is not a number.
    """
    table = read_table(path)
    lengths_m = lengths_of(table, [name.lower() for name in _COLUMNS])
    rows = rows_by_frame(table)
    markers_m = np.full((max(rows) + 1, len(_COLUMNS)), np.nan)
    for frame, row in rows.items():
        markers_m[frame] = lengths_m(row)
    return markers_m.reshape(-1, len(MOCAP_MARKERS), 3)
