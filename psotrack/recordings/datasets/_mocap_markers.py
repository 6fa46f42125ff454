"""`dronN_markers_25.csv`: positions of the motion-capture markers of one simulated drone, one line per video frame.

The layout in the published dataset is unknown. The written layout has the columns `id` (the number of the frame), then
`A_x[m]`, `A_y[m]`, `A_z[m]` to `D_x[m]`, `D_y[m]`, `D_z[m]` in world coordinates. Unlike in the pose files, the line of
frame 0 is a measurement, not a placeholder.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.support import write_rows

_COLUMNS = [f"{marker}_{axis}[m]" for marker in "ABCD" for axis in "xyz"]


def mocap_markers_file(number: int, fps: float = 25.0) -> str:
    """Name of the file of drone `number`, 1-based."""
    return f"dron{number}_markers_{fps:g}.csv"


def write_mocap_markers(path: Path | str, markers_m: Float[np.ndarray, "frames 4 3"]) -> None:
    """Write the marker positions of one drone, (frames, 4, 3), in the world, metres.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = ([frame, *values] for frame, values in enumerate(markers_m.reshape(-1, len(_COLUMNS))))
    write_rows(path, [["id", *_COLUMNS], *rows])
