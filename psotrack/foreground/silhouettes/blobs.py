"""Blobs: connected regions of foreground, in one silhouette, and in the silhouettes of several frames."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.foreground.silhouettes.settings import MIN_COVERAGE
from psotrack.support.array_types import Array

#: Neighbours of a cell that close a gap.
_CLOSING = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Blobs:
    """Blobs of one image.

    Attributes:
        centre_px: (blobs, 2), middles of the boxes, pixel centres at whole numbers.
        size_px: (blobs, 2), widths and heights of the boxes.
        whole: (blobs,), whether the blob does not touch the image's border.
    """

    centre_px: Float[np.ndarray, "blobs 2"]
    size_px: Float[np.ndarray, "blobs 2"]
    whole: Bool[np.ndarray, "blobs"]


def border_cells(image_size_wh: Float[Array, "*cameras 2"], reduction: int) -> Int[np.ndarray, "*cameras 2"]:
    """Width and height of silhouettes in cells, which are smaller than the array where other cameras have more pixels.

    Args:
        image_size_wh: (..., 2), width and height of the images, pixels.
        reduction: image pixels per cell, along each side.
    """
    return np.ceil(np.asarray(image_size_wh) / reduction).astype(int)


def find_blobs(
    coverage: UInt8[np.ndarray, "height width"],
    reduction: int,
    border: Int[np.ndarray, "2"] | None = None,
) -> Blobs:
    """Find the blobs of one silhouette, sorted from large to small boxes; of equal boxes the upper one is first.

    A single cell is no blob, because it is often noise. The silhouettes have a limit of their own, `min_blob_px`.

    Args:
        coverage: (height, width), the silhouette, 0 to 255.
        reduction: image pixels per cell, along each side.
        border: width and height of the image in cells, from `border_cells`; None where the array ends at its border.
    """
    foreground = (coverage >= MIN_COVERAGE).view(np.uint8)
    # In thin silhouettes, gaps of one cell separate rotors and arms from the body.
    closed = cv2.morphologyEx(foreground, cv2.MORPH_CLOSE, _CLOSING)
    # Outlines instead of labels, because most of a silhouette is empty: labels would be written to every cell of it.
    outlines, levels = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    # OpenCV lists the outlines from below, and those of holes with the number of the blob around them.
    boxes = [
        cv2.boundingRect(outline)
        for outline, (*_, around) in zip(outlines, [] if levels is None else levels[0].tolist(), strict=True)
        if around < 0
    ]
    corner, size = np.array(boxes[::-1], float).reshape(-1, 2, 2).swapaxes(0, 1)
    area = size.prod(axis=-1)
    order = np.argsort(-area, kind="stable")[: np.count_nonzero(area > 1)]
    corner, size = corner[order], size[order]
    end = coverage.shape[::-1] if border is None else border
    whole = ((corner > 0) & (corner + size < end)).all(axis=-1)
    return Blobs((corner + size / 2) * reduction - 0.5, size * reduction, whole)
