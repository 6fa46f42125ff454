"""`MarkerMap`: corners of markers in a room; and its table, which is checked when it is read.

A marker is a flat square. A table is refused where it clearly contradicts this. Squares are fitted to corners that were
measured, such as by motion capture: the first corner of a label is the marker's own top left, and the next ones follow
clockwise as a camera sees them. Other errors of a map are found from a
video: see `localising.recording` and `mapping.checking`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.recordings.datasets import MarkerRow, read_marker_centres, read_marker_rows, split_label
from psotrack.recordings.mocap import read_c3d
from psotrack.support import short_repr, similarity

#: Corners of a marker with sides of 1 in its own axes, x to its right, y up, z out of the print, in OpenCV's order.
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
#: Largest distance of a marker's corners from the nearest square (root of the sum of squares), as a fraction of its
#: side. Four corners that motion capture measures, off by 3 mm each, are 6 mm or 3 % of 0.2 m off.
SQUARE_TOLERANCE = 0.06
#: Smallest and largest side of a marker, metres. A table in millimetres that is read as metres is far above.
_SIDES_M = (0.005, 5.0)
#: Distance of two centres, in sides, below which two markers that face the same way are at the same place. The two
#: markers on the front and the back of a board face opposite ways.
_SAME_PLACE = 0.5
#: Distance from a marker's plane, in sides, below which another marker is neither before nor behind it.
_IN_PLANE = 1.0
#: Largest width, in sides, of an object with markers on its outside. A room is wider.
_OBJECT_EXTENT = 10.0


@dataclass(frozen=True)
class PlacedMarker:
    """A square.

    Attributes:
        T_world_marker: (4, 4), from the square's own axes (see `SQUARE`) to the world, metres.
        side_m: side, metres.
    """

    T_world_marker: Float[np.ndarray, "4 4"]
    side_m: float

    @property
    def corners_m(self) -> Float[np.ndarray, "4 3"]:
        """(4, 3), corners, world, metres."""
        return self.T_world_marker[:3, 3] + self.side_m * SQUARE @ self.T_world_marker[:3, :3].T


@dataclass(frozen=True, repr=False)
class MarkerMap:
    """Markers with known corners.

    Attributes:
        corners_m: (4, 3) by marker id, world, metres: in the order of OpenCV's ArUco, clockwise from the marker's own
            top left as seen from its front.
        std_m: standard deviation of the position of a marker's corners along each axis of the world, metres, by marker
            id; it is the same error in every frame. Markers that are not listed are known exactly.
    """

    corners_m: Mapping[int, Float[np.ndarray, "4 3"]]
    std_m: Mapping[int, float] = field(default_factory=dict)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if not self.corners_m:
            raise InputError("marker map", expected="at least one marker", found="none")
        for marker, corners in self.corners_m.items():
            if corners.shape != (4, 3) or not np.isfinite(corners).all():
                found = f"{corners.shape}" if corners.shape != (4, 3) else "NaN or infinity"
                raise InputError(f"marker {marker}", expected="finite corners of shape (4, 3)", found=found)

    def __len__(self) -> int:
        return len(self.corners_m)

    def __contains__(self, marker: object) -> bool:
        return marker in self.corners_m

    @cached_property
    def ids(self) -> Int[np.ndarray, " markers"]:
        """(markers,), ids in increasing order."""
        return np.array(sorted(self.corners_m))

    def corners_of(self, ids: Iterable[int]) -> Float[np.ndarray, "chosen 4 3"]:
        """(chosen, 4, 3), corners of these markers, which must all be in the map."""
        return np.array([self.corners_m[int(marker)] for marker in ids], np.float64).reshape(-1, 4, 3)

    def std_of(self, ids: Iterable[int]) -> Float[np.ndarray, " chosen"]:
        """(chosen,), standard deviations of these markers along each axis, metres; 0 where none is listed."""
        return np.array([self.std_m.get(int(marker), 0.0) for marker in ids])

    @cached_property
    def all_corners_m(self) -> Float[np.ndarray, "markers 4 3"]:
        """(markers, 4, 3), corners in the order of `ids`."""
        return self.corners_of(self.ids.tolist())

    @cached_property
    def sides_m(self) -> Float[np.ndarray, " markers"]:
        """(markers,), mean lengths of the four sides, metres, in the order of `ids`."""
        return sides_m(self.all_corners_m)

    @cached_property
    def centres_m(self) -> Float[np.ndarray, "markers 3"]:
        """(markers, 3), centres in the order of `ids`."""
        return self.all_corners_m.mean(axis=1)

    @cached_property
    def normals(self) -> Float[np.ndarray, "markers 3"]:
        """(markers, 3), unit normals, towards the side from which the corners are clockwise, in the order of `ids`."""
        first, second, third, fourth = self.all_corners_m.swapaxes(0, 1)
        across = np.cross(fourth - second, third - first)
        return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)


@dataclass(frozen=True)
class MarkerCentres:
    """Markers of which only the centres are known.

    Attributes:
        centres_m: (3,) by marker id, world, metres.
    """

    centres_m: Mapping[int, Float[np.ndarray, "3"]]

    @cached_property
    def ids(self) -> Int[np.ndarray, " markers"]:
        """(markers,), ids in increasing order."""
        return np.array(sorted(self.centres_m))


def read_marker_table(path: Path | str) -> MarkerMap | MarkerCentres:
    """Read a map from a table of corners, or centres from a table with the columns id, x_m, y_m and z_m.

    Raises:
        InputError: as `read_marker_map`; or two centres are at one place.
    """
    centres_m = read_marker_centres(path)
    if centres_m is None:
        return read_marker_map(path)
    places: dict[tuple[float, ...], int] = {}
    for marker, centre_m in centres_m.items():
        other = places.setdefault(tuple(centre_m.tolist()), marker)
        if other != marker:
            raise InputError(
                path,
                expected="markers in different places",
                found=f"the centre of marker {other} for marker {marker} as well",
                remedy="correct one of the two",
            )
    return MarkerCentres(centres_m)


def read_marker_map(path: Path | str) -> MarkerMap:
    """Read a map from a table of corners; `psotrack.recordings.datasets` describes the layouts.

    Raises:
        InputError: the file cannot be read, a corner or column is missing, or a marker is listed twice, is no flat
            square of the size of a marker, or is at the place of another marker, or all markers face out of the
            room. The message names the line.
    """
    path = Path(path)
    rows = read_marker_rows(path)
    for marker, row in rows.items():
        check_square(f"{row.where}, marker {marker}", row.corners_m)
    marker_map = MarkerMap(
        {marker: row.corners_m for marker, row in rows.items()},
        {marker: row.std_m for marker, row in rows.items() if row.std_m},
    )
    _check_apart(rows, marker_map)
    _check_facing(path, marker_map)
    return marker_map


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


def sides_m(corners_m: Float[np.ndarray, "markers 4 3"]) -> Float[np.ndarray, " markers"]:
    """Mean length of each marker's four sides, metres."""
    return np.linalg.norm(np.roll(corners_m, -1, axis=-2) - corners_m, axis=-1).mean(axis=-1)


