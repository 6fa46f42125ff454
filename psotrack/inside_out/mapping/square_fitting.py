"""A map from measured corners, such as by motion capture: the best square through each marker's four corners.

The first corner of a label is the marker's own top left, and the next ones follow clockwise as a camera sees them.
Corners in another order are sorted by the side from which the marker is seen, and by the direction of up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.inside_out.mapping.sightings import SQUARE
from psotrack.inside_out.marker_map import SQUARE_TOLERANCE, MarkerMap, normals, sides_m
from psotrack.recordings.datasets import MarkerRow, read_marker_rows, split_label
from psotrack.recordings.mocap import read_c3d
from psotrack.support.similarity import similarity

#: Distance of a viewer from a marker's plane, in sides, below which the viewer is on neither side of the marker.
_ON_A_SIDE = 0.5
#: Length of the upward direction's part in a marker's plane below which the marker lies on a floor or ceiling, so that
#: no corner is its top.
_UPRIGHT = 0.5


@dataclass(frozen=True)
class FittedSquares:
    """Squares that are fitted to measured corners.

    Attributes:
        marker_map: map with the corners of the squares; their standard deviation is from the residuals of all markers.
        residual_m: (4,) by marker id, distances of the measured corners from the corners of the square, metres.
        reordered: ids of markers whose corners were not in OpenCV's order.
    """

    marker_map: MarkerMap
    residual_m: Mapping[int, Float[np.ndarray, "4"]]
    reordered: tuple[int, ...]


@dataclass(frozen=True)
class PlacedMarker:
    """A square.

    Attributes:
        T_world_marker: (4, 4), from the square's own axes (see `sightings.SQUARE`) to the world, metres.
        side_m: side, metres.
    """

    T_world_marker: Float[np.ndarray, "4 4"]
    side_m: float

    @property
    def corners_m(self) -> Float[np.ndarray, "4 3"]:
        """(4, 3), corners, world, metres."""
        return self.T_world_marker[:3, 3] + self.side_m * SQUARE @ self.T_world_marker[:3, :3].T


def fit_square(points_m: Float[np.ndarray, "4 3"], side_m: float | None = None) -> PlacedMarker:
    """Fit a square to four points in OpenCV's order, metres; `side_m` is its side, None fits the side."""
    scale, R, centre_m = similarity(SQUARE, points_m, with_scale=side_m is None)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, centre_m
    return PlacedMarker(T, scale if side_m is None else side_m)


def fit_squares(
    rows: Mapping[int, MarkerRow],
    *,
    side_m: float | None = None,
    seen_from_m: Float[np.ndarray, "3"] | None = None,
) -> FittedSquares:
    """Fit squares to measured corners.

    Args:
        rows: measured corners by marker id.
        side_m: side of all markers, metres; None fits each marker's side.
        seen_from_m: (3,), a position that all markers face, metres; None is the mean of all corners.

    Raises:
        InputError: corners are no square, or their order cannot be determined. The message names marker and file.
    """
    middle = np.mean([row.corners_m.mean(axis=0) for row in rows.values()], axis=0)
    viewer = middle if seen_from_m is None else seen_from_m
    corners, residual_m, reordered = {}, {}, []
    for marker, row in rows.items():
        where = f"{row.where}, marker {marker}"
        points = _sort_corners(where, row.corners_m, viewer)
        if points is not row.corners_m:
            reordered.append(marker)
        square = fit_square(points, side_m)
        corners[marker], side = square.corners_m, square.side_m
        residual_m[marker] = np.linalg.norm(points - corners[marker], axis=1)
        worst = int(residual_m[marker].argmax())
        if not residual_m[marker][worst] <= SQUARE_TOLERANCE * side:
            found = f"a corner that is {1e3 * residual_m[marker][worst]:.0f} mm off"
            expected = f"four points that are a square of {1e3 * side:.0f} mm to {SQUARE_TOLERANCE:.0%}"
            raise InputError(where, expected=expected, found=found, remedy="measure its corners again")
    # A square has 12 coordinates, of which its unknowns take up 6 and its side.
    unknowns = 6 if side_m is not None else 7
    variance = np.sum(np.square(list(residual_m.values()))) / (len(rows) * (12 - unknowns))
    std_m = dict.fromkeys(corners, float(np.sqrt(variance * unknowns / 12)))
    return FittedSquares(MarkerMap(corners, std_m), residual_m, tuple(reordered))


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


def _sort_corners(
    where: str, points: Float[np.ndarray, "4 3"], viewer: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 3"]:
    """The points in OpenCV's order: unchanged if they can be in this order, else sorted by viewer and up direction."""
    centre, side = points.mean(axis=0), float(sides_m(points[None])[0])
    axes = np.linalg.svd(points - centre)[2]
    height = float((viewer - centre) @ axes[2])
    edges = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    around = np.linalg.norm(points[2:] - points[:2], axis=1).min() > edges.max()
    front = axes[2] * np.sign(height)
    if around and (abs(height) < _ON_A_SIDE * side or normals(points) @ front > 0):
        return points
    if abs(height) < _ON_A_SIDE * side:
        raise InputError(
            where,
            expected="corners in OpenCV's order, or a position from which the marker is seen",
            found="another order, and all markers in one plane",
            remedy="pass --seen-from X,Y,Z",
        )
    up = np.array([0.0, 0.0, 1.0]) - front[2] * front
    if np.linalg.norm(up) < _UPRIGHT:
        raise InputError(
            where,
            expected="corners in OpenCV's order",
            found="another order, of a marker that lies flat, so that no corner is its top",
            remedy="label its corners clockwise as seen from its front, from its own top left",
        )
    right = np.cross(up, front)
    # Clockwise from the top left: angles decrease.
    angle = np.arctan2((points - centre) @ up, (points - centre) @ right)
    return points[np.argsort((np.pi - angle) % (2 * np.pi))]
