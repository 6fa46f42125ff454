"""Points in images: points marked by hand, and corners of markers of known positions.

Points marked by hand are a CSV file, `camera,point,x_px,y_px,x_m,y_m,z_m`, with one row for each camera that sees a
point. The position of a point in the world is in any of its rows, or in another CSV file, `point,x_m,y_m,z_m`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.foreground.markers import MarkerDetector
from psotrack.recordings import VideoInfo, read_frames
from psotrack.support import Table, read_table

_SEPARATOR = ","
_WORLD = ("x_m", "y_m", "z_m")
#: Number of frames of a video in which markers are searched: the median over them hides the noise.
_FRAMES = 15
#: Smallest fraction of these frames that must show a marker. A median holds only as long as most values do
#: (P. J. Huber, Robust Statistics, 1981, section 1.4), and what is seen less often may be a false detection.
_SEEN = 0.5


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
