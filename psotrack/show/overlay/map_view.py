"""The map from above: cameras, drones with their trails and heights, and a scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.show.flights import TrackedFlight, status_rgb
from psotrack.show.overlay.drawing import line_width_px, write_text
from psotrack.trajectories import Status

_BACKGROUND, _GRID, _CAMERA = (34, 30, 28), (58, 52, 48), (190, 190, 190)
#: Empty part of the map at each side.
_MARGIN = 0.12
#: Length of the drawn views of the cameras, share of the map's side.
_VIEW = 0.06


@dataclass(frozen=True)
class MapTracks:
    """The tracks of one file in the world.

    Attributes:
        names: names of the drones, as they are written.
        rgb: colours of the drones.
        status: (rows, drones), values of `Status`.
        position_m: (rows, drones, 3), positions, metres.
    """

    names: tuple[str, ...]
    rgb: tuple[tuple[int, int, int], ...]
    status: Int[np.ndarray, "rows drones"]
    position_m: Float[np.ndarray, "rows drones 3"]


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


def make_map(flight: TrackedFlight, size_wh: tuple[int, int]) -> MapView:
    """A map of the cameras and of all places of the drones.

    Args:
        flight: the flight, with a recording.
        size_wh: width and height of the map, pixels.
    """
    assert flight.recording is not None
    rig = flight.recording.rig
    centres_m = np.asarray(rig.cameras.centre_world, np.float64).reshape(-1, 3)
    parts = [centres_m, *(tracks.trajectories.position_m.reshape(-1, 3) for tracks in flight.tracks)]
    points_m = np.concatenate(parts)
    points_m = points_m[np.isfinite(points_m).all(axis=1), :2]
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    size_px = np.array(size_wh, float)
    px_per_m = float(((1 - 2 * _MARGIN) * size_px / np.maximum(high - low, 0.1)).min())
    origin_px = size_px / 2 - px_per_m * (low + high) / 2 * np.array([1.0, -1.0])
    view = MapView(np.full((size_wh[1], size_wh[0], 3), _BACKGROUND, np.uint8), origin_px, px_per_m)
    _draw_grid(view, size_wh)
    forward = np.asarray(rig.cameras.T_cam_world, np.float64).reshape(-1, 4, 4)[:, 2, :3]
    for name, centre_m, along in zip(rig.names, centres_m, forward, strict=True):
        _draw_camera(view, name, centre_m, along)
    _draw_scale(view)
    return view


def draw_map(
    view: MapView, tracks: Sequence[MapTracks], row: Sequence[int], trail_rows: int
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
        if now < 0:
            continue
        for drone, name in enumerate(own.names):
            colour = status_rgb(int(own.status[now, drone]), own.rgb[drone])[::-1]
            path_px = view.pixels(own.position_m[max(now - trail_rows, 0) : now + 1, drone])
            path_px = path_px[np.isfinite(path_px).all(axis=1)]
            if len(path_px) > 1:
                cv2.polylines(image, [np.rint(path_px).astype(np.int32)], False, colour, width, cv2.LINE_AA)
            if not np.isfinite(own.position_m[now, drone]).all():
                continue
            column, line = np.rint(view.pixels(own.position_m[now, drone])).astype(int).tolist()
            cv2.circle(image, (column, line), 4 * width, colour, cv2.FILLED, cv2.LINE_AA)
            status = Status(int(own.status[now, drone]))
            words = name if status == Status.TRACKED else f"{name} {status.label}"
            height_m = own.position_m[now, drone, 2]
            write_text(image, f"{words}  z {height_m:.1f} m", (column + 7.0 * width, line - 3.0), colour)
    return image


def _draw_grid(view: MapView, size_wh: tuple[int, int]) -> None:
    """A line per metre; per ten metres in a large room."""
    step_m = 1.0 if min(size_wh) / view.px_per_m < 30 else 10.0
    for axis, side in enumerate(size_wh):
        sign = 1 if axis == 0 else -1
        ends = sorted(sign * (edge - view.origin_px[axis]) / view.px_per_m for edge in (0, side))
        for number in range(int(np.ceil(ends[0] / step_m)), int(ends[1] // step_m) + 1):
            place = round(view.origin_px[axis] + sign * number * step_m * view.px_per_m)
            begin, end = [(place, 0), (place, size_wh[1])] if axis == 0 else [(0, place), (size_wh[0], place)]
            cv2.line(view.background, begin, end, _GRID, 1)


def _draw_camera(
    view: MapView, name: str, centre_m: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]
) -> None:
    """A triangle that opens where the camera looks, and its name."""
    image = view.background
    tip_px = view.pixels(centre_m)
    flat = forward[:2] * np.array([1.0, -1.0])
    length_px = _VIEW * min(image.shape[:2])
    along_px = length_px * flat / max(float(np.linalg.norm(flat)), 1e-6)
    across_px = 0.5 * np.array([-along_px[1], along_px[0]])
    corners = np.rint([tip_px, tip_px + along_px + across_px, tip_px + along_px - across_px]).astype(np.int32)
    cv2.polylines(image, [corners], True, _CAMERA, line_width_px(image), cv2.LINE_AA)
    write_text(image, name, (tip_px[0] - along_px[0], tip_px[1] - along_px[1]), _CAMERA)


def _draw_scale(view: MapView) -> None:
    """A bar of 1, 2, 5, 10, ... metres, about a fifth of the map's width."""
    image = view.background
    height, width = image.shape[:2]
    fifth_m = width / 5 / view.px_per_m
    power = 10.0 ** np.floor(np.log10(fifth_m))
    length_m = power * max(factor for factor in (1, 2, 5) if factor * power <= fifth_m)
    begin = (round(0.04 * width), round(0.95 * height))
    end = (round(begin[0] + length_m * view.px_per_m), begin[1])
    cv2.line(image, begin, end, _CAMERA, 2 * line_width_px(image))
    write_text(image, f"{length_m:g} m", (end[0] + 6.0, end[1] + 4.0), _CAMERA)
