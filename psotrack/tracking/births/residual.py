"""Residual foreground: the blobs of the silhouettes that no known drone explains.

A known drone explains the foreground within its ellipse, which is slightly enlarged. Most frames are explained whole,
which the boxes of the blobs show: only a blob that reaches out of an ellipse is looked at cell by cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.foreground.silhouettes import Exposures, find_blobs
from psotrack.tracking.matching import Sightings, from_boxes

#: A known drone's ellipse is enlarged by this factor and by this number of cells, because outlines are no ellipses, and
#: rotors blur.
ELLIPSE_FACTOR, ELLIPSE_MARGIN_CELLS = 1.3, 1.5


@dataclass(frozen=True)
class FrameBlobs:
    """The blobs of some frames in all cameras, before known drones are taken into account.

    Attributes:
        coverage: (frames, cameras, height, width), the silhouettes, 0 to 255.
        low, high: (blobs, 2), corners of the blobs' boxes, cells.
        whole: (blobs,), whether the blob does not touch the image's border.
        frame, camera: (blobs,), the blob's frame and camera.
        reduction: image pixels per cell, along each side.
        exposures: when the frames were exposed; None where all cameras' frames were exposed together.
    """

    coverage: UInt8[np.ndarray, "frames cameras height width"]
    low: Float[np.ndarray, "blobs 2"]
    high: Float[np.ndarray, "blobs 2"]
    whole: Bool[np.ndarray, "blobs"]
    frame: Int[np.ndarray, "blobs"]
    camera: Int[np.ndarray, "blobs"]
    reduction: int
    exposures: Exposures | None = None

    @classmethod
    def of(
        cls,
        coverage: UInt8[np.ndarray, "frames cameras height width"],
        reduction: int,
        borders: Int[np.ndarray, "cameras 2"],
        exposures: Exposures | None = None,
    ) -> FrameBlobs:
        """Find the blobs of some frames.

        Args:
            coverage: (frames, cameras, height, width), the silhouettes, 0 to 255.
            reduction: image pixels per cell, along each side.
            borders: (cameras, 2), width and height of the images in cells.
            exposures: when the frames were exposed, in NumPy arrays.
        """
        there = np.ones(coverage.shape[:2], bool) if exposures is None else np.asarray(exposures.is_there)
        parts = [
            _boxes(coverage[frame, camera], borders[camera], np.zeros(2, int), frame, camera)
            for frame, camera in np.argwhere(there).tolist()
        ]
        low, high, whole, frame, camera = _joined(parts)
        return cls(coverage, low, high, whole, frame, camera, reduction, exposures)


def unexplained(blobs: FrameBlobs, box_px: Float[np.ndarray, "frames drones cameras 4"]) -> Sightings:
    """What no known drone explains.

    A blob that a known drone hides in part has a middle that is less certain, as that of a blob at the border.

    Args:
        blobs: the blobs of some frames.
        box_px: (frames, drones, cameras, 4), middle and half lengths of the known drones' boxes; NaN where there is
            none.
    """
    middle = box_px[..., :2] / blobs.reduction
    half = ELLIPSE_FACTOR * box_px[..., 2:] / blobs.reduction + ELLIPSE_MARGIN_CELLS
    # (blobs, drones): comparisons with NaN are false.
    low, high = (ends[blobs.frame, :, blobs.camera] for ends in (middle - half, middle + half))
    explained = ((blobs.low[:, None] >= low) & (blobs.high[:, None] <= high)).all(axis=-1).any(axis=-1)
    touched = np.asarray(((blobs.low[:, None] < high) & (blobs.high[:, None] > low)).all(axis=-1))
    free = ~explained & ~touched.any(axis=-1)
    columns = blobs.low, blobs.high, blobs.whole, blobs.frame, blobs.camera
    parts: list[_Boxes] = [tuple(column[free] for column in columns)]
    for blob in np.flatnonzero(~explained & touched.any(axis=-1)).tolist():
        at = int(blobs.frame[blob]), int(blobs.camera[blob])
        corner, end = blobs.low[blob].astype(int), blobs.high[blob].astype(int)
        cells = blobs.coverage[at][corner[1] : end[1], corner[0] : end[0]].copy()
        for drone in np.flatnonzero(touched[blob]).tolist():
            # OpenCV's coordinates begin at the middle of the first cell; with shift=4 they are sixteenths of cells.
            of = at[0], drone, at[1]
            x, y = np.rint(16 * (middle[of] - corner - 0.5)).astype(int).tolist()
            axes = np.rint(16 * half[of]).astype(int).tolist()
            cv2.ellipse(cells, (x, y), axes, 0, 0, 360, 0, cv2.FILLED, shift=4)
        first, last, whole, *number = _boxes(cells, end - corner, corner, *at)
        parts.append((first, last, np.zeros_like(whole), *number))
    first, last, whole, frame, camera = _joined(parts)
    size_px, centre_px = (last - first) * blobs.reduction, (first + last) / 2 * blobs.reduction - 0.5
    num_frames, num_cameras = blobs.coverage.shape[:2]
    image = num_cameras * frame + camera
    return from_boxes(image, centre_px, size_px, ~whole, num_frames, num_cameras, blobs.exposures)


#: Corners of blobs, cells; whether each is whole; their frames and cameras.
_Boxes = tuple[np.ndarray, ...]


def _boxes(
    cells: UInt8[np.ndarray, "height width"],
    border: Int[np.ndarray, "2"],
    corner: Int[np.ndarray, "2"],
    frame: int,
    camera: int,
) -> _Boxes:
    """The blobs of a part of a camera's image, whose first cell is `corner`."""
    found = find_blobs(cells, 1, border)
    middle = found.centre_px + 0.5 + corner
    half, count = found.size_px / 2, len(middle)
    return middle - half, middle + half, found.whole, np.full(count, frame), np.full(count, camera)


def _joined(parts: list[_Boxes]) -> _Boxes:
    none = np.empty((0, 2)), np.empty((0, 2)), np.empty(0, bool), np.empty(0, int), np.empty(0, int)
    return tuple(np.concatenate(columns) for columns in zip(none, *parts, strict=True))
