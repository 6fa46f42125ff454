"""Drones on the floor: mirror images in its gloss, and their shadows.

The glossy floor mirrors a few per cent of the light. The mirrored room is drawn once, and mirrored drones in every
frame. A point at height z appears in the floor z = 0 as if it were at -z. The mirrored room has its own depth buffer,
so that mirrored furniture hides mirrored drones.

The lamps have the same height and the floor is flat, so a drone's shadow has the same shape under each lamp: the
drone's outline from above, magnified, blurred by the panel's size, and shifted. The shadows are drawn on a map of the
floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.simulation.imaging import raster, sensor
from psotrack.simulation.imaging.backdrop import Backdrop, lens_blur, numbers_and_depth, render_light
from psotrack.simulation.imaging.sensor import GAMMA, Image, Light
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import DroneModel, disc_fans
from psotrack.simulation.world.rooms import AMBIENT, Point, Room

_Pixels = Float[np.ndarray, "height width"]
_Outline = Float[np.ndarray, "side side"]
_Cells = Float[np.ndarray, "rows columns"]
#: Standard deviation of the direction of mirrored light.
ROUGHNESS_RAD = 0.006
#: Indices of the passes in which mirror images are drawn. Four of eight passes are enough, because mirror images are
#: blurred; the mean of these four is the middle of the exposure.
_PASSES = (0, 3, 4, 7)
#: Number of blurred images of the mirrored room, from no blur to the blur of distant objects.
_BLURS = 4


@dataclass(frozen=True)
class Mirror:
    """Mirror image of the empty room in the floor, in one camera's image.

    Attributes:
        cam: the camera.
        share: (height, width), share of light that the floor mirrors; 0 at pixels without floor.
        light: (height, width, 3), linear BGR light of the mirrored room.
        depth_m: (height, width), depth of the mirrored room along the optical axis.
    """

    cam: raster.Pinhole
    share: _Pixels
    light: Light
    depth_m: _Pixels

    def on(self, empty: Backdrop) -> Backdrop:
        """Empty room with its mirror image in the floor."""
        share = self.share[..., None]
        return replace(empty, light=(1 - share) * empty.light + share * self.light)

    def reflect(
        self, image: Image, posed: list[raster.PosedDrone], samples: raster.Samples, lens_blur_px: float
    ) -> None:
        """Add the mirror images of drones to an image of the room and its mirror image."""
        passes = [index for index in _PASSES if index < len(samples)]
        samples = samples[passes] - samples[passes].mean(axis=0)
        below = [drone.mirrored(passes) for drone in posed]
        widest_px = max((self._blur_px([drone], lens_blur_px) for drone in below), default=0.0)
        for window, drones in raster.windows(raster.full_view(self.cam), below, raster.margin_px(widest_px)):
            share = self.share[window.slices][..., None]
            if not share.any():
                continue
            seen = raster.average(window, drones, samples, self.depth_m[window.slices])
            seen = lens_blur(seen, self._blur_px(drones, lens_blur_px))
            part = image[window.slices]
            change = seen[..., :3] + (seen[..., 3:] - 1) * self.light[window.slices]
            part[...] = sensor.develop(sensor.undevelop(part) + share * change)

    def _blur_px(self, below: list[raster.PosedDrone], lens_blur_px: float) -> float:
        """Standard deviation of the blur of mirrored drones, which grows with their distance behind the mirror."""
        depth_m = -float(np.mean([drone.faces_m[0, :, :, 2].mean() for drone in below]))
        eye_m = -float((self.cam.R.T @ self.cam.t_m)[2])
        roughness_px = ROUGHNESS_RAD * self.cam.K[0, 0] * depth_m / (depth_m + eye_m)
        return float(np.hypot(roughness_px, lens_blur_px))


def mirror(room: Room, cam: raster.Pinhole, imaging: Imaging, empty: Backdrop) -> Mirror:
    """Mirror image of a room in its floor, in one camera's image.

    Args:
        room: the room; its first surface is the floor.
        cam: the camera, above the floor.
        imaging: effects of camera and light; `reflections` is the mirrored share at normal incidence.
        empty: the room without reflections in this camera's image.
    """
    below = [
        replace(
            surface,
            corner_m=surface.corner_m * raster.MIRRORED,
            along_m=surface.along_m * raster.MIRRORED,
            down_m=surface.down_m * raster.MIRRORED,
        )
        for surface in room.surfaces[1:]
    ]
    _, depth = numbers_and_depth(below, raster.full_view(cam))
    light = render_light(below, cam, imaging.antialiasing)
    beyond = np.clip(1 - empty.depth_m / depth, 0, 1)
    floor = lens_blur(empty.floor.astype(np.float32), imaging.lens_blur_px)
    # By the cosine of the angle of incidence (Schlick, 1994); 1 at grazing incidence.
    share = (imaging.reflections + (1 - imaging.reflections) * (1 - _cosine_to_floor(cam)) ** 5) * floor
    return Mirror(cam, share, _blurred(light, beyond, ROUGHNESS_RAD * cam.K[0, 0], imaging), depth)


def _cosine_to_floor(cam: raster.Pinhole) -> _Pixels:
    """(height, width), cosine of the angle between the line of sight and the floor's normal; 0 above the horizon."""
    to_world = (cam.R.T @ np.linalg.inv(cam.K)).astype(np.float32)
    x, y = np.arange(cam.width, dtype=np.float32), np.arange(cam.height, dtype=np.float32)[:, None]
    rays = [row[0] * x + row[1] * y + row[2] for row in to_world]
    return np.clip(-rays[2] / np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2), 0, 1)