def fit_square(points_m: Float[np.ndarray, "4 3"], side_m: float | None = None) -> PlacedMarker:
    """Fit a square to four points in OpenCV's order, metres; `side_m` is its side, None fits the side."""
    scale, R, centre_m = similarity(SQUARE, points_m, with_scale=side_m is None)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, centre_m
    return PlacedMarker(T, scale if side_m is None else side_m)


def check_square(
    where: str, corners_m: Float[np.ndarray, "4 3"], side_m: float | None = None
) -> PlacedMarker:
    """The square of a marker's corners, (4, 3), metres; `side_m` is its side, None fits the side.

    Raises:
        InputError: the corners are no square of the size of a marker, at a place that `where` names.
    """
    side = float(sides_m(corners_m[None])[0])
    if not _SIDES_M[0] <= side <= _SIDES_M[1]:
        remedy = "is it in millimetres? then call the columns x1[mm] and so on" if side > _SIDES_M[1] else ""
        remedy = remedy or "is the unit in the header right?"
        expected = f"a marker with a side of {_SIDES_M[0]:g} to {_SIDES_M[1]:g} m"
        raise InputError(where, expected=expected, found=f"{side:g} m", remedy=remedy)
    square = fit_square(corners_m, side_m)
    off_m = float(np.linalg.norm(square.corners_m - corners_m))
    if off_m > SQUARE_TOLERANCE * side:
        raise InputError(
            where,
            expected=f"a flat square, its corners one after the other around it, to {SQUARE_TOLERANCE:.0%} of its side",
            found=f"corners {1e3 * off_m:.0f} mm off the nearest square; the side is {1e3 * side:.0f} mm",
            remedy="measure its corners again",
        )
    return square


def _check_apart(rows: Mapping[int, MarkerRow], marker_map: MarkerMap) -> None:
    ids, centres, faces = marker_map.ids, marker_map.centres_m, marker_map.normals
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    limit = _SAME_PLACE * np.minimum(marker_map.sides_m[:, None], marker_map.sides_m)
    pairs = np.argwhere(np.triu((distance < limit) & (faces @ faces.T > 0), 1))
    for first, second in ids[pairs].tolist():
        raise InputError(
            f"{rows[second].where}, marker {second}",
            expected="markers in different places",
            found=f"both markers at the place of marker {first}",
            remedy="correct one of the two",
        )


def _check_facing(path: Path, marker_map: MarkerMap) -> None:
    """Refuse a room whose markers all face out of it: it is mirrored.

    A single marker may face any way: on a pillar in front of a wall, all others are behind it. So may all markers on
    the outside of an object, which is narrow beside its markers. Wrong markers are found from the video.
    """
    ids, centres = marker_map.ids, marker_map.centres_m
    height = np.einsum("mnk,mk->mn", centres - centres[:, None], marker_map.normals)
    beside = _IN_PLANE * marker_map.sides_m[:, None]
    outward = (height < -beside).any(axis=1) & ~(height > beside).any(axis=1)
    width_m = (
        np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)[1:2] if len(ids) > 2 else np.zeros(1)
    )
    # The root mean square of a uniform distribution is its extent / sqrt(12).
    wide = np.sqrt(12 / len(ids)) * float(width_m[0]) > _OBJECT_EXTENT * np.median(marker_map.sides_m)
    if outward.all() and wide:
        raise InputError(
            path,
            expected="corners in the order in which a camera in the room sees them",
            found=f"that {len(ids)} of {len(ids)} markers face out of the room, and none into it",
            remedy="corners are counted backwards, or an axis is mirrored: count them clockwise as seen from the room, "
            "from the marker's own top left",
        )
