"""Images of which most pixels are 0, as they go from process to process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8


@dataclass(frozen=True)
class PackedImage:
    """The pixels of an image, or of several, that are not 0.

    Attributes:
        shape: shape of the image.
        pixel: (pixels,), their numbers in the flat image.
        value: (pixels,), their values.
    """

    shape: tuple[int, ...]
    pixel: Int[np.ndarray, "pixels"]
    value: UInt8[np.ndarray, "pixels"]

    @staticmethod
    def of(image: UInt8[np.ndarray, "..."]) -> PackedImage:
        """Pack an image."""
        flat = image.ravel()
        pixel = np.flatnonzero(flat > 0)  # several times faster than of the values
        return PackedImage(image.shape, pixel.astype(np.int32), flat[pixel])

    def unpacked(self) -> UInt8[np.ndarray, "..."]:
        """The image."""
        image = np.zeros(self.shape, np.uint8)
        image.ravel()[self.pixel] = self.value
        return image
