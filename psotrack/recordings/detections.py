"""2D detections of one camera, and their files in the DPJAIT dataset (`dl_data/<camera>.csv`).

A file has one line per frame, comma-separated, without header: the 0-based frame number, then 7 values per detection:
x, y, w, h, cx, cy, confidence, in pixels (YOLOv5). Frames may be missing, frames have different numbers of detections,
and lines may be padded with empty fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.support import Column, TextRow, read_rows, short_repr, write_rows

_SEPARATOR = ","
_VALUES = ("x", "y", "w", "h", "cx", "cy", "confidence")


@dataclass(frozen=True, repr=False)
class Detections:
    """Boxes in the frames of one camera, as parallel arrays ordered by frame.

    Attributes:
        frame: (detections,), 0-based numbers of the video frames.
        xyxy: (detections, 4), boxes in pixels, in the convention of `psotrack.geometry.boxes`.
        confidence: (detections,), confidences of the detector in [0, 1].
    """

    frame: Int[np.ndarray, " detections"]
    xyxy: Float[np.ndarray, "detections 4"]
    confidence: Float[np.ndarray, " detections"]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if np.any(np.diff(self.frame) < 0):
            raise InputError("detections.frame", expected="increasing frame numbers", found="steps back")

    def __len__(self) -> int:
        return len(self.frame)

    def in_frame(self, frame: int) -> Detections:
        """Detections of one frame."""
        start, stop = np.searchsorted(self.frame, [frame, frame + 1])
        return Detections(self.frame[start:stop], self.xyxy[start:stop], self.confidence[start:stop])


def read_detections(path: Path | str) -> Detections:
    """Read the detections of one camera.

    A box is computed from its middle, cx and cy, and its size, because x and y are a corner in the files of some
    detectors and the middle in others.

    Raises:
        InputError: the file cannot be read, or a line is wrong: not 7 values per detection, a value that is not a
            finite number, a size below 0, a confidence outside [0, 1], or a frame that occurred before. The message
            names the line.
    """
    boxes: dict[int, list[tuple[float, ...]]] = {}
    for row in read_rows(path, _SEPARATOR):
        frame = row.count(_column(0))
        if frame in boxes:
            raise row.error(_column(0), "each frame once", f"frame {frame} again")
        boxes[frame] = _boxes(row)
    found = [(frame, box) for frame in sorted(boxes) for box in boxes[frame]]
    values = np.array([box for _, box in found], np.float64).reshape(-1, 5)
    return Detections(np.array([frame for frame, _ in found], np.int64), values[:, :4], values[:, 4])


def write_detections(path: Path | str, detections: Detections) -> None:
    """Write the detections of one camera; frames without detections have no line.

    Raises:
        OutputError: the file cannot be written.
    """
    corner, far_corner = detections.xyxy[:, :2], detections.xyxy[:, 2:]
    values = np.hstack(
        [corner, far_corner - corner, (corner + far_corner) / 2, detections.confidence[:, None]]
    )
    frames, starts = np.unique(detections.frame, return_index=True)
    per_frame = np.split(values, starts[1:])
    rows = ([int(frame), *block.ravel()] for frame, block in zip(frames, per_frame, strict=False))
    write_rows(path, rows, _SEPARATOR)


def _boxes(row: TextRow) -> list[tuple[float, ...]]:
    """Left, top, right, bottom and confidence of each detection in a line."""
    size = len(_VALUES)
    # Lines of the dataset are padded with empty fields to the width of the longest line.
    num_values = max((index for index, cell in enumerate(row.cells) if cell), default=0)
    if num_values % size:
        raise InputError(
            row.where,
            expected=f"a frame number and {size} values per detection ({', '.join(_VALUES)})",
            found=f"{num_values} values",
        )
    starts = range(1, num_values + 1, size)
    return [_box(row, start) for start in starts if any(row.cells[start : start + size])]


def _box(row: TextRow, start: int) -> tuple[float, ...]:
    columns = dict(zip(_VALUES, map(_column, range(start, start + len(_VALUES))), strict=True))
    value = {name: row.number(column) for name, column in columns.items()}
    for name in ("w", "h"):
        if value[name] < 0:
            raise row.error(columns[name], f"a size {name} of 0 or more pixels", f"{value[name]:g}")
    if not 0 <= value["confidence"] <= 1:
        raise row.error(columns["confidence"], "a confidence from 0 to 1", f"{value['confidence']:g}")
    middle = np.array([value["cx"], value["cy"]])
    half = np.array([value["w"], value["h"]]) / 2
    return *(middle - half), *(middle + half), value["confidence"]


def _column(index: int) -> Column:
    """Column with its number from 1 as name, because the files have no header."""
    return Column(index, f"{index + 1}", "", f"{index + 1}")
