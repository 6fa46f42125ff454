"""The empty room in a camera's image: colour and depth, drawn once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.simulation.imaging.raster import Pinhole, RasterView, draw, empty_buffers, full_view
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.world.rooms import Room, Surface

#: Samples per pixel along each side, for anti-aliasing.
_MAGNIFICATION = 2


@dataclass(frozen=True)
class Backdrop:
    """The empty room in one camera's image.

    Attributes:
        light: (height, width, 3), linear BGR light.
        depth_m: (height, width), depth along the optical axis at pixel centres.
        floor: (height, width), True at the pixels that show the floor.
    """

    light: Float[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]
    floor: Bool[np.ndarray, "height width"]


def render(room: Room, cam: Pinhole, imaging: Imaging) -> Backdrop:
    """Draw the empty room for one camera."""
    number, depth = numbers_and_depth(room.surfaces, full_view(cam))
    light = lens_blur(render_light(room.surfaces, cam, imaging.antialiasing), imaging.lens_blur_px)
    return Backdrop(light, depth, np.equal(number, 0))


def render_light(
    surfaces: Sequence[Surface], cam: Pinhole, antialiasing: bool
) -> Float[np.ndarray, "height width 3"]:
    """(height, width, 3), linear BGR light of textured surfaces, without the lens's blur."""
    view = full_view(cam, _MAGNIFICATION if antialiasing else 1)
    number, _ = numbers_and_depth(surfaces, view)
    light = np.zeros((*view.shape, 3), np.float32)
    for index, surface in enumerate(surfaces):
        seen = np.equal(number, index).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(seen)
        if not width:
            continue
        H = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]]) @ view.K @ texel_to_camera(surface, cam)
        window = cv2.warpPerspective(
            surface.texture, H, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.copyTo(window, seen[y : y + height, x : x + width], light[y : y + height, x : x + width])
    return cv2.resize(light, (cam.width, cam.height), interpolation=cv2.INTER_AREA)


def numbers_and_depth(
    surfaces: Sequence[Surface], view: RasterView
) -> tuple[Int[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Index of the visible surface at each pixel, -1 without a surface, and its depth along the optical axis."""
    corners = np.stack([surface.corners_m for surface in surfaces])
    triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    colours = np.repeat(np.arange(1.0, len(corners) + 1), 2)[:, None, None]
    buffer, depth = empty_buffers(view)
    draw(view, triangles, np.repeat(colours, 3, axis=-1), buffer, depth)
    return buffer[..., 0].round().astype(np.int32) - 1, depth


def lens_blur(light: Float[np.ndarray, "*shape"], sigma_px: float) -> Float[np.ndarray, "*shape"]:
    """Light after a Gaussian blur of the lens; unchanged if `sigma_px` is 0."""
    return cv2.GaussianBlur(light, (0, 0), sigma_px) if sigma_px > 0 else light


def texel_to_camera(surface: Surface, cam: Pinhole) -> Float[np.ndarray, "3 3"]:
    """(3, 3), matrix from a texel (column, row, 1) to the camera coordinates of the texel's point on the surface."""
    rows, columns = surface.texture.shape[:2]
    edges = [cam.R @ edge for edge in (surface.along_m, surface.down_m)]
    plane = np.column_stack([*edges, cam.R @ surface.corner_m + cam.t_m])
    return plane @ np.array([[1 / columns, 0, 0.5 / columns], [0, 1 / rows, 0.5 / rows], [0, 0, 1]])
