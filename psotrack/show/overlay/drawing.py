"""Drawing of drones into images: boxes, names, trails and ellipses, in colours by status."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.show.flights import ellipse_outlines_px, status_rgb
from psotrack.trajectories import Status

#: Fractional bits of the coordinates that OpenCV draws at.
_SHIFT = 4
#: Width of an image in which lines have one pixel, and letters the size 0.5 of OpenCV's font.
_LINE_WIDTH_PX, _FONT_SIZE, _FONT = 900.0, 0.5, cv2.FONT_HERSHEY_SIMPLEX
_WHITE, _DARK = (255, 255, 255), (34, 30, 28)


@dataclass(frozen=True)
class ImageTracks:
    """The tracks of one file as one camera shows them.

    Attributes:
        names: names of the drones, as they are written.
        rgb: colours of the drones.
        status: (rows, drones), values of `Status`.
        boxes_px: (rows, drones, 4), boxes as in `geometry.boxes`; NaN where there is none.
        middle_px: (rows, drones, 2), middles of the ellipses, pixel centres at whole numbers; NaN where there is none.
        shape_px2: (rows, drones, 2, 2), see `ImageEllipses`.
    """

    names: tuple[str, ...]
    rgb: tuple[tuple[int, int, int], ...]
    status: Int[np.ndarray, "rows drones"]
    boxes_px: Float[np.ndarray, "rows drones 4"]
    middle_px: Float[np.ndarray, "rows drones 2"]
    shape_px2: Float[np.ndarray, "rows drones 2 2"]

    def bgr(self, row: int, drone: int) -> tuple[int, int, int]:
        """Colour of a drone in a row, by its status."""
        red, green, blue = status_rgb(int(self.status[row, drone]), self.rgb[drone])
        return blue, green, red


def draw_tracks(
    image: UInt8[np.ndarray, "height width 3"], tracks: ImageTracks, row: int, scale: float, trail_rows: int
) -> None:
    """Draw the drones of one row into an image.

    Args:
        image: (height, width, 3), BGR; is drawn into.
        tracks: the tracks, in pixels of the whole image.
        row: the row.
        scale: pixels of the image per pixel of the whole image.
        trail_rows: number of rows before this one whose places are drawn as a trail.
    """
    line_px = line_width_px(image)
    shown = np.flatnonzero(np.isfinite(tracks.boxes_px[row]).all(axis=1)).tolist()
    # Names first, so that a name does not hide the box of another drone.
    for drone in shown:
        left, top = (tracks.boxes_px[row, drone, :2] * scale).tolist()
        status = Status(int(tracks.status[row, drone]))
        words = tracks.names[drone] if status == Status.TRACKED else f"{tracks.names[drone]} {status.label}"
        place_px = (left + 4 * line_px, top - 6 * line_px)
        write_text(image, words, place_px, tracks.bgr(row, drone))
    for drone in range(len(tracks.names)):
        colour = tracks.bgr(row, drone)
        boxes_px = tracks.boxes_px[max(row - trail_rows, 0) : row + 1, drone]
        trail_px = (boxes_px[:, :2] + boxes_px[:, 2:]) / 2
        _draw_line(image, trail_px[np.isfinite(trail_px).all(axis=1)] * scale - 0.5, colour, line_px)
        if np.isfinite(tracks.middle_px[row, drone]).all():
            outline_px = ellipse_outlines_px(tracks.middle_px[row, drone], tracks.shape_px2[row, drone])
            _draw_line(image, (outline_px + 0.5) * scale - 0.5, colour, line_px)
        if drone in shown:
            left, top, right, bottom = tracks.boxes_px[row, drone] * scale - 0.5
            corners_px = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
            _draw_line(image, corners_px, colour, line_px + 1)


def line_width_px(image: UInt8[np.ndarray, "height width 3"]) -> int:
    """Width of lines, which grows with the image."""
    return max(1, round(image.shape[1] / _LINE_WIDTH_PX))


def write_text(
    image: UInt8[np.ndarray, "height width 3"],
    words: str,
    place_px: tuple[float, float],
    colour: tuple[int, int, int] = _WHITE,
) -> None:
    """Write words on a dark ground, so that they can be read on any image.

    Args:
        image: (height, width, 3), BGR; is drawn into.
        words: the words.
        place_px: left end of the base line; is moved into the image.
        colour: blue, green, red.
    """
    size = _FONT_SIZE * max(1.0, image.shape[1] / _LINE_WIDTH_PX)
    width, edge = line_width_px(image), round(6 * size)
    (length, height), _ = cv2.getTextSize(words, _FONT, size, width)
    column = round(min(max(place_px[0], edge), image.shape[1] - length - edge))
    row = round(min(max(place_px[1], height + edge), image.shape[0] - edge))
    corners = (column - edge, row - height - edge), (column + length + edge, row + edge)
    cv2.rectangle(image, *corners, _DARK, cv2.FILLED)
    cv2.putText(image, words, (column, row), _FONT, size, colour, width, cv2.LINE_AA)


def write_heading(image: UInt8[np.ndarray, "height width 3"], words: str) -> None:
    """Write words at the upper left corner."""
    write_text(image, words, (0.0, 0.0))


def _draw_line(
    image: UInt8[np.ndarray, "height width 3"],
    points_px: Float[np.ndarray, "points 2"],
    colour: tuple[int, int, int],
    width_px: int,
) -> None:
    if len(points_px) > 1:
        # Far outside of the image, the coordinates would not fit into OpenCV's whole numbers.
        near = np.clip(points_px, -10.0 * image.shape[1], 10.0 * image.shape[1])
        fixed = np.rint(near * 2**_SHIFT).astype(np.int32)
        cv2.polylines(image, [fixed], False, colour, width_px, cv2.LINE_AA, _SHIFT)
