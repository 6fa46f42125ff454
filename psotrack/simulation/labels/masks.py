"""Where each drone is seen in the middle of an exposure: drawn in windows around drones, one sample per pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.simulation.imaging.raster import (
    NEAR_M,
    Pinhole,
    RasterView,
    draw,
    empty_buffers,
    enclosing,
    full_view,
)
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import disc_fans

#: Around what is drawn, in pixels.
_MARGIN_PX = 1


@dataclass(frozen=True)
class Silhouette:
    """One drone in one image, in the middle of the exposure; discs of rotors count as drone.

    Attributes:
        number: of the drone, from 1.
        window: the part of the image that holds it.
        seen: (rows, columns) of the window, where nothing hides it.
        whole_px: how many pixels it would have with nothing before it and an image without edges.
    """

    number: int
    window: RasterView
    seen: Bool[np.ndarray, "rows columns"]
    whole_px: int

    @property
    def seen_share(self) -> float:
        """How much of it is seen, 0 to 1."""
        return np.count_nonzero(self.seen) / self.whole_px if self.whole_px else 0.0

    @property
    def xyxy(self) -> Float[np.ndarray, "4"] | None:
        """(4,), the box of what is seen, in the convention of `psotrack.geometry.boxes`; None where nothing is."""
        rows, columns = (np.flatnonzero(self.seen.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return None
        x, y = self.window.x, self.window.y
        return np.array([x + columns[0], y + rows[0], x + columns[-1] + 1.0, y + rows[-1] + 1.0])

    def mask(self) -> Bool[np.ndarray, "height width"]:
        """(height, width), where it is seen in the whole image."""
        whole = np.zeros((self.window.cam.height, self.window.cam.width), bool)
        whole[self.window.slices] = self.seen
        return whole


def silhouettes(
    scene: Scene, cam: Pinhole, backdrop_depth_m: Float[np.ndarray, "height width"], frame: int
) -> list[Silhouette]:
    """The drones that a camera has within its image, whether something hides them or not, by number.

    Args:
        scene: what flies.
        cam: the camera.
        backdrop_depth_m: (height, width), depth of the room, which may hide drones.
        frame: its number.
    """
    time_s = scene.time_s(frame)
    drawn = [_drawn(scene, cam, drone, time_s) for drone in range(len(scene.flights))]
    there = [one for one in drawn if one is not None]
    seen = [one.covered & (one.depth_m < backdrop_depth_m[one.window.slices]) for one in there]
    for i, near in enumerate(there):
        for j in range(i + 1, len(there)):
            _hide(near, there[j], seen[i], seen[j])
    return [
        Silhouette(one.number, one.window, mask, one.whole_px) for one, mask in zip(there, seen, strict=True)
    ]


@dataclass(frozen=True)
class _Drawn:
    """A drone drawn alone: where it covers its window, and at what depth."""

    number: int
    window: RasterView
    covered: Bool[np.ndarray, "rows columns"]
    depth_m: Float[np.ndarray, "rows columns"]
    whole_px: int


def _drawn(scene: Scene, cam: Pinhole, drone: int, time_s: float) -> _Drawn | None:
    shape, flight, at = scene.models[drone], scene.flights[drone], np.array([time_s])
    triangles = np.concatenate([shape.triangles_m, disc_fans(shape)])
    triangles = triangles @ flight.rotation(at)[0].T + flight.position_m(at)[0]
    points = triangles.reshape(-1, 3)
    window = enclosing(full_view(cam), points, _MARGIN_PX)
    if window is None:
        return None
    beyond = window
    if (points @ cam.R[2] + cam.t_m[2]).min() > NEAR_M:
        # What the image's edges cut off counts as hidden.
        around = RasterView(cam, -cam.width // 2, -cam.height // 2, 2 * cam.width, 2 * cam.height)
        beyond = enclosing(around, points, _MARGIN_PX) or window
    colour, depth_m = empty_buffers(beyond)
    draw(beyond, triangles, np.ones((len(triangles), 1, 3)), colour, depth_m)
    covered = colour[..., 0] > 0.5
    part = window.slices_in(beyond)
    return _Drawn(drone + 1, window, covered[part], depth_m[part], int(np.count_nonzero(covered)))


def _hide(
    one: _Drawn, other: _Drawn, seen: Bool[np.ndarray, "rows columns"], other_seen: Bool[np.ndarray, "r c"]
) -> None:
    """Take from each of two drones what the other is before."""
    a, b = one.window, other.window
    if not a.overlaps(b):
        return
    x, y = max(a.x, b.x), max(a.y, b.y)
    right, bottom = min(a.x + a.width, b.x + b.width), min(a.y + a.height, b.y + b.height)
    shared = RasterView(a.cam, x, y, right - x, bottom - y)
    here, there = shared.slices_in(a), shared.slices_in(b)
    both = one.covered[here] & other.covered[there]
    nearer = one.depth_m[here] <= other.depth_m[there]
    seen[here] &= ~(both & ~nearer)
    other_seen[there] &= ~(both & nearer)
