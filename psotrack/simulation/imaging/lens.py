"""Images of a lens with distortion, bent from the images of a pinhole camera that sees a little more."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import SettingsError
from psotrack.geometry import Camera, make_camera, undistort

#: Pixels that the pinhole image is wider than needed, for the interpolation at the border.
_MARGIN_PX = 4


@dataclass(frozen=True)
class LensWarp:
    """A pinhole camera, and where each pixel of the lens lies in its image.

    Attributes:
        pinhole: camera at the same place, without distortion, that sees everything that the lens sees.
        x, y: (height, width), place of each pixel of the lens in the pinhole camera's image, pixels.
    """

    pinhole: Camera
    x: Float[np.ndarray, "height width"]
    y: Float[np.ndarray, "height width"]

    def bend(
        self, image: UInt8[np.ndarray, "wide_height wide_width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The lens's image, from the pinhole camera's."""
        return np.asarray(cv2.remap(image, self.x, self.y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def lens_warp(lens: Camera) -> LensWarp:
    """The pinhole camera for a lens.

    Raises:
        SettingsError: the lens cannot be inverted somewhere in its image.
    """
    width, height = (int(side) for side in lens.image_size_wh)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    rays = undistort(lens, pixels)
    if not np.isfinite(rays).all():
        raise SettingsError("lens", expected="a lens that can be inverted in its whole image", found="a fold")
    K = np.array(lens.K)
    seen = rays @ K[:2, :2].T + K[:2, 2]
    first = np.floor(seen.min(axis=(0, 1))) - _MARGIN_PX
    K[:2, 2] -= first
    # Even numbers, as for all images of the simulation.
    size = 2 * np.ceil((seen.max(axis=(0, 1)) - first + 1 + _MARGIN_PX) / 2)
    T = np.asarray(lens.T_cam_world)
    pinhole = make_camera(R=T[:3, :3], t_m=T[:3, 3], K=K, image_size_wh=(int(size[0]), int(size[1])))
    x, y = np.moveaxis((seen - first).astype(np.float32), -1, 0)
    return LensWarp(pinhole, np.ascontiguousarray(x), np.ascontiguousarray(y))
