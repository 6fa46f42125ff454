"""Files of frame times: CSV with the columns `frame` and `time_s`, one row per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psotrack.errors import InputError
from psotrack.recordings.timing import FrameTimes
from psotrack.support import read_table


def read_timestamps(path: Path | str, num_frames: int | None = None) -> FrameTimes:
    """Read the times of a camera's frames.

    Args:
        path: CSV file with the columns `frame`, which counts from 0, and `time_s`, seconds.
        num_frames: number of frames that the camera has; None is not known.

    Raises:
        InputError: the file cannot be read, a frame is missing, there is not one time per frame, or times do not
            increase. The message names the line or the frame.
    """
    path = Path(path)
    table = read_table(path, ",")
    frame_column, time_column = table.column("frame"), table.column("time_s")
    for number, row in enumerate(table.rows):
        if row.count(frame_column) != number:
            expected = f"frame {number}: every frame once, in order, from 0"
            raise row.error(frame_column, expected, row.text(frame_column))
    time_s = np.array([row.number(time_column) for row in table.rows])
    if num_frames is not None and len(time_s) != num_frames:
        raise InputError(
            path, expected=f"times of the {num_frames} frames of the video", found=f"{len(time_s)}"
        )
    return FrameTimes.listed(time_s, path)
