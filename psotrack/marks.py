"""What cameras see of points: marked by hand, corners of markers of known places, and drones that are tracked.

Marks by hand are a CSV, `camera,point,x_px,y_px,x_m,y_m,z_m`, with one row for each camera that sees a point. Its place
in the world stands in any of its rows, or in a CSV of its own, `point,x_m,y_m,z_m`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from psotrack.cameras import CameraRig, project
from psotrack.delimited import Column, Row, Table, read_rows
from psotrack.detections import Detections
from psotrack.errors import InputError
from psotrack.lenses import marker_dictionary
from psotrack.trajectories import Trajectories
from psotrack.video import VideoInfo, read_frames

_SEPARATOR = ","
_WORLD = ("x_m", "y_m", "z_m")
#: Frames of a video that markers are sought in: the median of so many hides what noise there is.
_FRAMES = 15
#: Share of those frames that must show a marker, or it is something else.
_SEEN = 0.5
#: How long the middle of a drone's box is off in the same way: its errors' correlation is 0.2 after a second.
_ALIKE_S = 2.0


@dataclass(frozen=True)
class Marks:
    """What one camera sees of known points.

    Attributes:
        points: their names.
        points_m: (points, 3), world, metres.
        points_px: (points, 2), in the image.
    """

    points: tuple[str, ...]
    points_m: Float[np.ndarray, "points 3"]
    points_px: Float[np.ndarray, "points 2"]


def read_marks(path: Path, places: Path | None = None) -> dict[str, Marks]:
    """The marks of each camera.

    Args:
        path: of the marks.
        places: of the points' places in the world, where the marks do not have them all.

    Raises:
        InputError: a file cannot be read, a column or value is missing, a camera has a point twice, or a point has no
            place in the world or two. The message names the line.
    """
    table = _read_table(path)
    camera, point = table.column("camera"), table.column("point")
    pixels = [table.column(name) for name in ("x_px", "y_px")]
    place_of = {} if places is None else _places(_read_table(places), required=True)
    place_of = _places(table, required=False, known=place_of)
    seen: dict[str, dict[str, list[float]]] = {}
    for row in table.rows:
        of_camera = seen.setdefault(row.text(camera), {})
        name = row.text(point)
        if name in of_camera:
            raise row.wrong(point, "each point once per camera", f"{name} again")
        if name not in place_of:
            raise row.wrong(
                point,
                f"{', '.join(_WORLD)} in one of its rows, or in a file of places",
                f"none for {name}",
                "pass --points",
            )
        of_camera[name] = [row.number(column) for column in pixels]
    return {
        name: Marks(
            tuple(rows),
            np.array([place_of[point] for point in rows]),
            np.array(list(rows.values())),
        )
        for name, rows in seen.items()
    }


def find_markers(
    video: VideoInfo, corners_m: Mapping[int, Float[np.ndarray, "4 3"]], dictionary: str = "4x4_1000"
) -> Marks:
    """The corners of markers of known places that a camera that stands still sees: medians over frames.

    Args:
        video: of the camera.
        corners_m: (4, 3), world, metres, by marker id, in the order of OpenCV's ArUco.
        dictionary: of the markers, such as 4x4_50.

    Returns:
        Points are called `7.1` to `7.4` for the corners of marker 7.

    Raises:
        InputError: the video cannot be read.
        SettingsError: there is no such dictionary.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), parameters)
    found: dict[int, list[Float[np.ndarray, "4 2"]]] = {}
    frames = 0
    for frame in read_frames(video, step=max(1, video.num_frames // _FRAMES)):
        frames += 1
        quads, ids, _ = detector.detectMarkers(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))
        for quad, marker in zip(quads, [] if ids is None else map(int, ids.ravel()), strict=True):
            if marker in corners_m:
                found.setdefault(marker, []).append(quad.reshape(4, 2).astype(np.float64))
    kept = sorted(marker for marker, quads in found.items() if len(quads) >= _SEEN * frames)
    return Marks(
        tuple(f"{marker}.{corner + 1}" for marker in kept for corner in range(4)),
        np.array([corners_m[marker] for marker in kept]).reshape(-1, 3),
        np.array([np.median(found[marker], axis=0) for marker in kept]).reshape(-1, 2),
    )


def in_boxes(
    rig: CameraRig, detections: Mapping[str, Detections], tracks: Trajectories, most_frames: int = 200
) -> tuple[Float[np.ndarray, "points cameras 2"], list[str], Int[np.ndarray, " points"]]:
    """Where cameras see tracked drones: the middle of the box that holds a drone's projection.

    A box that holds two drones, and a drone in two boxes, tell nothing. Where there are many frames some are left out,
    evenly: those beside each other say the same.

    Args:
        rig: of the tracks.
        detections: by camera name; cameras without any see nothing.
        tracks: of the drones.
        most_frames: that are used.

    Returns:
        (points, cameras, 2), a point for each drone in each frame, NaN where a camera does not see it; the points'
        names, `dron1@40` for frame 40; and their groups: of a drone within `_ALIKE_S` the errors are alike.
    """
    rows = np.arange(0, tracks.num_frames, max(1, -(-tracks.num_frames // most_frames)))
    places_m = np.where(tracks.seen[rows, :, None], tracks.position_m[rows], np.nan)
    projected, depth = project(rig.cameras, places_m[:, :, None, :])
    points_px = np.full(projected.shape, np.nan)
    for camera, name in enumerate(rig.names):
        for row, frame in enumerate(tracks.frame[rows].tolist() if name in detections else []):
            xyxy = detections[name].in_frame(frame).xyxy
            at = projected[row, :, camera, None]
            # Pixel centres are at whole numbers, and the edges of boxes half a pixel from them.
            xyxy = xyxy - 0.5
            holds = ((at >= xyxy[:, :2]) & (at <= xyxy[:, 2:])).all(axis=-1)
            holds &= (depth[row, :, camera] > 0)[:, None]
            alone = holds & (holds.sum(axis=0) == 1) & (holds.sum(axis=1) == 1)[:, None]
            drone, box = np.nonzero(alone)
            points_px[row, drone, camera] = (xyxy[box, :2] + xyxy[box, 2:]) / 2
    names = [f"{drone}@{frame}" for frame in tracks.frame[rows].tolist() for drone in tracks.drones]
    block = np.floor(tracks.time_s[rows] / _ALIKE_S).astype(np.int64)
    groups = block[:, None] * tracks.num_drones + np.arange(tracks.num_drones)
    return points_px.reshape(-1, len(rig), 2), names, groups.ravel()


def _read_table(path: Path) -> Table:
    """A table whose last cells may be empty, which `delimited.read_table` would take for a short row."""
    header, *rows = read_rows(path, _SEPARATOR) or [Row(path, 1, ("",))]
    columns = tuple(Column(index, cell.lower(), "", cell) for index, cell in enumerate(header.cells))
    if not rows:
        raise InputError(path, expected="rows below the header", found="none")
    whole = []
    for row in rows:
        cells = row.cells + ("",) * (len(row.cells) == len(columns) - 1)
        if len(cells) != len(columns):
            raise InputError(
                row.where, expected=f"{len(columns)} values as in the header", found=f"{len(row.cells)}"
            )
        whole.append(Row(path, row.line, cells))
    return Table(path, columns, tuple(whole))


def _places(
    table: Table, *, required: bool, known: Mapping[str, list[float]] | None = None
) -> dict[str, list[float]]:
    """Where points are in the world; the same point in several rows is in the same place."""
    places = dict(known or {})
    if not required and table.find(_WORLD[0]) is None:
        return places
    point, columns = table.column("point"), [table.column(name) for name in _WORLD]
    for row in table.rows:
        if not required and not any(row.cells[column.index] for column in columns):
            continue
        name, place = row.text(point), [row.number(column) for column in columns]
        if places.setdefault(name, place) != place:
            raise row.wrong(point, f"{name} at {places[name]}, as before", f"{place}")
    return places
