"""Reflections in the glossy floor, which mirrors a few per cent of the light.

The mirrored room is drawn once, and mirrored drones in every frame. A point at height z appears in the floor z = 0 as
if it were at -z. The mirrored room has its own depth buffer, so that mirrored furniture hides mirrored drones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.simulation.imaging import sensor
from psotrack.simulation.imaging.backdrop import Backdrop, lens_blur, numbers_and_depth, render_light
from psotrack.simulation.imaging.posing import MIRRORED, PosedDrone, average, margin_px, windows
from psotrack.simulation.imaging.raster import Pinhole, full_view
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.world.rooms import Room

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

    cam: Pinhole
    share: Float[np.ndarray, "height width"]
    light: Float[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]

    def on(self, empty: Backdrop) -> Backdrop:
        """Empty room with its mirror image in the floor."""
        share = self.share[..., None]
        return replace(empty, light=(1 - share) * empty.light + share * self.light)

    def share_of_rest(self, light: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """(height, width), share of each pixel's light that is not mirrored."""
        return 1 - self.share * self.light.sum(axis=-1) / np.maximum(light.sum(axis=-1), 1e-6)

    def reflect(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        posed: list[PosedDrone],
        samples: Float[np.ndarray, "passes 3"],
        lens_blur_px: float,
    ) -> None:
        """Add the mirror images of drones to an image of the room and its mirror image."""
        passes = [index for index in _PASSES if index < len(samples)]
        samples = samples[passes] - samples[passes].mean(axis=0)
        below = [drone.mirrored(passes) for drone in posed]
        widest_px = max((self._blur_px([drone], lens_blur_px) for drone in below), default=0.0)
        for window, drones in windows(full_view(self.cam), below, margin_px(widest_px)):
            share = self.share[window.slices][..., None]
            if not share.any():
                continue
            seen = average(window, drones, samples, self.depth_m[window.slices])
            seen = lens_blur(seen, self._blur_px(drones, lens_blur_px))
            part = image[window.slices]
            change = seen[..., :3] + (seen[..., 3:] - 1) * self.light[window.slices]
            part[...] = sensor.develop(sensor.undevelop(part) + share * change)

    def _blur_px(self, below: list[PosedDrone], lens_blur_px: float) -> float:
        """Standard deviation of the blur of mirrored drones, which grows with their distance behind the mirror."""
        depth_m = -float(np.mean([drone.faces_m[0, :, :, 2].mean() for drone in below]))
        eye_m = -float((self.cam.R.T @ self.cam.t_m)[2])
        roughness_px = ROUGHNESS_RAD * self.cam.K[0, 0] * depth_m / (depth_m + eye_m)
        return float(np.hypot(roughness_px, lens_blur_px))


def mirror(room: Room, cam: Pinhole, imaging: Imaging, empty: Backdrop) -> Mirror:
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
            corner_m=surface.corner_m * MIRRORED,
            along_m=surface.along_m * MIRRORED,
            down_m=surface.down_m * MIRRORED,
        )
        for surface in room.surfaces[1:]
    ]
    _, depth = numbers_and_depth(below, full_view(cam))
    light = render_light(below, cam, imaging.antialiasing)
    beyond = np.clip(1 - empty.depth_m / depth, 0, 1)
    floor = lens_blur(empty.floor.astype(np.float32), imaging.lens_blur_px)
    share = fresnel(_cosine_to_floor(cam), imaging.reflections) * floor
    return Mirror(cam, share, _blurred(light, beyond, ROUGHNESS_RAD * cam.K[0, 0], imaging), depth)


def fresnel(cosine: Float[np.ndarray, "*shape"], at_normal: float) -> Float[np.ndarray, "*shape"]:
    """Share of mirrored light by the cosine of the angle of incidence (Schlick, 1994); 1 at grazing incidence."""
    return at_normal + (1 - at_normal) * (1 - cosine) ** 5


def _cosine_to_floor(cam: Pinhole) -> Float[np.ndarray, "height width"]:
    """(height, width), cosine of the angle between the line of sight and the floor's normal; 0 above the horizon."""
    to_world = (cam.R.T @ np.linalg.inv(cam.K)).astype(np.float32)
    x, y = np.arange(cam.width, dtype=np.float32), np.arange(cam.height, dtype=np.float32)[:, None]
    rays = [row[0] * x + row[1] * y + row[2] for row in to_world]
    return np.clip(-rays[2] / np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2), 0, 1)


def _blurred(
    light: Float[np.ndarray, "height width 3"],
    beyond: Float[np.ndarray, "height width"],
    sigma_px: float,
    imaging: Imaging,
) -> Float[np.ndarray, "height width 3"]:
    """Blurred light of the mirrored room; the blur is 0 at the floor and grows with the distance behind the mirror."""
    mixed = np.zeros_like(light)
    for step in range(_BLURS):
        blur_px = np.hypot(sigma_px * step / (_BLURS - 1), imaging.lens_blur_px)
        weight = np.clip(1 - np.abs(beyond * (_BLURS - 1) - step), 0, None)
        mixed += weight[..., None] * lens_blur(light, float(blur_px))
    return mixed
