"""Strips of an image that are drawn one by one, because a rolling shutter exposes each row at its own time.

A strip is drawn with the pose of the camera when its middle row is exposed. The strips of different samples of a pixel
begin at different rows, so that the mean time of the samples of every row is the time of the row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
    """Shows strips of a camera's image by views without distortion.

    Args:
        camera: intrinsics of the camera, at the origin.
    """

    def __init__(self, camera: Camera) -> None:
        self._lens: LensImage | None = lens_image(camera) if camera.dist.any() else None

    def show(
        self, strip: Strip, cam: Pinhole, draw: Callable[[RasterView], Shaped[np.ndarray, "..."]]
    ) -> Shaped[np.ndarray, "..."]:
        """The strip as a camera at the pose of `cam` sees it; `draw` gives the image of a view."""
        if self._lens is None:
            return draw(replace(full_view(cam), y=strip.first, height=strip.end - strip.first))
        face, at_px = self._lens.face[strip.rows], self._lens.at_px[strip.rows]
        images = []
        for index, one in enumerate(self._lens.faces):
            seen = face == index
            if not seen.any():
                continue
            x, y = np.maximum(np.floor(at_px[seen].min(axis=0)).astype(int) - _MARGIN_PX, 0).tolist()
            right, bottom = (np.ceil(at_px[seen].max(axis=0)).astype(int) + _MARGIN_PX + 1).tolist()
            whole = full_view(Pinhole(one.R @ cam.R, one.R @ cam.t_m, one.K, one.width, one.height))
            view = replace(
                whole, x=x, y=y, width=min(right, one.width) - x, height=min(bottom, one.height) - y
            )
            columns, rows = (np.ascontiguousarray(at_px[..., axis]) for axis in (0, 1))
            columns, rows = columns - np.float32(x), rows - np.float32(y)
            image = cv2.remap(draw(view), columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            images.append(np.where(seen.reshape(seen.shape + (1,) * (image.ndim - 2)), image, 0))
        return sum(images[1:], images[0])
