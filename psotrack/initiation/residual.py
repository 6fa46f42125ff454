"""Residual foreground: the blobs of the silhouettes that no known drone explains.

A known drone explains the foreground within its ellipse, which is slightly enlarged. Most frames are explained whole,
which the boxes of the blobs show: only a blob that reaches out of an ellipse is looked at cell by cell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.correspondence import Sightings, from_boxes
from psotrack.silhouettes import Exposures, find_blobs

#: A known drone's ellipse is enlarged by this factor and by this number of cells, because outlines are no ellipses, and
#: rotors blur.
ELLIPSE_FACTOR, ELLIPSE_MARGIN_CELLS = 1.3, 1.5


@dataclass(frozen=True)
class FrameBlobs:
    """The blobs of one frame in all cameras, before known drones are taken into account.

    Attributes:
        coverage: (cameras, height, width), the silhouettes, 0 to 255.
        low, high: (blobs, 2), corners of the blobs' boxes, cells.
        whole: (blobs,), whether the blob does not touch the image's border.
        camera: (blobs,), the blob's camera.
        reduction: image pixels per cell, along each side.
        exposures: when the frames were exposed; None where all were exposed together.
    """

    coverage: UInt8[np.ndarray, "cameras height width"]
    low: Float[np.ndarray, "blobs 2"]
    high: Float[np.ndarray, "blobs 2"]
    whole: Bool[np.ndarray, "blobs"]
    camera: Int[np.ndarray, "blobs"]
    reduction: int
    exposures: Exposures | None = None

    @classmethod
    def of(
        cls,
        coverage: UInt8[np.ndarray, "cameras height width"],
        reduction: int,
        borders: Int[np.ndarray, "cameras 2"],
        exposures: Exposures | None = None,
    ) -> FrameBlobs:
        """Find the blobs of a frame.

        Args:
            coverage: (cameras, height, width), the silhouettes, 0 to 255.
            reduction: image pixels per cell, along each side.
            borders: (cameras, 2), width and height of the images in cells.
            exposures: when the frames were exposed, in NumPy arrays.
        """
        there = np.ones(len(coverage), bool) if exposures is None else np.asarray(exposures.is_there)
        parts = [
            _boxes(coverage[camera], borders[camera], np.zeros(2, int), camera)
            for camera in np.flatnonzero(there).tolist()
        ]
        low, high, whole, camera = _joined(parts)
        return cls(coverage, low, high, whole, camera, reduction, exposures)


def unexplained(blobs: FrameBlobs, box_px: Float[np.ndarray, "drones cameras 4"]) -> Sightings:
    """What no known drone explains in a frame.

    A blob that a known drone hides in part has a middle that is less certain, as that of a blob at the border.

    Args:
        blobs: the blobs of the frame.
        box_px: (drones, cameras, 4), middle and half lengths of the known drones' boxes; NaN where there is none.
    """
    middle = box_px[..., :2] / blobs.reduction
    half = ELLIPSE_FACTOR * box_px[..., 2:] / blobs.reduction + ELLIPSE_MARGIN_CELLS
    # (drones, blobs): comparisons with NaN are false.
    low, high = (middle - half)[:, blobs.camera], (middle + half)[:, blobs.camera]
    explained = ((blobs.low >= low) & (blobs.high <= high)).all(axis=-1).any(axis=0)
    touched = np.asarray(((blobs.low < high) & (blobs.high > low)).all(axis=-1))
    free = ~explained & ~touched.any(axis=0)
    parts = [(blobs.low[free], blobs.high[free], blobs.whole[free], blobs.camera[free])]
    for blob in np.flatnonzero(~explained & touched.any(axis=0)).tolist():
        camera, drones = int(blobs.camera[blob]), touched[:, blob]
        corner, end = blobs.low[blob].astype(int), blobs.high[blob].astype(int)
        cells = blobs.coverage[camera, corner[1] : end[1], corner[0] : end[0]].copy()
        for at, axes in zip(middle[drones, camera] - corner, half[drones, camera], strict=True):
            # OpenCV's coordinates begin at the middle of the first cell; with shift=4 they are sixteenths of cells.
            x, y = np.rint(16 * (at - 0.5)).astype(int).tolist()
            cv2.ellipse(
                cells, (x, y), np.rint(16 * axes).astype(int).tolist(), 0, 0, 360, 0, cv2.FILLED, shift=4
            )
        first, last, whole, of = _boxes(cells, end - corner, corner, camera)
        parts.append((first, last, np.zeros_like(whole), of))
    first, last, whole, of = _joined(parts)
    size_px, centre_px = (last - first) * blobs.reduction, (first + last) / 2 * blobs.reduction - 0.5
    found = from_boxes(of, centre_px, size_px, ~whole, num_images=len(blobs.coverage))
    return replace(found, exposures=blobs.exposures)


#: Corners of blobs, cells; whether each is whole; their cameras.
_Boxes = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _boxes(
    cells: UInt8[np.ndarray, "height width"],
    border: Int[np.ndarray, "2"],
    corner: Int[np.ndarray, "2"],
    camera: int,
) -> _Boxes:
    """The blobs of a part of a camera's image, whose first cell is `corner`."""
    found = find_blobs(cells, 1, border)
    middle = found.centre_px + 0.5 + corner
    half = found.size_px / 2
    return middle - half, middle + half, found.whole, np.full(len(middle), camera)


def _joined(parts: list[_Boxes]) -> _Boxes:
    none = np.empty((0, 2)), np.empty((0, 2)), np.empty(0, bool), np.empty(0, int)
    low, high, whole, camera = (np.concatenate(columns) for columns in zip(none, *parts, strict=True))
    return low, high, whole, camera
