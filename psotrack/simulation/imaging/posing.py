"""Drones put into the world and seen through a window of a camera's image.

A drone is drawn in several passes, each with its samples elsewhere in the pixel and at another time of the exposure:
edges without stairs and motion blur in one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.simulation.imaging.raster import RasterView, draw, empty_buffers, enclosing
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import disc_fans

NUM_PASSES = 8
#: Reflectance of what is not painted.
_DARK_PLASTIC = 0.02
#: Of a rotor disc, blades smeared by their turning: opacity at the hub and at the tip, reflectance.
_DISC_OPACITY = (0.55, 0.30)
_DISC_REFLECTANCE = 0.06

#: Points mirrored by the floor.
MIRRORED = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class PosedDrone:
    """One drone during one exposure.

    Attributes:
        faces_m: (times, faces, 3, 3), world.
        light: (faces, 1, 3), linear BGR; one light for the whole exposure.
        discs_m: (times, slices, 3, 3), rotor discs as fans, hub first.
        disc_opacity_light: (slices, 3, 3) at the corners: opacity and light in the first two channels.
    """

    faces_m: Float[np.ndarray, "times faces 3 3"]
    light: Float[np.ndarray, "faces 1 3"]
    discs_m: Float[np.ndarray, "times slices 3 3"]
    disc_opacity_light: Float[np.ndarray, "slices 3 3"]

    def mirrored(self, times: list[int]) -> PosedDrone:
        """The drone at some of its times as the floor mirrors it: upside down, each face with its own light."""
        return replace(self, faces_m=self.faces_m[times] * MIRRORED, discs_m=self.discs_m[times] * MIRRORED)


def pass_samples(imaging: Imaging) -> Float[np.ndarray, "passes 3"]:
    """(passes, 3): where in the pixel (x, y) and when in the exposure (-1/2 to 1/2) each pass has its samples.

    Evenly spread: Hammersley points of bases 2 and 3. Their mean is the pixel's centre and the exposure's middle, so
    nothing shifts. Without anti-aliasing all lie on the centre; without an exposure as well, one pass is enough.
    """
    passes = NUM_PASSES if imaging.antialiasing or imaging.shutter_s else 1
    points = np.array(
        [(_radical_inverse(i, 2), _radical_inverse(i, 3), (i + 0.5) / passes) for i in range(passes)]
    )
    return (points - points.mean(axis=0)) * [imaging.antialiasing, imaging.antialiasing, 1.0]


def _radical_inverse(number: int, base: int) -> float:
    value, weight = 0.0, 1.0 / base
    while number:
        value += weight * (number % base)
        number, weight = number // base, weight / base
    return value


def pose(scene: Scene, drone: int, time_s: Float[np.ndarray, "times"]) -> PosedDrone:
    """A drone of a scene at some times of one exposure."""
    flight, shape = scene.flights[drone], scene.models[drone]
    rotation, position = flight.rotation(time_s), flight.position_m(time_s)
    middle = len(time_s) // 2
    normals = shape.normals @ rotation[middle].T
    panels = scene.room.panels
    paint = np.array(scene.scenario.drones[drone].paint_bgr)
    reflectance = _DARK_PLASTIC + shape.paint[:, None] * (paint - _DARK_PLASTIC)
    light = reflectance * panels.on_faces(position[middle], normals)[:, None]
    discs = disc_fans(shape)
    shade = _DISC_REFLECTANCE * panels.on_faces(position[middle], rotation[middle, :, 2][None])[0]
    hub, tip = _DISC_OPACITY
    corner_values = np.array([(hub, shade, 0.0), (tip, shade, 0.0), (tip, shade, 0.0)])
    return PosedDrone(
        faces_m=_placed(shape.triangles_m, rotation, position),
        light=light[:, None],
        discs_m=_placed(discs, rotation, position),
        disc_opacity_light=np.broadcast_to(corner_values, discs.shape),
    )


def _placed(
    triangles_m: Float[np.ndarray, "faces 3 3"],
    rotation: Float[np.ndarray, "times 3 3"],
    position_m: Float[np.ndarray, "times 3"],
) -> Float[np.ndarray, "times faces 3 3"]:
    """(times, faces, 3, 3): triangles of the body frame in the world."""
    corners = triangles_m.reshape(-1, 3) @ rotation.swapaxes(-1, -2) + position_m[:, None]
    return corners.reshape(len(rotation), *triangles_m.shape)


def margin_px(blur_px: float) -> int:
    """Pixels to keep around what is drawn for a blur of that standard deviation, and for motion."""
    return 2 + int(np.ceil(4 * blur_px))


def windows(
    whole: RasterView, posed: list[PosedDrone], margin_px: int
) -> list[tuple[RasterView, list[PosedDrone]]]:
    """Parts of a window that hold drones, those that overlap made one, with the drones in each."""
    found: list[tuple[RasterView, list[PosedDrone]]] = []
    for drone in posed:
        # What moves evenly is widest at the exposure's ends.
        ends = [points[[0, -1]].reshape(-1, 3) for points in (drone.faces_m, drone.discs_m)]
        window, drones = enclosing(whole, np.concatenate(ends), margin_px), [drone]
        if window is None:
            continue
        while (
            index := next((i for i, (other, _) in enumerate(found) if window.overlaps(other)), None)
        ) is not None:
            other, others = found.pop(index)
            window, drones = window.joined(other), others + drones
        found.append((window, drones))
    return found


def average(
    window: RasterView,
    posed: list[PosedDrone],
    samples: Float[np.ndarray, "passes 3"],
    behind_m: Float[np.ndarray, "rows columns"],
) -> Float[np.ndarray, "rows columns 4"]:
    """(rows, columns, 4): light of drones, and how much is seen of what is behind them, over all passes.

    Args:
        window: part of an image.
        posed: drones, their times those of the samples.
        samples: as `pass_samples` yields them.
        behind_m: depth of what is behind them, and may hide them.
    """
    total = np.zeros((*window.shape, 4), np.float32)
    for index, (x, y, _) in enumerate(samples):
        total += sample(replace(window, shift_px=(float(x), float(y))), posed, index, behind_m)
    return total / len(samples)


def sample(
    view: RasterView, posed: list[PosedDrone], index: int, behind_m: Float[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "rows columns 4"]:
    """(rows, columns, 4): light of drones at one time of their exposure, and how much of the rest is seen."""
    light, depth = np.full((*view.shape, 3), -1.0, np.float32), behind_m.copy()
    for drone in posed:
        draw(view, drone.faces_m[index], drone.light, light, depth)
    # Where nothing is drawn is told by the colour: OpenCV rounds even those depths that it leaves alone.
    clear = np.less(light[..., 0], 0).astype(np.float32)
    light += clear[..., None]
    seen = cv2.merge([light, clear])
    # Discs let light through: from the farthest to the nearest, each before what lies behind it.
    ahead = view.cam.R[2]
    with_discs = [drone for drone in posed if drone.discs_m.size]
    for drone in sorted(with_discs, key=lambda drone: -float(ahead @ drone.discs_m[index, 0, 0])):
        alone = len(posed) == 1
        inner = view if alone else enclosing(view, drone.discs_m[index].reshape(-1, 3), 1)
        if inner is None:
            continue
        part = inner.slices_in(view)
        disc, _ = empty_buffers(inner)
        draw(inner, drone.discs_m[index], drone.disc_opacity_light, disc, depth[part].copy())
        seen[part] *= (1 - disc[..., 0])[..., None]
        seen[part][..., :3] += (disc[..., 0] * disc[..., 1])[..., None]
    return seen
