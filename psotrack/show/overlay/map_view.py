"""The map from above: cameras, drones with their trails and heights, and a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.geometry import Rig
from psotrack.show.overlay.drawing import DrawnTracks, draw_line, line_width_px, write_text

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

    background: UInt8[np.ndarray, "height width 3"]
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


def draw_map(
    view: MapView, tracks: Sequence[DrawnTracks], row: Sequence[int], trail_rows: int
) -> UInt8[np.ndarray, "height width 3"]:
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
