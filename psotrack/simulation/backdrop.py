"""What a camera sees of the empty room: colour and depth, drawn once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from psotrack.simulation.raster import Pinhole, draw, empty_buffers, full_view
from psotrack.simulation.rooms import Room, Surface

#: Samples per pixel along each side: edges and textures without stairs.
_MAGNIFICATION = 2
#: The lens's blur, in pixels.
LENS_SIGMA_PX = 0.5


@dataclass(frozen=True)
class Backdrop:
    """The empty room in one camera.

    Attributes:
        light: (height, width, 3), linear BGR.
        depth_m: (height, width), along the optical axis, at pixel centres.
        floor: (height, width), where the floor is seen.
    """

    light: Float[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]
    floor: Bool[np.ndarray, "height width"]


def render(room: Room, cam: Pinhole) -> Backdrop:
    """Draw the empty room into one camera."""
    fine = full_view(cam, _MAGNIFICATION)
    triangles, colours = _surfaces_as_triangles(room)
    surface_of, depth = empty_buffers(fine)
    draw(fine, triangles, colours, surface_of, depth)
    index = surface_of[..., 0].round().astype(np.int32) - 1
    light = np.zeros((*fine.shape, 3), np.float32)
    for number, surface in enumerate(room.surfaces):
        seen = np.equal(index, number).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(seen)
        if not width:
            continue
        H = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]]) @ fine.K @ texel_to_camera(surface, cam)
        window = cv2.warpPerspective(
            surface.texture, H, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.copyTo(window, seen[y : y + height, x : x + width], light[y : y + height, x : x + width])
    coarse = full_view(cam)
    surface_of, depth = empty_buffers(coarse)
    draw(coarse, triangles, colours, surface_of, depth)
    averaged = cv2.resize(light, (cam.width, cam.height), interpolation=cv2.INTER_AREA)
    return Backdrop(cv2.GaussianBlur(averaged, (0, 0), LENS_SIGMA_PX), depth, surface_of[..., 0].round() == 1)


def texel_to_camera(surface: Surface, cam: Pinhole) -> Float[np.ndarray, "3 3"]:
    """(3, 3), from a texel (column, row, 1) to camera coordinates of that point of the surface."""
    rows, columns = surface.texture.shape[:2]
    edges = [cam.R @ edge for edge in (surface.along_m, surface.down_m)]
    plane = np.column_stack([*edges, cam.R @ surface.corner_m + cam.t_m])
    return plane @ np.array([[1 / columns, 0, 0.5 / columns], [0, 1 / rows, 0.5 / rows], [0, 0, 1]])


def _surfaces_as_triangles(
    room: Room,
) -> tuple[Float[np.ndarray, "faces 3 3"], Float[np.ndarray, "faces 1 3"]]:
    """Two triangles per surface, coloured with the surface's number plus one."""
    corners = np.stack([surface.corners_m for surface in room.surfaces])
    triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    numbers = np.repeat(np.arange(1.0, len(corners) + 1), 2)
    return triangles, np.repeat(numbers[:, None, None], 3, axis=-1)
