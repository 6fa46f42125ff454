"""`MarkerMap`: corners of markers in a room; and its table, which is checked when it is read.

A marker is a flat square. A table is refused where it clearly contradicts this. Other errors of a map are found from a
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
from psotrack.recordings.datasets import MarkerRow, read_marker_centres, read_marker_rows
from psotrack.support import short_repr

#: Largest deviation of a corner from its square, as a share of the side. Corners measured by motion capture are off by
#: some 3 mm each: three standard deviations of one corner against the three others, 2 x 3 x 3 mm, are 9 % of 0.2 m.
SQUARE_TOLERANCE = 0.1
#: Smallest and largest side of a marker, metres. A table in millimetres that is read as metres is far above.
_SIDES_M = (0.005, 5.0)
#: Distance of two centres, in sides, below which two markers that face the same way are at the same place. The two
#: markers on the front and the back of a board face opposite ways.
_SAME_PLACE = 0.5
#: Distance from a marker's plane, in sides, below which another marker is neither before nor behind it.
_IN_PLANE = 1.0
#: Largest width, in sides, of an object with markers on its outside. A room is wider.
_OBJECT_EXTENT = 10.0


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
        """(markers, 3), unit normals, out of the printed side, in the order of `ids`."""
        return normals(self.all_corners_m)


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
        _check_square(marker, row)
    marker_map = MarkerMap(
        {marker: row.corners_m for marker, row in rows.items()},
        {marker: row.std_m for marker, row in rows.items() if row.std_m},
    )
    _check_apart(rows, marker_map)
    _check_facing(path, marker_map)
    return marker_map


def sides_m(corners_m: Float[np.ndarray, "markers 4 3"]) -> Float[np.ndarray, " markers"]:
    """Mean length of each marker's four sides, metres."""
    return np.linalg.norm(np.roll(corners_m, -1, axis=-2) - corners_m, axis=-1).mean(axis=-1)


def normals(corners_m: Float[np.ndarray, "*markers 4 3"]) -> Float[np.ndarray, "*markers 3"]:
    """Unit normals of markers, towards the side from which the corners are clockwise."""
    across = np.cross(
        corners_m[..., 3, :] - corners_m[..., 1, :], corners_m[..., 2, :] - corners_m[..., 0, :]
    )
    return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)


def _check_square(marker: int, row: MarkerRow) -> None:
    corners, side = row.corners_m, float(sides_m(row.corners_m[None])[0])
    where = f"{row.where}, marker {marker}"
    if not _SIDES_M[0] <= side <= _SIDES_M[1]:
        found = f"{side:g} m"
        remedy = "is it in millimetres? then call the columns x1[mm] and so on" if side > _SIDES_M[1] else ""
        remedy = remedy or "is the unit in the header right?"
        expected = f"a marker with a side of {_SIDES_M[0]:g} to {_SIDES_M[1]:g} m"
        raise InputError(where, expected=expected, found=found, remedy=remedy)
    tolerance_m = SQUARE_TOLERANCE * side
    edges = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    diagonals = np.linalg.norm(corners[2:] - corners[:2], axis=1)
    # Corners in an order such as 1, 2, 4, 3 have a square's six distances, but two diagonals as short as its sides.
    six = np.sort([*edges, *diagonals]) / max(edges.min(), 1e-300)
    square = np.allclose(six, [1, 1, 1, 1, np.sqrt(2), np.sqrt(2)], atol=SQUARE_TOLERANCE)
    if square and diagonals.min() < 0.9 * edges.max():
        expected = "corners one after the other around the marker"
        raise InputError(where, expected=expected, found="two that are exchanged", remedy="put them in order")
    # Height of one corner over the plane of the three others; it is the same for each corner.
    normal, twist = normals(corners), corners[0] - corners[1] + corners[2] - corners[3]
    height = abs(float(twist @ normal))
    if height > tolerance_m:
        raise InputError(
            where,
            expected=f"corners in a plane to {SQUARE_TOLERANCE:.0%} of the side",
            found=f"one corner {1e3 * height:.0f} mm off the plane of the others; the side is {1e3 * side:.0f} mm",
            remedy="measure its corners again",
        )
    off = np.abs([*(edges - side), *(diagonals - np.sqrt(2) * side)])
    if off.max() > tolerance_m:
        lengths = ", ".join(f"{1e3 * length:.0f}" for length in (*edges, *diagonals))
        raise InputError(
            where,
            expected=f"a square, its sides and diagonals right to {SQUARE_TOLERANCE:.0%} of the side",
            found=f"sides and diagonals of {lengths} mm",
            remedy="measure its corners again",
        )


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
