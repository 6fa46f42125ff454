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
from jaxtyping import Bool, Float, Int

from psotrack.calibration.alike import Alike
from psotrack.correspondence import BORDER_PX, NOISE_PX, NOISE_SHARE
from psotrack.detection import marker_dictionary
from psotrack.errors import InputError
from psotrack.geometry import CameraRig, project
from psotrack.recordings import Detections, VideoInfo, read_frames
from psotrack.support import Column, Table, TextRow, read_rows
from psotrack.trajectories import Trajectories

_SEPARATOR = ","
_WORLD = ("x_m", "y_m", "z_m")
#: Frames of a video that markers are sought in: the median of so many hides what noise there is.
_FRAMES = 15
#: Share of those frames that must show a marker, or it is something else.
_SEEN = 0.5
#: The middle of a drone's box is off by so much of its sides in the same way for as long as the drone flies alike; and
#: by as much again in all frames of a camera, for its shape; and again, all drones, over a camera's image, for bodies
#: are near and far, and seen from above or the side.
_ALIKE_SHARE, _ALIKE_S = 0.015, 1.0


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


@dataclass(frozen=True)
class DroneViews:
    """What cameras see of tracked drones, a point for each drone in each frame.

    Attributes:
        points: their names, `dron1@40` for frame 40.
        points_px: (points, cameras, 2), middles of boxes; NaN where a camera does not see the drone, or not clearly.
        noise_px: (points, cameras), standard deviation of what differs from frame to frame; NaN where the point is.
        alike: what lasts.
    """

    points: tuple[str, ...]
    points_px: Float[np.ndarray, "points cameras 2"]
    noise_px: Float[np.ndarray, "points cameras"]
    alike: tuple[Alike, ...]


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
            raise row.error(point, "each point once per camera", f"{name} again")
        if name not in place_of:
            raise row.error(
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
    rig: CameraRig, detections: Mapping[str, Detections], tracks: Trajectories, most_frames: int = 500
) -> DroneViews:
    """Where cameras see tracked drones: the middle of the box that holds a drone's projection.

    A box that holds two drones, and a drone in two boxes, tell nothing; the middles of boxes that the border of the
    image cuts, or that touch others, are not those of drones. Where there are many frames some are left out, evenly:
    those beside each other say the same.

    Args:
        rig: of the tracks.
        detections: by camera name; cameras without any see nothing.
        tracks: of the drones.
        most_frames: that are used.
    """
    rows = np.arange(0, tracks.num_frames, max(1, -(-tracks.num_frames // most_frames)))
    places_m = np.where(tracks.seen[rows, :, None], tracks.position_m[rows], np.nan)
    projected, depth = project(rig.cameras, places_m[:, :, None, :])
    points_px, side_px = np.full(projected.shape, np.nan), np.full(depth.shape, np.nan)
    for camera, name in enumerate(rig.names):
        for row, frame in enumerate(tracks.frame[rows].tolist() if name in detections else []):
            xyxy = detections[name].in_frame(frame).xyxy
            clear = _clear(xyxy, np.asarray(rig.cameras.image_size_wh[camera]))
            at = projected[row, :, camera, None]
            # Pixel centres are at whole numbers, and the edges of boxes half a pixel from them.
            xyxy = xyxy - 0.5
            holds = ((at >= xyxy[:, :2]) & (at <= xyxy[:, 2:])).all(axis=-1)
            holds &= (depth[row, :, camera] > 0)[:, None]
            alone = holds & (holds.sum(axis=0) == 1) & (holds.sum(axis=1) == 1)[:, None]
            drone, box = np.nonzero(alone & clear)
            points_px[row, drone, camera] = (xyxy[box, :2] + xyxy[box, 2:]) / 2
            side_px[row, drone, camera] = np.sqrt((xyxy[box, 2:] - xyxy[box, :2]).prod(axis=-1))
    names = [f"{drone}@{frame}" for frame in tracks.frame[rows].tolist() for drone in tracks.drones]
    drone = np.tile(np.arange(tracks.num_drones), len(rows))
    second = np.floor(tracks.time_s[rows] / _ALIKE_S).astype(np.int64).repeat(tracks.num_drones)
    points_px, side_px = points_px.reshape(-1, len(rig), 2), side_px.reshape(-1, len(rig))
    return DroneViews(
        tuple(names),
        points_px,
        NOISE_PX + NOISE_SHARE * side_px,
        _alike(rig, points_px, side_px, drone, (second - second.min(initial=0)) * tracks.num_drones + drone),
    )


def _clear(
    xyxy: Float[np.ndarray, "boxes 4"], image_size_wh: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, " boxes"]:
    """Boxes that neither the border of the image cuts nor another one touches."""
    sides = np.minimum(xyxy[:, None, 2:], xyxy[:, 2:]) - np.maximum(xyxy[:, None, :2], xyxy[:, :2])
    touched = (sides > 0).all(axis=-1).sum(axis=1) > 1
    cut = (xyxy[:, :2] < BORDER_PX) | (xyxy[:, 2:] > image_size_wh - BORDER_PX)
    return ~touched & ~cut.any(axis=-1)


def _alike(
    rig: CameraRig,
    points_px: Float[np.ndarray, "points cameras 2"],
    side_px: Float[np.ndarray, "points cameras"],
    drone: Int[np.ndarray, " points"],
    second: Int[np.ndarray, " points"],
) -> tuple[Alike, ...]:
    """What lasts of the boxes' errors: of a drone in a camera, for a while and for good, and of a camera's drones."""
    middle_px = np.asarray(rig.cameras.K)[:, :2, 2]
    from_middle = (points_px - middle_px) / (np.asarray(rig.cameras.image_size_wh) / 2)
    everything = np.zeros_like(drone)
    return (
        Alike(second, _ALIKE_SHARE * side_px),
        Alike(drone, _ALIKE_SHARE * side_px),
        *(Alike(everything, _ALIKE_SHARE * side_px * of) for of in (1.0, *np.moveaxis(from_middle, -1, 0))),
    )


def _read_table(path: Path) -> Table:
    """A table whose last cells may be empty, which `delimited.read_table` would take for a short row."""
    header, *rows = read_rows(path, _SEPARATOR) or [TextRow(path, 1, ("",))]
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
        whole.append(TextRow(path, row.line, cells))
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
            raise row.error(point, f"{name} at {places[name]}, as before", f"{place}")
    return places