def _blurred(light: Light, beyond: _Pixels, sigma_px: float, imaging: Imaging) -> Light:
    """Blurred light of the mirrored room; the blur is 0 at the floor and grows with the distance behind the mirror."""
    mixed = np.zeros_like(light)
    for step in range(_BLURS):
        blur_px = np.hypot(sigma_px * step / (_BLURS - 1), imaging.lens_blur_px)
        weight = np.clip(1 - np.abs(beyond * (_BLURS - 1) - step), 0, None)
        mixed += weight[..., None] * lens_blur(light, float(blur_px))
    return mixed


#: Size of a cell of the floor's map, and of a cell of a drone's outline.
_CELL_M, _FINE_M = 0.02, 0.01
#: Share of light that a rotor disc blocks.
_DISC_SHARE = 0.25

#: Factor of a pixel's grey levels, in 1/255, by the share of lost light, in 1/255.
_DARKER = (255 * (1 - np.arange(256) / 255) ** (1 / GAMMA)).round().astype(np.uint8)

_UP = np.array([[0.0, 0.0, 1.0]])


class FloorLight:
    """Map of the share of light that still reaches the floor of a scene under the drones."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._outlines = [_outline(shape) for shape in scene.models]
        ground = scene.room.surfaces[0]
        self._corner_m = ground.corner_m
        extent = [float(np.linalg.norm(ground.along_m)), float(np.linalg.norm(ground.down_m))]
        self._shape = (round(extent[1] / _CELL_M), round(extent[0] / _CELL_M))
        along, down = ground.along_m / self._shape[1], ground.down_m / self._shape[0]
        # Matrix from a cell (column, row, 1) to its point on the floor z = 0.
        self._cell_to_world = np.column_stack([along, down, ground.corner_m + 0.5 * (along + down)])

    def to_image(self, cam: raster.Pinhole) -> Float[np.ndarray, "3 3"]:
        """(3, 3), matrix from a cell (column, row, 1) to its pixel."""
        return cam.K @ (cam.R @ self._cell_to_world + np.outer(cam.t_m, [0, 0, 1]))

    def floor_gain(self, time_s: float) -> _Cells:
        """(rows, columns), share of light that reaches each cell of the floor at a time."""
        gain = np.ones(self._shape, np.float32)
        time = np.array([time_s])
        for flight, outline in zip(self._scene.flights, self._outlines, strict=True):
            self._cast(gain, outline, flight.position_m(time)[0], flight.rotation(time)[0, :2, :2])
        return gain

    def _cast(self, gain: _Cells, outline: _Outline, position: Point, turn: Float[np.ndarray, "2 2"]) -> None:
        panels = self._scene.room.panels
        lamp_height = float(panels.centres_m[0, 2])
        magnified = lamp_height / (lamp_height - position[2])
        # The edge of a shadow from a panel of length s is s (m - 1) wide; the standard deviation of a uniform
        # distribution is its width divided by sqrt(12).
        sigmas_m = [max(side * (magnified - 1) / np.sqrt(12), _CELL_M / 2) for side in panels.size_m]
        patch = _turn_outline(outline, turn, magnified, 3 * max(sigmas_m))
        patch = cv2.GaussianBlur(patch, (0, 0), sigmas_m[0] / _CELL_M, sigmaY=sigmas_m[1] / _CELL_M)
        falls = panels.centres_m + (position - panels.centres_m) * magnified
        ups = np.broadcast_to(_UP, falls.shape)
        # (lamps, shadows), light of each lamp at the centre of each lamp's shadow.
        direct = np.stack([panels.direct(falls, ups, lamp) for lamp in panels.centres_m])
        for fall, weight in zip(falls, direct.diagonal() / (direct.sum(axis=0) + AMBIENT), strict=True):
            self._stamp(gain, float(weight) * patch, fall)

    def _stamp(self, gain: _Cells, patch: _Outline, at_m: Point) -> None:
        """Remove the share of light that a patch gives, centred at a point of the floor."""
        centre = np.array([at_m[0] - self._corner_m[0], self._corner_m[1] - at_m[1]]) / _CELL_M - 0.5
        half = len(patch) // 2 + 1
        first = np.floor(centre).astype(int) - half
        # Transformation from the patch's cells to the floor's cells, which moves the patch's middle to `centre`.
        offset = centre - first - len(patch) // 2
        side = 2 * half + 2
        A = np.array([[1, 0, offset[0]], [0, 1, offset[1]]])
        moved = cv2.warpAffine(patch.astype(np.float32), A, (side, side))
        low, high = np.maximum(first, 0), np.minimum(first + side, gain.shape[::-1])
        if np.all(high > low):
            (x1, y1), (x2, y2) = low - first, high - first
            gain[low[1] : high[1], low[0] : high[0]] *= 1 - moved[y1:y2, x1:x2]


class FloorShadows(FloorLight):
    """Casts the drones' shadows on the floor of one camera's image."""

    def __init__(self, scene: Scene, cam: raster.Pinhole, backdrop: Backdrop, mirror: Mirror | None) -> None:
        super().__init__(scene)
        x, y, width, height = cv2.boundingRect(backdrop.floor.astype(np.uint8))
        self._window = (slice(y, y + height), slice(x, x + width))
        self._H = raster.from_corner(x, y) @ self.to_image(cam)
        matt = backdrop.floor
        if mirror is not None:
            # Drones above the floor do not block the light that the floor mirrors towards the camera.
            mirrored = mirror.share * mirror.light.sum(axis=-1)
            matt = matt * (1 - mirrored / np.maximum(backdrop.light.sum(axis=-1), 1e-6))
        self._matt = (255 * matt[self._window]).round().astype(np.uint8)

    def cast(self, image: Image, time_s: float) -> None:
        """Darken the floor in an image by the shadows at a time."""
        part = image[self._window]
        if not part.size or not self._scene.scenario.imaging.shadows:
            return
        on_floor = cv2.convertScaleAbs(self.floor_gain(time_s), alpha=-255, beta=255)
        seen = cv2.warpPerspective(on_floor, self._H, part.shape[1::-1], flags=cv2.INTER_LINEAR)
        lost = cv2.multiply(seen, self._matt, scale=1 / 255)
        x, y, width, height = cv2.boundingRect(lost)
        if width:
            part = part[y : y + height, x : x + width]
            darker = cv2.LUT(lost[y : y + height, x : x + width], _DARKER)
            cv2.multiply(part, cv2.merge([darker, darker, darker]), dst=part, scale=1 / 255)


def _outline(shape: DroneModel) -> _Outline:
    """(side, side), share of light that a drone blocks, seen from above, in cells of `_FINE_M`; x right, y up."""
    half = int(np.ceil(shape.radius_m / _FINE_M)) + 1
    outline = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for triangles, share in ((disc_fans(shape), _DISC_SHARE), (shape.triangles_m, 1.0)):
        corners = np.round(triangles[..., :2] * [1, -1] / _FINE_M + half).astype(np.int32)
        for triangle in corners:
            cv2.fillConvexPoly(outline, triangle, share)
    return outline


def _turn_outline(
    outline: _Outline, turn: Float[np.ndarray, "2 2"], magnified: float, margin_m: float
) -> Float[np.ndarray, "cells cells"]:
    """(cells, cells), outline turned, magnified and resampled to the floor's cells, centred."""
    half = int((len(outline) * _FINE_M * magnified / 2 + margin_m) / _CELL_M) + 2
    # Rows increase downwards and y upwards, so a rotation in the plane is the transposed rotation in the image.
    A = magnified * _FINE_M / _CELL_M * np.array([[turn[0, 0], -turn[0, 1]], [-turn[1, 0], turn[1, 1]]])
    offset = half - A @ np.full(2, len(outline) // 2)
    small = cv2.GaussianBlur(outline, (0, 0), _CELL_M / _FINE_M / 2 / magnified)
    return cv2.warpAffine(small, np.column_stack([A, offset]), (2 * half + 1, 2 * half + 1))
