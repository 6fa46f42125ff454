"""A map from corners that were measured as points, by motion capture: the best square through each marker's four.

The corner that a label calls first is the marker's own top left, and the next ones are clockwise as a camera sees them;
labels that go around the other way, or across, are put right by where the marker is seen from, and by what is up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.datasets.dpjait import MarkerRow, read_marker_rows, split_label
from psotrack.errors import InputError
from psotrack.inside_out.mapping.sightings import SQUARE
from psotrack.inside_out.marker_map import SQUARE_TOLERANCE, MarkerMap, normals, sides_m
from psotrack.recordings import read_c3d

#: Of the side: a viewer that is nearer to a marker's plane is on neither side of it.
_ON_A_SIDE = 0.5
#: Cosine between a marker's plane and up: below, it lies on a floor or ceiling, and no corner is its top.
_UPRIGHT = 0.5


@dataclass(frozen=True)
class Squares:
    """Squares through measured corners.

    Attributes:
        marker_map: the squares' corners.
        residual_m: (4,) by marker id, distances of the measured corners from the square's.
        reordered: markers whose labels were not in OpenCV's order.
    """

    marker_map: MarkerMap
    residual_m: Mapping[int, Float[np.ndarray, "4"]]
    reordered: tuple[int, ...]


def best_square(
    points_m: Float[np.ndarray, "4 3"], side_m: float | None = None
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float]:
    """The square whose corners are nearest to four points: its axes in the world, its centre and its side.

    Least squares by the singular value decomposition (Umeyama 1991).

    Args:
        points_m: (4, 3), in OpenCV's order.
        side_m: of the square; None takes the best one.
    """
    centre = points_m.mean(axis=0)
    U, strength, Vt = np.linalg.svd((points_m - centre).T @ SQUARE)
    # The model is flat: the third axis is free, and makes the rotation a proper one.
    turn = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    return U @ turn @ Vt, centre, float(strength[:2].sum() / np.sum(SQUARE**2)) if side_m is None else side_m


def squares(
    rows: Mapping[int, MarkerRow],
    *,
    side_m: float | None = None,
    seen_from_m: Float[np.ndarray, "3"] | None = None,
) -> Squares:
    """The best squares through measured corners.

    Args:
        rows: measured corners by marker id.
        side_m: of all markers; None takes the best one for each.
        seen_from_m: (3,), a place that all markers face; None is the middle of all.

    Raises:
        InputError: corners are no square, or their order cannot be told. The message names marker and file.
    """
    middle = np.mean([row.corners_m.mean(axis=0) for row in rows.values()], axis=0)
    viewer = middle if seen_from_m is None else seen_from_m
    corners, residual_m, reordered = {}, {}, []
    for marker, row in rows.items():
        where = f"{row.where}, marker {marker}"
        points = _in_order(where, row.corners_m, viewer)
        if points is not row.corners_m:
            reordered.append(marker)
        axes, centre, side = best_square(points, side_m)
        corners[marker] = centre + side * SQUARE @ axes.T
        residual_m[marker] = np.linalg.norm(points - corners[marker], axis=1)
        worst = int(residual_m[marker].argmax())
        if not residual_m[marker][worst] <= SQUARE_TOLERANCE * side:
            found = f"a corner that is {1e3 * residual_m[marker][worst]:.0f} mm off"
            expected = f"four points that are a square of {1e3 * side:.0f} mm to {SQUARE_TOLERANCE:.0%}"
            raise InputError(where, expected=expected, found=found, remedy="measure its corners again")
    return Squares(MarkerMap(corners), residual_m, tuple(reordered))


def read_measured(path: Path) -> dict[int, MarkerRow]:
    """Measured corners by marker id: of a C3D, medians over its frames, or of a table.

    Labels in a C3D are the marker's number and the corner's: `Marker7:1`, `M7_1`, `7.1` and the like; other labels are
    passed over. In frames in which it was not seen a corner has no say.

    Raises:
        InputError: the file cannot be read, it has no such labels, or a marker lacks a corner.
    """
    if path.suffix.lower() != ".c3d":
        return read_marker_rows(path)
    recording = read_c3d(path)
    points: dict[int, dict[int, Float[np.ndarray, "frames 3"]]] = {}
    for index, label in enumerate(recording.labels):
        named = split_label(label)
        if named is not None:
            seen = recording.position_m[:, index]
            points.setdefault(named[0], {})[named[1]] = seen[np.isfinite(seen).all(axis=1)]
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


def _in_order(
    where: str, points: Float[np.ndarray, "4 3"], viewer: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 3"]:
    """The points in OpenCV's order: as they are if they may be, else by where they are seen from and what is up."""
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
            expected="corners in OpenCV's order, or a place that it is seen from",
            found="another order, and all markers in one plane",
            remedy="pass --seen-from X,Y,Z",
        )
    up = np.array([0.0, 0.0, 1.0]) - front[2] * front
    if np.linalg.norm(up) < _UPRIGHT:
        raise InputError(
            where,
            expected="corners in OpenCV's order",
            found="another order, of a marker that lies flat, so that no corner is its top",
            remedy="label its corners clockwise as they are seen, from its own top left",
        )
    right = np.cross(up, front)
    # Clockwise from the top left: angles fall.
    angle = np.arctan2((points - centre) @ up, (points - centre) @ right)
    return points[np.argsort((np.pi - angle) % (2 * np.pi))]
