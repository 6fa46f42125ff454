"""A map from measured corners, such as by motion capture: the best square through each marker's four corners.

The first corner of a label is the marker's own top left, and the next ones follow clockwise as a camera sees them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.inside_out.marker_map import MarkerMap, check_square
from psotrack.recordings.datasets import MarkerRow, read_marker_rows, split_label
from psotrack.recordings.mocap import read_c3d


@dataclass(frozen=True)
class FittedSquares:
    """Squares that are fitted to measured corners.

    Attributes:
        marker_map: map with the corners of the squares; their standard deviation is from the residuals of all markers.
        residual_m: (4,) by marker id, distances of the measured corners from the corners of the square, metres.
    """

    marker_map: MarkerMap
    residual_m: Mapping[int, Float[np.ndarray, "4"]]


def fit_squares(rows: Mapping[int, MarkerRow], *, side_m: float | None = None) -> FittedSquares:
    """Fit squares to measured corners.

    Args:
        rows: measured corners by marker id.
        side_m: side of all markers, metres; None fits each marker's side.

    Raises:
        InputError: corners are no square. The message names marker and file.
    """
    corners, residual_m = {}, {}
    for marker, row in rows.items():
        square = check_square(f"{row.where}, marker {marker}", row.corners_m, side_m)
        corners[marker] = square.corners_m
        residual_m[marker] = np.linalg.norm(row.corners_m - square.corners_m, axis=1)
    # A square has 12 coordinates, of which its unknowns take up 6 and its side.
    unknowns = 6 if side_m is not None else 7
    variance = np.sum(np.square(list(residual_m.values()))) / (len(rows) * (12 - unknowns))
    std_m = dict.fromkeys(corners, float(np.sqrt(variance * unknowns / 12)))
    return FittedSquares(MarkerMap(corners, std_m), residual_m)


def read_measured_corners(path: Path | str) -> dict[int, MarkerRow]:
    """Read measured corners by marker id, from a C3D file (medians over its frames) or from a table.

    Labels in a C3D are the number of the marker and of the corner: `Marker7:1`, `M7_1`, `7.1` and the like; other
    labels are ignored. Frames in which a corner was not measured are left out of its median.

    Raises:
        InputError: the file cannot be read, it has no such labels, or a marker lacks a corner.
    """
    path = Path(path)
    if path.suffix.lower() != ".c3d":
        return read_marker_rows(path)
    recording = read_c3d(path)
    points: dict[int, dict[int, Float[np.ndarray, "frames 3"]]] = {}
    for index, label in enumerate(recording.labels):
        named = split_label(label)
        if named is not None:
            position_m = recording.position_m[:, index]
            points.setdefault(named[0], {})[named[1]] = position_m[np.isfinite(position_m).all(axis=1)]
    if not points:
        expected = "labels such as Marker7:1, of marker 7's first corner"
        raise InputError(path, expected=expected, found=", ".join(recording.labels[:4]) or "none")
    first = 0 if any(0 in of_marker for of_marker in points.values()) else 1
    found = {}
    for marker, of_marker in sorted(points.items()):
        missing = [corner for corner in range(first, first + 4) if not len(of_marker.get(corner, ()))]
        if missing:
            raise InputError(
                f"{path}, marker {marker}",
                expected="4 corners",
                found=f"that number {', '.join(map(str, missing))} is never seen",
                remedy="measure it again, or leave the marker out",
            )
        corners = [np.median(of_marker[corner], axis=0) for corner in range(first, first + 4)]
        found[marker] = MarkerRow(str(path), np.array(corners))
    return found
