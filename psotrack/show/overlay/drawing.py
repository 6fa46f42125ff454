"""Drawing of drones into images: boxes, names, trails and ellipses, in colours by status."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.recordings import ImageViews, ellipse_outlines_px
from psotrack.show.flights import FlightTracks, status_rgb, statuses
from psotrack.trajectories import Status

#: How much white is mixed into the colours, which stand before images.
_LIGHTER = 0.2
#: Fractional bits of the coordinates that OpenCV draws at.
_SHIFT = 4
#: Width of an image in which lines have one pixel, and letters the size 0.5 of OpenCV's font.
_LINE_WIDTH_PX, _FONT_SIZE, _FONT = 900.0, 0.5, cv2.FONT_HERSHEY_SIMPLEX
_WHITE, _DARK = (255, 255, 255), (34, 30, 28)


@dataclass(frozen=True)
class DrawnTracks:
    """The tracks of one file as they are drawn.

    Attributes:
        names: names of the drones, as they are written.
        status: (rows, drones), values of `Status`.
        bgr: (rows, drones, 3), colours by status.
        position_m: (rows, drones, 3), positions, metres.
    """

    names: tuple[str, ...]
    status: Int[np.ndarray, "rows drones"]
    bgr: UInt8[np.ndarray, "rows drones 3"]
    position_m: Float[np.ndarray, "rows drones 3"]

    def words(self, row: int, drone: int) -> str:
        """Name of a drone, with its status where it is not tracked."""
        status = Status(int(self.status[row, drone]))
        return self.names[drone] if status == Status.TRACKED else f"{self.names[drone]} {status.label}"

    def colour(self, row: int, drone: int) -> tuple[int, int, int]:
        """Colour of a drone, for OpenCV."""
        blue, green, red = self.bgr[row, drone].tolist()
        return blue, green, red


@dataclass(frozen=True)
class ImagePlaces:
    """Where one camera shows the drones of one file; see `ImageViews`.

    Attributes:
        boxes_px: (rows, drones, 4), boxes.
        middle_px: (rows, drones, 2), middles of the ellipses.
        shape_px2: (rows, drones, 2, 2), shapes of the ellipses.
    """

    boxes_px: Float[np.ndarray, "rows drones 4"]
    middle_px: Float[np.ndarray, "rows drones 2"]
    shape_px2: Float[np.ndarray, "rows drones 2 2"]


def drawn_tracks(tracks: FlightTracks) -> DrawnTracks:
    """The tracks of a file, in colours that stand out before images."""
    status = statuses(tracks.trajectories)
    bgr = status_rgb(status, tracks.colours, lighter=_LIGHTER)[..., ::-1]
    return DrawnTracks(tracks.names, status, bgr, tracks.trajectories.position_m)


def places_in(views: ImageViews, camera: int) -> ImagePlaces:
    """Where one of the cameras shows the drones."""
    return ImagePlaces(
        views.boxes_px[:, :, camera], views.middle_px[:, :, camera], views.shape_px2[:, :, camera]
    )


def draw_drones(
    image: UInt8[np.ndarray, "height width 3"],
    tracks: DrawnTracks,
    places: ImagePlaces,
    row: int,
    scale: float = 1.0,
    corner_px: tuple[float, float] = (0.0, 0.0),
    trail_rows: int = 0,
) -> None:
    """Draw the drones of one row into an image, or into an enlarged part of it.

    Args:
        image: (height, width, 3), BGR; is drawn into.
        tracks: the tracks.
        places: their places, in pixels of the whole image.
        row: the row.
        scale: pixels of the image per pixel of the whole image.
        corner_px: upper left corner of the part in the whole image, pixels.
        trail_rows: number of rows before this one whose places are drawn as a trail.
    """
    width = line_width_px(image)
    boxes_px = (places.boxes_px[max(row - trail_rows, 0) : row + 1] - np.tile(corner_px, 2)) * scale
    inside = (boxes_px[-1, :, 2:] > 0).all(axis=1) & (boxes_px[-1, :, :2] < image.shape[1::-1]).all(axis=1)
    shown = np.flatnonzero(inside).tolist()
    # Names first, so that a name does not hide the box of another drone.
    for drone in shown:
        left, top = boxes_px[-1, drone, :2].tolist()
        write_text(
            image, tracks.words(row, drone), (left + 4 * width, top - 6 * width), tracks.colour(row, drone)
        )
    for drone in range(len(tracks.names)):
        colour = tracks.colour(row, drone)
        draw_line(image, (boxes_px[:, drone, :2] + boxes_px[:, drone, 2:]) / 2 - 0.5, colour, width)
        if np.isfinite(places.middle_px[row, drone]).all():
            outline_px = ellipse_outlines_px(places.middle_px[row, drone], places.shape_px2[row, drone])
            # A pixel's centre is at a whole number for OpenCV, and half a pixel further for boxes.
            draw_line(image, (outline_px + 0.5 - corner_px) * scale - 0.5, colour, width)
        if drone in shown:
            draw_line(
                image, boxes_px[-1, drone, [[0, 1], [2, 1], [2, 3], [0, 3], [0, 1]]] - 0.5, colour, width + 1
            )


def line_width_px(image: UInt8[np.ndarray, "height width 3"]) -> int:
    """Width of lines, which grows with the image."""
    return max(1, round(image.shape[1] / _LINE_WIDTH_PX))


def draw_line(
    image: UInt8[np.ndarray, "height width 3"],
    points_px: Float[np.ndarray, "points 2"],
    colour: tuple[int, int, int],
    width_px: int,
) -> None:
    """Draw a line through those of some points that are known."""
    known_px = points_px[np.isfinite(points_px).all(axis=1)]
    if len(known_px) > 1:
        # Far outside of the image, the coordinates would not fit into OpenCV's whole numbers.
        near_px = np.clip(known_px, -10.0 * image.shape[1], 10.0 * image.shape[1])
        fixed = np.rint(near_px * 2**_SHIFT).astype(np.int32)
        cv2.polylines(image, [fixed], False, colour, width_px, cv2.LINE_AA, _SHIFT)


def write_text(
    image: UInt8[np.ndarray, "height width 3"],
    words: str,
    place_px: tuple[float, float] = (0.0, 0.0),
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
