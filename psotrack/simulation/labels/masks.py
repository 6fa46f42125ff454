"""Visible masks of drones in the middle of an exposure, drawn in windows around the drones, one sample per pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from psotrack.simulation.imaging.lens_image import LensImage
from psotrack.simulation.imaging.raster import (
    NEAR_M,
    Pinhole,
    RasterView,
    draw,
    empty_buffers,
    enclosing_window,
    full_view,
)
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import disc_fans

#: Margin of a window around its drone, pixels.
_MARGIN_PX = 1


@dataclass(frozen=True)
class Silhouette:
    """One drone in one image, in the middle of the exposure; rotor discs belong to the drone.

    Attributes:
        number: number of the drone, from 1.
        window: part of the image that contains the drone.
        seen: (rows, columns) of the window, True at the pixels where the drone is visible.
        whole_px: number of pixels that the drone would have without occlusion and without the edges of the image.
    """

    number: int
    window: RasterView
    seen: Bool[np.ndarray, "rows columns"]
    whole_px: int

    @property
    def seen_share(self) -> float:
        """Visible share of the drone, 0 to 1."""
        return np.count_nonzero(self.seen) / self.whole_px if self.whole_px else 0.0

    @property
    def xyxy(self) -> Float[np.ndarray, "4"] | None:
        """(4,), box of the visible part, in the convention of `psotrack.geometry.boxes`; None if nothing is visible."""
        rows, columns = (np.flatnonzero(self.seen.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return None
        x, y = self.window.x, self.window.y
        return np.array([x + columns[0], y + rows[0], x + columns[-1] + 1.0, y + rows[-1] + 1.0])

    def mask(self) -> Bool[np.ndarray, "height width"]:
        """(height, width), True at the pixels of the whole image where the drone is visible."""
        whole = np.zeros((self.window.cam.height, self.window.cam.width), bool)
        whole[self.window.slices] = self.seen
        return whole


def silhouettes(
    scene: Scene, cam: Pinhole, backdrop_depth_m: Float[np.ndarray, "height width"], frame: int
) -> list[Silhouette]:
    """Silhouettes of the drones within a camera's image, ordered by number; a silhouette may be fully occluded.

    Args:
        scene: the scene.
        cam: the camera.
        backdrop_depth_m: (height, width), depth of the room, which may hide drones.
        frame: number of the frame.
    """
    time_s = scene.time_s(frame)
    drawn = [_draw_alone(scene, cam, drone, time_s) for drone in range(len(scene.flights))]
    nearest_m, owner = backdrop_depth_m.copy(), np.zeros(backdrop_depth_m.shape, np.int32)
    in_image = [each for each in drawn if each is not None]
    for alone, depth_m in in_image:
        window = alone.window.slices
        is_front = alone.seen & (depth_m < nearest_m[window])
        nearest_m[window][is_front] = depth_m[is_front]
        owner[window][is_front] = alone.number
    return [replace(alone, seen=owner[alone.window.slices] == alone.number) for alone, _ in in_image]


def lens_silhouettes(
    scene: Scene,
    cam: Pinhole,
    lens: LensImage,
    backdrops_depth_m: Sequence[Float[np.ndarray, "_ _"]],
    frame: int,
) -> list[Silhouette]:
    """Silhouettes of the drones in the image of a lens with distortion, as from `silhouettes`.

    Args:
        scene: the scene.
        cam: the camera without its distortion.
        lens: the image of the lens.
        backdrops_depth_m: for each face of the lens (height, width), depth of the room.
        frame: number of the frame.
    """
    by_face = [
        {drone.number: drone for drone in silhouettes(scene, face, depth_m, frame)}
        for face, depth_m in zip(lens.faces, backdrops_depth_m, strict=True)
    ]
    found = []
    for number in sorted(set().union(*by_face)):
        masks, share, whole_px = [], 0.0, 0
        for drones, face, used in zip(by_face, lens.faces, lens.used, strict=True):
            drone = drones.get(number)
            mask = np.zeros((face.height, face.width), bool) if drone is None else drone.mask() & used
            masks.append(mask.astype(np.uint8))
            if drone is not None and drone.whole_px:
                share += np.count_nonzero(mask) / drone.whole_px
                whole_px = max(whole_px, drone.whole_px)
        whole = lens.assemble(masks, cv2.INTER_NEAREST)
        x, y, width, height = cv2.boundingRect(whole)
        window = RasterView(cam, x, y, width, height)
        seen = whole[window.slices].astype(bool)
        if share > 0:
            # The lens changes the area of the whole drone as it changes the area of the visible part.
            whole_px = round(np.count_nonzero(seen) / min(share, 1.0))
        found.append(Silhouette(number, window, seen, whole_px))
    return found


def _draw_alone(
    scene: Scene, cam: Pinhole, drone: int, time_s: float
) -> tuple[Silhouette, Float[np.ndarray, "rows columns"]] | None:
    """The silhouette of a drone that nothing hides, and its depth in the window; None outside the image."""
    shape, flight, at = scene.models[drone], scene.flights[drone], np.array([time_s])
    triangles = np.concatenate([shape.triangles_m, disc_fans(shape)])
    triangles = triangles @ flight.rotation(at)[0].T + flight.position_m(at)[0]
    points = triangles.reshape(-1, 3)
    window = enclosing_window(full_view(cam), points, _MARGIN_PX)
    if window is None:
        return None
    beyond = window
    if (points @ cam.R[2] + cam.t_m[2]).min() > NEAR_M:
        # Parts of the drone outside the image count as hidden.
        around = RasterView(cam, -cam.width // 2, -cam.height // 2, 2 * cam.width, 2 * cam.height)
        beyond = enclosing_window(around, points, _MARGIN_PX) or window
    colour, depth_m = empty_buffers(beyond)
    draw(beyond, triangles, np.ones((len(triangles), 1, 3)), colour, depth_m)
    covered = colour[..., 0] > 0.5
    part = window.slices_in(beyond)
    alone = Silhouette(drone + 1, window, covered[part], int(np.count_nonzero(covered)))
    return alone, depth_m[part]
