"""Points in images: points marked by hand, corners of markers of known positions, and tracked drones.

Points marked by hand are a CSV file, `camera,point,x_px,y_px,x_m,y_m,z_m`, with one row for each camera that sees a
point. The position of a point in the world is in any of its rows, or in another CSV file, `point,x_m,y_m,z_m`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.common_errors import CommonErrors
from psotrack.errors import InputError
from psotrack.foreground.detection import marker_dictionary
from psotrack.geometry import Rig, project_visible
from psotrack.recordings import Detections, FrameTimes, VideoInfo, nearest_frames, read_frames
from psotrack.support import Column, Table, TextRow, read_rows
from psotrack.tracking.matching import BORDER_PX, NOISE_PX, NOISE_SHARE
from psotrack.trajectories import Trajectories, resample

_SEPARATOR = ","
_WORLD = ("x_m", "y_m", "z_m")
#: Number of frames of a video in which markers are searched: the median over them hides the noise.
_FRAMES = 15
#: Smallest share of these frames that must show a marker: a rarer marker is a false detection.
_SEEN = 0.5
#: Standard deviation of each kind of common error of boxes, as a share of the box's mean side, and time over which the
#: first kind lasts, seconds. There are three kinds. The first lasts as long as a drone's attitude is the same. The
#: second comes from the drone's shape and is the same in all frames of a camera. The third is shared by all drones of a
#: camera and varies over the image, because the camera sees drones at different distances and elevations.
_COMMON_SHARE, _COMMON_S = 0.015, 1.0


@dataclass(frozen=True)
class ImagePoints:
    """Points of known position in one camera's image.

    Attributes:
        points: names of the points.
        points_m: (points, 3), positions in the world, metres.
        points_px: (points, 2), positions in the image, pixels.
    """

    points: tuple[str, ...]
    points_m: Float[np.ndarray, "points 3"]
    points_px: Float[np.ndarray, "points 2"]


@dataclass(frozen=True)
class DroneViews:
    """Tracked drones in the images of all cameras, one point per drone and frame.

    Attributes:
        points: names of the points, such as `dron1@40` for frame 40.
        points_px: (points, cameras, 2), middles of boxes, pixels; NaN where a camera has no clear box of the drone.
        noise_px: (points, cameras), standard deviations of the errors that differ from frame to frame, pixels; NaN like
            `points_px`.
        common_errors: errors that last over many frames.
        frame: (points,), number of each point's frame.
        drone: (points,), index of each point's drone.
        side_px: (points, cameras), mean sides of the boxes, pixels; NaN like `points_px`.
    """

    points: tuple[str, ...]
    points_px: Float[np.ndarray, "points cameras 2"]
    noise_px: Float[np.ndarray, "points cameras"]
    common_errors: tuple[CommonErrors, ...]
    frame: Int[np.ndarray, "points"]
    drone: Int[np.ndarray, "points"]
    side_px: Float[np.ndarray, "points cameras"]


def read_image_points(path: str | Path, places: str | Path | None = None) -> dict[str, ImagePoints]:
    """Read the image points of each camera from a CSV file.

    Args:
        path: file with the image points.
        places: file with the points' positions in the world, if `path` does not contain all positions.

    Raises:
        InputError: a file cannot be read, a column or a value is missing, a camera has a point twice, or a point has no
            position in the world or two different positions. The message names the line.
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
        name: ImagePoints(
            tuple(rows),
            np.array([place_of[point] for point in rows]),
            np.array(list(rows.values())),
        )
        for name, rows in seen.items()
    }


