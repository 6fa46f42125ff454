"""Drawing of drones into images: boxes, names, trails and ellipses, in colours by status; and the map from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.geometry import Rig
from psotrack.recordings import ImageViews, ellipse_outlines_px
from psotrack.show.flights import FlightTracks, status_rgb, statuses
from psotrack.trajectories import Status

Image = UInt8[np.ndarray, "height width 3"]
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
    image: Image,
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


def line_width_px(image: Image) -> int:
    """Width of lines, which grows with the image."""
    return max(1, round(image.shape[1] / _LINE_WIDTH_PX))


def draw_line(
    image: Image, points_px: Float[np.ndarray, "points 2"], colour: tuple[int, int, int], width_px: int
) -> None:
    """Draw a line through those of some points that are known."""
    known_px = points_px[np.isfinite(points_px).all(axis=1)]
    if len(known_px) > 1:
        # Far outside of the image, the coordinates would not fit into OpenCV's whole numbers.
        near_px = np.clip(known_px, -10.0 * image.shape[1], 10.0 * image.shape[1])
        fixed = np.rint(near_px * 2**_SHIFT).astype(np.int32)
        cv2.polylines(image, [fixed], False, colour, width_px, cv2.LINE_AA, _SHIFT)


def write_text(
    image: Image,
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


_BACKGROUND, _GRID, _CAMERA = (34, 30, 28), (58, 52, 48), (190, 190, 190)
#: Empty part of the map at each side.
_MARGIN = 0.12
#: Length of the drawn views of the cameras, fraction of the map's side.
_VIEW = 0.06
#: Largest width of a map with a line per metre, metres.
_FINE_GRID_M = 30.0


@dataclass(frozen=True)
class MapView:
    """A map from above.

    Attributes:
        background: (height, width, 3), BGR, with all that does not move.
        origin_px: pixel of the world's origin.
        px_per_m: pixels per metre; x goes to the right, y upwards.
    """

    background: Image
    origin_px: Float[np.ndarray, "2"]
    px_per_m: float

    def pixels(self, position_m: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*points 2"]:
        """Places on the map."""
        return self.origin_px + self.px_per_m * position_m[..., :2] * np.array([1.0, -1.0])


def make_map(rig: Rig, tracks: Sequence[DrawnTracks], size_wh: tuple[int, int]) -> MapView:
    """A map of the cameras and of all places of the drones.

    Args:
        rig: the cameras.
        tracks: the tracks of each file.
        size_wh: width and height of the map, pixels.
    """
    centres_m = np.asarray(rig.cameras.centre_world, np.float64).reshape(-1, 3)
    points_m = np.concatenate([centres_m, *(each.position_m.reshape(-1, 3) for each in tracks)])
    low_m, high_m = np.nanmin(points_m[:, :2], axis=0), np.nanmax(points_m[:, :2], axis=0)
    px_per_m = float(((1 - 2 * _MARGIN) * np.array(size_wh) / np.maximum(high_m - low_m, 0.1)).min())
    origin_px = np.array(size_wh) / 2 - px_per_m * (low_m + high_m) / 2 * np.array([1.0, -1.0])
    view = MapView(np.full((*size_wh[::-1], 3), _BACKGROUND, np.uint8), origin_px, px_per_m)
    _draw_grid(view)
    forward = np.asarray(rig.cameras.T_cam_world, np.float64).reshape(-1, 4, 4)[:, 2, :3]
    for name, centre_m, along in zip(rig.names, centres_m, forward, strict=True):
        _draw_camera(view, name, centre_m, along)
    return view


def draw_map(view: MapView, tracks: Sequence[DrawnTracks], row: Sequence[int], trail_rows: int) -> Image:
    """The map at one moment.

    Args:
        view: the map.
        tracks: the tracks of each file.
        row: the row of each file's tracks; -1 for none.
        trail_rows: number of rows before the row whose places are drawn as a trail.
    """
    image = view.background.copy()
    width = line_width_px(image)
    for own, now in zip(tracks, row, strict=True):
        for drone in range(len(own.names)) if now >= 0 else ():
            colour, position_m = own.colour(now, drone), own.position_m[now, drone]
            path_px = view.pixels(own.position_m[max(now - trail_rows, 0) : now + 1, drone])
            draw_line(image, path_px, colour, width)
            if np.isfinite(position_m).all():
                column, line = np.rint(path_px[-1]).astype(int).tolist()
                cv2.circle(image, (column, line), 4 * width, colour, cv2.FILLED, cv2.LINE_AA)
                words = f"{own.words(now, drone)}  z {position_m[2]:.1f} m"
                write_text(image, words, (column + 7.0 * width, line - 3.0), colour)
    return image


def _draw_grid(view: MapView) -> None:
    """A line per metre, or per ten metres in a large room, and words that say so."""
    height, width = view.background.shape[:2]
    step_m = 1.0 if min(width, height) / view.px_per_m < _FINE_GRID_M else 10.0
    step_px = step_m * view.px_per_m
    for column in np.arange(view.origin_px[0] % step_px, width, step_px).round().astype(int).tolist():
        cv2.line(view.background, (column, 0), (column, height), _GRID, 1)
    for line in np.arange(view.origin_px[1] % step_px, height, step_px).round().astype(int).tolist():
        cv2.line(view.background, (0, line), (width, line), _GRID, 1)
    write_text(view.background, f"grid {step_m:g} m", (0.02 * width, 0.97 * height), _CAMERA)


def _draw_camera(
    view: MapView, name: str, centre_m: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]
) -> None:
    """A triangle that opens where the camera looks, and its name."""
    image, tip_px = view.background, view.pixels(centre_m)
    flat = forward[:2] * np.array([1.0, -1.0])
    along_px = _VIEW * min(image.shape[:2]) * flat / max(float(np.linalg.norm(flat)), 1e-6)
    across_px = 0.5 * np.array([-along_px[1], along_px[0]])
    corners_px = np.array([tip_px, tip_px + along_px + across_px, tip_px + along_px - across_px, tip_px])
    draw_line(image, corners_px, _CAMERA, line_width_px(image))
    column, line = (tip_px - along_px).tolist()
    write_text(image, name, (column, line), _CAMERA)
