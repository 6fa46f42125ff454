"""Strips of an image that are drawn one by one, because a rolling shutter exposes each row at its own time.

A strip is drawn with the pose of the camera when its middle row is exposed. The strips of different samples of a pixel
begin at different rows, so that the mean time of the samples of every row is the time of the row.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Shaped

from psotrack.geometry import Camera
from psotrack.simulation.imaging.lens_image import LensImage, lens_image
from psotrack.simulation.imaging.raster import Pinhole, RasterView, full_view

#: Largest motion of the image, pixels, between the first and the last row of a strip, and smallest number of rows.
_STRIP_PX, _MIN_ROWS = 0.5, 4
#: Pixels around the part of a face that a strip shows, which the interpolation needs.
_MARGIN_PX = 3


@dataclass(frozen=True)
class Strip:
    """Neighbouring rows of an image.

    Attributes:
        first, end: first row, and the row after the last row.
        middle: row whose time of exposure is that of the strip; outside of the image for an incomplete strip.
    """

    first: int
    end: int
    middle: float

    @property
    def rows(self) -> slice:
        """The rows of the image."""
        return slice(self.first, self.end)


def strips(height: int, motion_px: float, sample: int, num_samples: int) -> Iterator[Strip]:
    """Divide the rows of an image into strips.

    Args:
        height: number of rows.
        motion_px: motion of the image between the exposures of two neighbouring rows, pixels; 0 gives a single strip.
        sample: number of the sample of a pixel.
        num_samples: number of samples of a pixel.
    """
    if motion_px * height <= _STRIP_PX:
        yield Strip(0, height, (height - 1) / 2)
        return
    rows = max(int(_STRIP_PX / motion_px), _MIN_ROWS)
    start = -((rows * (2 * sample + 1)) // (2 * num_samples))
    for first in range(start, height, rows):
        if first + rows > 0:
            yield Strip(max(first, 0), min(first + rows, height), first + (rows - 1) / 2)


class LensStrips:
    """The views without distortion that show the strips of a camera's image.

    Args:
        camera: intrinsics of the camera, at the origin.
    """

    def __init__(self, camera: Camera) -> None:
        width, height = (int(side) for side in camera.image_size_wh)
        self._lens: LensImage | None = lens_image(camera) if camera.dist.any() else None
        whole = Pinhole(np.eye(3), np.zeros(3), np.asarray(camera.K), width, height)
        self._faces = (whole,) if self._lens is None else self._lens.faces

    def views(self, strip: Strip, cam: Pinhole) -> list[tuple[int, RasterView]]:
        """Numbers and windows of the faces that show a strip, for a camera whose pose is that of `cam`."""
        if self._lens is None:
            return [(0, replace(full_view(cam), y=strip.first, height=strip.end - strip.first))]
        found = []
        for index, face in enumerate(self._faces):
            at_px = self._lens.at_px[strip.rows][self._lens.face[strip.rows] == index]
            if not len(at_px):
                continue
            x, y = np.maximum(np.floor(at_px.min(axis=0)).astype(int) - _MARGIN_PX, 0).tolist()
            right, bottom = np.ceil(at_px.max(axis=0)).astype(int) + _MARGIN_PX + 1
            window = replace(
                full_view(Pinhole(face.R @ cam.R, face.R @ cam.t_m, face.K, face.width, face.height)),
                x=x,
                y=y,
                width=min(int(right), face.width) - x,
                height=min(int(bottom), face.height) - y,
            )
            found.append((index, window))
        return found

    def assemble(
        self, strip: Strip, images: list[tuple[int, RasterView, Shaped[np.ndarray, "..."]]]
    ) -> Shaped[np.ndarray, "..."]:
        """The strip from images of its views."""
        if self._lens is None:
            return images[0][2]
        first = images[0][2]
        face = self._lens.face[strip.rows]
        whole = np.zeros((*face.shape, *first.shape[2:]), first.dtype)
        for index, view, image in images:
            x, y = np.ascontiguousarray(np.moveaxis(self._lens.at_px[strip.rows], -1, 0))
            offset = np.float32(view.x), np.float32(view.y)
            shown = cv2.remap(
                image, x - offset[0], y - offset[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            )
            whole[face == index] = shown[face == index]
        return whole