def find_markers(
    video: VideoInfo, corners_m: Mapping[int, Float[np.ndarray, "4 3"]], dictionary: str = "4x4_1000"
) -> ImagePoints:
    """Find the corners of markers of known positions in the video of a static camera, as medians over frames.

    Args:
        video: the camera's video.
        corners_m: by marker id, (4, 3), positions of the corners in the world, metres, in the order of OpenCV's ArUco.
        dictionary: name of the markers' dictionary, such as 4x4_50.

    Returns:
        Image points; the corners of marker 7 are called `7.1` to `7.4`.

    Raises:
        InputError: the video cannot be read.
        SettingsError: the dictionary does not exist.
    """
    step = max(1, video.num_frames // _FRAMES)
    greys = (cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in read_frames(video, step))
    return find_markers_in(greys, corners_m, dictionary)


def find_markers_in(
    images: Iterable[np.ndarray],
    corners_m: Mapping[int, Float[np.ndarray, "4 3"]],
    dictionary: str = "4x4_1000",
) -> ImagePoints:
    """Find the corners of markers of known positions in grey images of a static camera; see `find_markers`."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), parameters)
    found: dict[int, list[Float[np.ndarray, "4 2"]]] = {}
    frames = 0
    for grey in images:
        frames += 1
        quads, ids, _ = detector.detectMarkers(grey)
        for quad, marker in zip(quads, [] if ids is None else map(int, ids.ravel()), strict=True):
            if marker in corners_m:
                found.setdefault(marker, []).append(quad.reshape(4, 2).astype(np.float64))
    kept = sorted(marker for marker, quads in found.items() if len(quads) >= _SEEN * frames)
    return ImagePoints(
        tuple(f"{marker}.{corner + 1}" for marker in kept for corner in range(4)),
        np.array([corners_m[marker] for marker in kept]).reshape(-1, 3),
        np.array([np.median(found[marker], axis=0) for marker in kept]).reshape(-1, 2),
    )


def find_drones_in_boxes(
    rig: Rig,
    detections: Mapping[str, Detections],
    tracks: Trajectories,
    most_frames: int = 500,
    frame_times: Mapping[str, FrameTimes] | None = None,
) -> DroneViews:
    """Find tracked drones in the images: the middle of the box that contains a drone's projection.

    Boxes that contain two drones, drones in two boxes, boxes that the image's border cuts, and boxes that touch other
    boxes are not used. Of long tracks only every n-th frame is used, because neighbouring frames have the same errors.

    Where the cameras' frames were not exposed together, each camera shows its frame nearest to the track's time. The
    middle of a box is moved by the motion of the track's projection from the exposure to that time, which is at most
    0.6 frames of the camera. No camera shows a frame twice.

    Args:
        rig: cameras with which the drones were tracked.
        detections: detections by camera name; a camera without an entry has no detections.
        tracks: positions of the drones.
        most_frames: largest number of frames that are used.
        frame_times: times of each camera's frames on the clock of the tracks; None where frame i of every camera was
            exposed at the time of the tracks' frame i.
    """
    shortest = 1 if frame_times is None else _rows_per_frame(tracks, frame_times)
    rows = np.arange(0, tracks.num_frames, max(shortest, -(-tracks.num_frames // most_frames)))
    places_m = np.where(tracks.seen[..., None], tracks.position_m, np.nan)
    frames = np.repeat(tracks.frame[rows, None], len(rig), axis=1)
    shown_m = places_m[rows, :, None]
    if frame_times is not None:
        frames, shown_m = _at_exposures(rig, replace(tracks, position_m=places_m), rows, frame_times)
    projected, depth = project_visible(rig.cameras, shown_m)
    motion_px = np.zeros(projected.shape)
    if frame_times is not None:
        motion_px = np.asarray(project_visible(rig.cameras, places_m[rows, :, None])[0] - projected)
    points_px, side_px = np.full(projected.shape, np.nan), np.full(depth.shape, np.nan)
    for camera, name in enumerate(rig.names):
        for row, frame in enumerate(frames[:, camera].tolist() if name in detections else []):
            xyxy = detections[name].in_frame(frame).xyxy
            clear = _clear(xyxy, np.asarray(rig.cameras.image_size_wh[camera]))
            at = projected[row, :, camera, None]
            # Pixel centres are at whole numbers, and edges of boxes are half a pixel away from pixel centres.
            xyxy = xyxy - 0.5
            holds = ((at >= xyxy[:, :2]) & (at <= xyxy[:, 2:])).all(axis=-1)
            holds &= (depth[row, :, camera] > 0)[:, None]
            alone = holds & (holds.sum(axis=0) == 1) & (holds.sum(axis=1) == 1)[:, None]
            drone, box = np.nonzero(alone & clear)
            points_px[row, drone, camera] = (xyxy[box, :2] + xyxy[box, 2:]) / 2
            side_px[row, drone, camera] = np.sqrt((xyxy[box, 2:] - xyxy[box, :2]).prod(axis=-1))
    points_px += motion_px
    side_px[np.isnan(points_px).any(axis=-1)] = np.nan
    names = [f"{drone}@{frame}" for frame in tracks.frame[rows].tolist() for drone in tracks.drones]
    drone = np.tile(np.arange(tracks.num_drones), len(rows))
    second = np.floor(tracks.time_s[rows] / _COMMON_S).astype(np.int64).repeat(tracks.num_drones)
    points_px, side_px = points_px.reshape(-1, len(rig), 2), side_px.reshape(-1, len(rig))
    return DroneViews(
        tuple(names),
        points_px,
        NOISE_PX + NOISE_SHARE * side_px,
        _make_common_errors(
            rig, points_px, side_px, drone, (second - second.min(initial=0)) * tracks.num_drones + drone
        ),
        np.repeat(tracks.frame[rows].astype(np.int64), tracks.num_drones),
        drone,
        side_px,
    )


def _rows_per_frame(tracks: Trajectories, frame_times: Mapping[str, FrameTimes]) -> int:
    """Number of rows of the tracks in an interval of the slowest camera."""
    if tracks.num_frames < 2 or not frame_times:
        return 1
    row_s = float(np.median(np.diff(tracks.time_s)))
    slowest = min(times.fps for times in frame_times.values())
    # A thousandth: rates are rounded in files.
    return max(1, int(np.ceil(1 / (slowest * row_s) - 1e-3)))


def _at_exposures(
    rig: Rig,
    tracks: Trajectories,
    rows: Int[np.ndarray, "rows"],
    frame_times: Mapping[str, FrameTimes],
) -> tuple[Int[np.ndarray, "rows cameras"], Float[np.ndarray, "rows drones cameras 3"]]:
    """Each camera's frame nearest to each row of the tracks, -1 for none, and where the drones were at its exposure."""
    time_s = tracks.time_s[rows]
    frames = np.full((len(rows), len(rig)), -1)
    shown_m = np.full((len(rows), tracks.num_drones, len(rig), 3), np.nan)
    for camera, name in enumerate(rig.names):
        if name in frame_times:
            frames[:, camera], offset_s = nearest_frames(frame_times[name], time_s)
            shown_m[:, :, camera] = resample(tracks, rows, time_s + offset_s).position_m
    # Two rows may be near one frame at the beginning or the end of a video.
    frames[1:][np.diff(frames, axis=0) == 0] = -1
    shown_m[np.broadcast_to((frames < 0)[:, None], shown_m.shape[:3])] = np.nan
    return frames, shown_m


def _clear(
    xyxy: Float[np.ndarray, "boxes 4"], image_size_wh: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, " boxes"]:
    """(boxes,), True for boxes that the image's border does not cut and that no other box touches."""
    sides = np.minimum(xyxy[:, None, 2:], xyxy[:, 2:]) - np.maximum(xyxy[:, None, :2], xyxy[:, :2])
    touched = (sides > 0).all(axis=-1).sum(axis=1) > 1
    cut = (xyxy[:, :2] < BORDER_PX) | (xyxy[:, 2:] > image_size_wh - BORDER_PX)
    return ~touched & ~cut.any(axis=-1)


def _make_common_errors(
    rig: Rig,
    points_px: Float[np.ndarray, "points cameras 2"],
    side_px: Float[np.ndarray, "points cameras"],
    drone: Int[np.ndarray, " points"],
    second: Int[np.ndarray, " points"],
) -> tuple[CommonErrors, ...]:
    """Errors of boxes that last: per drone for a second, per drone for the recording, and per camera for all drones."""
    middle_px = np.asarray(rig.cameras.K)[:, :2, 2]
    from_middle = (points_px - middle_px) / (np.asarray(rig.cameras.image_size_wh) / 2)
    everything = np.zeros_like(drone)
    return (
        CommonErrors(second, _COMMON_SHARE * side_px),
        CommonErrors(drone, _COMMON_SHARE * side_px),
        *(
            CommonErrors(everything, _COMMON_SHARE * side_px * factor)
            for factor in (1.0, *np.moveaxis(from_middle, -1, 0))
        ),
    )


def _read_table(path: str | Path) -> Table:
    """Read a table whose last cells may be empty; `read_table` would refuse such a row as too short."""
    path = Path(path)
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
    """Positions of points in the world; a point with several rows must have the same position in each row."""
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
