"""Drones posed in the world and drawn in windows of a camera's image.

A drone is drawn in several passes with different sample positions in the pixel and different times in the exposure,
which gives anti-aliasing and motion blur together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.simulation.imaging.raster import RasterView, draw, empty_buffers, enclosing_window
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import disc_fans

NUM_PASSES = 8
#: Reflectance of unpainted parts.
_DARK_PLASTIC = 0.02
#: Opacity of a rotor disc, which shows blurred blades, at the hub and at the tip, and its reflectance.
_DISC_OPACITY = (0.55, 0.30)
_DISC_REFLECTANCE = 0.06

#: Factors that mirror a point in the floor.
MIRRORED = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class PosedDrone:
    """One drone during one exposure.

    Attributes:
        faces_m: (times, faces, 3, 3), corners of the faces, world.
        light: (faces, 1, 3), linear BGR light of the faces in the middle of the exposure.
        discs_m: (times, slices, 3, 3), rotor discs as fans of triangles with the hub as first corner, world.
        disc_opacity_light: (slices, 3, 3), opacity and light of the discs' corners in the first two channels.
    """

    faces_m: Float[np.ndarray, "times faces 3 3"]
    light: Float[np.ndarray, "faces 1 3"]
    discs_m: Float[np.ndarray, "times slices 3 3"]
    disc_opacity_light: Float[np.ndarray, "slices 3 3"]

    def mirrored(self, times: list[int]) -> PosedDrone:
        """Mirror image of the drone in the floor at the times with the given indices; the faces keep their light."""
        return replace(self, faces_m=self.faces_m[times] * MIRRORED, discs_m=self.discs_m[times] * MIRRORED)


def pass_samples(imaging: Imaging) -> Float[np.ndarray, "passes 3"]:
    """(passes, 3), position in the pixel (x, y) and time in the exposure (-1/2 to 1/2) of each pass's samples.

    The samples are Hammersley points of bases 2 and 3, shifted so that their mean is the pixel's centre and the middle
    of the exposure. Without anti-aliasing, all positions are the pixel's centre; without motion blur too, there is only
    one pass.
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
    """Pose a drone of a scene at given times of one exposure."""
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
        faces_m=_to_world(shape.triangles_m, rotation, position),
        light=light[:, None],
        discs_m=_to_world(discs, rotation, position),
        disc_opacity_light=np.broadcast_to(corner_values, discs.shape),
    )


def _to_world(
    triangles_m: Float[np.ndarray, "faces 3 3"],
    rotation: Float[np.ndarray, "times 3 3"],
    position_m: Float[np.ndarray, "times 3"],
) -> Float[np.ndarray, "times faces 3 3"]:
    """(times, faces, 3, 3), triangles transformed from the body frame to the world."""
    corners = triangles_m.reshape(-1, 3) @ rotation.swapaxes(-1, -2) + position_m[:, None]
    return corners.reshape(len(rotation), *triangles_m.shape)


def margin_px(blur_px: float) -> int:
    """Margin of a window around a drone, pixels, for motion and for a blur of the given standard deviation."""
    return 2 + int(np.ceil(4 * blur_px))


def windows(
    whole: RasterView, posed: list[PosedDrone], margin_px: int
) -> list[tuple[RasterView, list[PosedDrone]]]:
    """Parts of a window that contain drones, each with its drones; overlapping parts are merged."""
    found: list[tuple[RasterView, list[PosedDrone]]] = []
    for drone in posed:
        # With constant velocity, the positions at the ends of the exposure enclose all others.
        ends = [points[[0, -1]].reshape(-1, 3) for points in (drone.faces_m, drone.discs_m)]
        window, drones = enclosing_window(whole, np.concatenate(ends), margin_px), [drone]
        if window is None:
            continue
        while (
            index := next((i for i, (other, _) in enumerate(found) if window.overlaps(other)), None)
        ) is not None:
            other, others = found.pop(index)
            window, drones = window.union(other), others + drones
        found.append((window, drones))
    return found


def average(
    window: RasterView,
    posed: list[PosedDrone],
    samples: Float[np.ndarray, "passes 3"],
    behind_m: Float[np.ndarray, "rows columns"],
) -> Float[np.ndarray, "rows columns 4"]:
    """(rows, columns, 4), light of drones and visible share of the background, averaged over all passes.

    Args:
        window: part of an image.
        posed: drones, posed at the times of the samples.
        samples: (passes, 3), samples from `pass_samples`.
        behind_m: (rows, columns), depth of the background, which may hide drones.
    """
    total = np.zeros((*window.shape, 4), np.float32)
    for index, (x, y, _) in enumerate(samples):
        total += sample(replace(window, shift_px=(float(x), float(y))), posed, index, behind_m)
    return total / len(samples)


def sample(
    view: RasterView, posed: list[PosedDrone], index: int, behind_m: Float[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "rows columns 4"]:
    """(rows, columns, 4), light of drones and visible share of the background at one time of the exposure."""
    light, depth = np.full((*view.shape, 3), -1.0, np.float32), behind_m.copy()
    for drone in posed:
        draw(view, drone.faces_m[index], drone.light, light, depth)
    # Pixels without drones are found by colour, because OpenCV also rounds depths at pixels where it draws nothing.
    clear = np.less(light[..., 0], 0).astype(np.float32)
    light += clear[..., None]
    seen = cv2.merge([light, clear])
    # Discs are transparent, so they are drawn from the farthest to the nearest over what is behind them.
    ahead = view.cam.R[2]
    with_discs = [drone for drone in posed if drone.discs_m.size]
    for drone in sorted(with_discs, key=lambda drone: -float(ahead @ drone.discs_m[index, 0, 0])):
        alone = len(posed) == 1
        inner = view if alone else enclosing_window(view, drone.discs_m[index].reshape(-1, 3), 1)
        if inner is None:
            continue
        part = inner.slices_in(view)
        disc, _ = empty_buffers(inner)
        draw(inner, drone.discs_m[index], drone.disc_opacity_light, disc, depth[part].copy())
        seen[part] *= (1 - disc[..., 0])[..., None]
        seen[part][..., :3] += (disc[..., 0] * disc[..., 1])[..., None]
    return seen
