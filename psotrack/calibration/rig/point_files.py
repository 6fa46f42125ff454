"""Points in images, marked by hand, of markers, or of a moving point; and the points that fix a world.

Points marked by hand are a CSV file, `camera,point,x_px,y_px,x_m,y_m,z_m`, with one row for each camera that sees a
point. The position of a point in the world is in any of its rows, or in another CSV file, `point,x_m,y_m,z_m`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.rig.moving_point import PointRig, PointViews
from psotrack.calibration.rig.world import LEAST_POINTS, Similarity, align
from psotrack.errors import InputError, SettingsError
from psotrack.foreground.markers import MarkerDetector
from psotrack.geometry import Rig, triangulate_linearly
from psotrack.recordings import Detections, FrameTimes, VideoInfo, make_timeline, read_frames
from psotrack.support import Table, read_table
from psotrack.trajectories.resampling import interpolated

_SEPARATOR = ","
_WORLD = ("x_m", "y_m", "z_m")
#: Number of frames of a video in which markers are searched: the median over them hides the noise.
_FRAMES = 15
#: Smallest fraction of these frames that must show a marker. A median holds only as long as most values do
#: (P. J. Huber, Robust Statistics, 1981, section 1.4), and what is seen less often may be a false detection.
_SEEN = 0.5
#: Longest time between two frames between which a point is interpolated, in intervals of the camera: one frame in which
#: the point was missed lies between them.
_LONGEST_GAP = 2.5
#: Largest number of a frame.
_LARGEST_FRAME = 2**31


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


def read_image_points(path: str | Path, places: str | Path | None = None) -> dict[str, ImagePoints]:
    """Read the image points of each camera from a CSV file.

    Args:
        path: file with the image points.
        places: file with the points' positions in the world, if `path` does not contain all positions.

    Raises:
        InputError: a file cannot be read, a column or a value is missing, a camera has a point twice, or a point has no
            position in the world or two different positions. The message names the line.
    """
    table = read_table(path, _SEPARATOR, has_gaps=True)
    camera, point = table.column("camera"), table.column("point")
    pixels = [table.column(name) for name in ("x_px", "y_px")]
    place_of = {} if places is None else _places(read_table(places, _SEPARATOR), required=True)
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
                "pass --places",
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
    detector = MarkerDetector(dictionary, ids=corners_m)
    found: dict[int, list[Float[np.ndarray, "4 2"]]] = {}
    frames = 0
    for frame in read_frames(video, max(1, video.num_frames // _FRAMES)):
        frames += 1
        markers = detector.detect(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)).of_single_ids()
        for quad, marker in zip(markers.corners_px, markers.ids.tolist(), strict=True):
            found.setdefault(marker, []).append(quad)
    kept = sorted(marker for marker, quads in found.items() if len(quads) >= _SEEN * frames)
    return ImagePoints(
        tuple(f"{marker}.{corner + 1}" for marker in kept for corner in range(4)),
        np.array([corners_m[marker] for marker in kept]).reshape(-1, 3),
        np.array([np.median(found[marker], axis=0) for marker in kept]).reshape(-1, 2),
    )


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


def read_point_views(path: Path | str) -> PointViews:
    """Read the sightings of one point, or of the two ends of a stick, from a CSV file.

    The columns are camera, frame, x_px, y_px, and point where there are two.

    Raises:
        InputError: the file cannot be read, a column or a value is missing, a camera sees a point twice in a frame,
            or there are more than two points.
    """
    table = read_table(path, _SEPARATOR)
    camera, frame = table.column("camera"), table.column("frame")
    pixels = [table.column(name) for name in ("x_px", "y_px")]
    named = table.find("point")
    seen: dict[tuple[int, str], dict[str, list[float]]] = {}
    cameras: dict[str, None] = {}
    for row in table.rows:
        name = row.text(camera)
        cameras[name] = None
        end = row.text(named) if named is not None else ""
        number = row.number(frame)
        if number != int(number) or abs(number) > _LARGEST_FRAME:
            raise row.error(frame, f"a whole number of at most {_LARGEST_FRAME} in size", f"{number:g}")
        of_frame = seen.setdefault((int(number), end), {})
        if name in of_frame:
            raise row.error(frame, "each point once per camera and frame", f"{int(number)} of {name} again")
        of_frame[name] = [row.number(column) for column in pixels]
    ends = sorted({end for _, end in seen})
    if len(ends) > 2:
        raise InputError(path, expected="one point, or the two ends of a stick", found=f"{len(ends)} points")
    order = sorted(seen)
    names = tuple(cameras)
    points_px = np.full((len(order), len(names), 2), np.nan)
    for index, key in enumerate(order):
        for name, xy in seen[key].items():
            points_px[index, names.index(name)] = xy
    return PointViews(
        names,
        np.array([ends.index(end) for _, end in order], np.int64),
        np.array([number for number, _ in order], np.int64),
        points_px,
    )


def views_of_detections(
    detections: Mapping[str, Detections],
    frame_times: Mapping[str, FrameTimes],
    line_time_s: Mapping[str, float] | None = None,
) -> PointViews:
    """Sightings from the middles of boxes: of each frame the box of highest confidence, if it is only one.

    Args:
        detections: boxes by camera name.
        frame_times: when the frames were exposed, by camera name. Instants are those of `make_timeline`, and a camera's
            pixel at an instant is interpolated by a cubic spline through its frames.
        line_time_s: times from the exposure of one row to that of the next row by camera name, seconds.

    Raises:
        InputError: fewer than two cameras have detections, or the times of a camera's frames are not known.
    """
    if len(detections) < 2:
        raise InputError("detections", expected="at least two cameras", found=f"{len(detections)}")
    names = tuple(detections)
    unknown = [name for name in names if name not in frame_times]
    if unknown:
        raise InputError(
            f"camera {unknown[0]}", expected="times of its frames", found="none", remedy="state its fps"
        )
    timeline = make_timeline({name: frame_times[name] for name in names})
    points_px = np.full((timeline.num_instants, len(names), 2), np.nan)
    for index, name in enumerate(names):
        times = frame_times[name]
        frame, middle_px = _middles(detections[name], times.num_frames)
        time_s = times.time_s[frame] + (line_time_s or {}).get(name, 0.0) * middle_px[:, 1]
        order = np.argsort(time_s, kind="stable")
        path = interpolated(time_s[order], middle_px[order, None], _LONGEST_GAP / times.fps)
        points_px[:, index] = path(timeline.time_s)[:, 0]
    numbers = np.arange(timeline.num_instants)
    return PointViews(names, np.zeros(len(numbers), np.int64), numbers, points_px)


def _middles(
    boxes: Detections, num_frames: int
) -> tuple[Int[np.ndarray, " frames"], Float[np.ndarray, "frames 2"]]:
    """Numbers of the frames, below `num_frames`, and the pixel of the middle of the best box of each."""
    # The last of a frame's boxes is the one of highest confidence.
    order = np.lexsort((boxes.confidence, boxes.frame))
    frame, confidence = boxes.frame[order], boxes.confidence[order]
    is_last = np.append(frame[1:] != frame[:-1], True)
    is_tied = np.append(False, (frame[1:] == frame[:-1]) & (confidence[1:] == confidence[:-1]))
    chosen = order[is_last & ~is_tied & (frame < num_frames)]
    # Pixel centres are at whole numbers, and edges of boxes are half a pixel away from pixel centres.
    middle_px = (boxes.xyxy[chosen, :2] + boxes.xyxy[chosen, 2:]) / 2 - 0.5
    return boxes.frame[chosen].astype(np.int64), middle_px


def stick_length(point_rig: PointRig) -> float:
    """Median distance between the two ends of a stick, in the rig's unit of length.

    Raises:
        InputError: the two ends are never known at one instant.
    """
    first, second = point_rig.by_number(0), point_rig.by_number(1)
    lengths = np.array(
        [np.linalg.norm(first[number] - second[number]) for number in first if number in second]
    )
    if not np.isfinite(lengths).any():
        raise InputError("stick", expected="instants at which both ends are known", found="none")
    return float(np.nanmedian(lengths))


def distance_between(rig: Rig, first: str, second: str) -> float:
    """Distance between two cameras' centres, in the rig's unit of length.

    Raises:
        SettingsError: a camera is not in the rig, or is named twice.
    """
    if first == second or not {first, second} <= set(rig.names):
        raise SettingsError("distance", expected=f"two of {', '.join(rig.names)}", found=f"{first},{second}")
    centres = np.asarray(rig.cameras.centre_world)
    return float(np.linalg.norm(centres[rig.names.index(first)] - centres[rig.names.index(second)]))


@dataclass(frozen=True)
class GivenWorld:
    """Points and where they are.

    Attributes:
        path: the file.
        places_m: positions by name, metres.
        sightings: pixels of the points by camera; none if the points are cameras or instants.
    """

    path: Path
    places_m: Mapping[str, Float[np.ndarray, "3"]]
    sightings: Mapping[str, ImagePoints]


def read_world(path: Path | str) -> GivenWorld:
    """Read the points that fix a world.

    The columns are point, x_m, y_m, z_m; a point is a camera's centre, or the moving point in a frame. Points that are
    marked in images have also the columns camera, x_px, y_px.

    Raises:
        InputError: the file cannot be read, a column or a value is missing, or a point has two positions.
    """
    path = Path(path)
    table = read_table(path, _SEPARATOR, has_gaps=True)
    if table.find("camera") is not None:
        marks = read_image_points(path)
        places = {
            name: place
            for of_camera in marks.values()
            for name, place in zip(of_camera.points, of_camera.points_m, strict=True)
        }
        return GivenWorld(path, places, marks)
    return GivenWorld(
        path, {name: np.array(place) for name, place in _places(table, required=True).items()}, {}
    )


def fit_world(
    rig: Rig,
    given: GivenWorld,
    numbered_m: Mapping[int, Float[np.ndarray, "3"]] | None = None,
    *,
    with_scale: bool,
) -> tuple[Similarity, dict[str, float]]:
    """Find the change of the world that brings a rig to given points.

    Args:
        rig: the rig.
        given: the points.
        numbered_m: positions of a moving point by the number of the instant.
        with_scale: whether the unit of length is open too.

    Returns:
        the change; and the distances that are left, metres, by point.

    Raises:
        InputError: the rig knows fewer than three of the points, or they are on one line.
    """
    found = dict(zip(rig.names, np.asarray(rig.cameras.centre_world), strict=True))
    found |= {f"{number}": place for number, place in (numbered_m or {}).items()}
    if given.sightings:
        found = _triangulated(rig, given)
    names = [name for name in given.places_m if name in found and np.isfinite(found[name]).all()]
    if len(names) < LEAST_POINTS:
        raise InputError(
            given.path,
            expected=f"at least {LEAST_POINTS} points that the rig knows",
            found=f"{len(names)} of {len(given.places_m)}",
            remedy="name cameras or frames, or mark each point in the images of two cameras",
        )
    change, left_m = align(
        np.array([found[name] for name in names]),
        np.array([given.places_m[name] for name in names]),
        with_scale=with_scale,
    )
    return change, dict(zip(names, left_m.tolist(), strict=True))


def world_in_words(path: Path, left_m: Mapping[str, float]) -> str:
    """What the world is, and how well its points are met.

    Args:
        path: file of the points.
        left_m: the distances that are left, metres, by point.
    """
    worst = max(left_m, key=lambda name: left_m[name])
    rms_mm = 1e3 * float(np.sqrt(np.mean(np.square(list(left_m.values())))))
    worst_mm = 1e3 * left_m[worst]
    return (
        f"that of {path}: {len(left_m)} points are met to {rms_mm:.1f} mm (rms), {worst} to {worst_mm:.1f} mm"
    )


def _triangulated(rig: Rig, given: GivenWorld) -> dict[str, np.ndarray]:
    """Positions of marked points in the rig's world; NaN for a point that one camera sees."""
    unknown = [name for name in given.sightings if name not in rig.names]
    if unknown:
        raise InputError(given.path, expected=f"some of {', '.join(rig.names)}", found=f"camera {unknown[0]}")
    points_px = np.full((len(given.places_m), len(rig), 2), np.nan)
    row_of = {name: row for row, name in enumerate(given.places_m)}
    for name, marks in given.sightings.items():
        for point, xy in zip(marks.points, marks.points_px, strict=True):
            points_px[row_of[point], rig.names.index(name)] = xy
    return dict(zip(given.places_m, triangulate_linearly(rig.cameras, points_px), strict=True))
