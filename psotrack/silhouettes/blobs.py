"""Blobs: connected foreground of silhouettes, in one image, and in all images of a few frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

#: A cell of the reduced silhouettes belongs to a blob when so much of it (of 255) is foreground.
MIN_COVERAGE = 64
#: A single cell is noise as often as not. How small a drone's image may be is for the silhouettes to say, which
#: are without smaller speckle.
MIN_BLOB_CELLS = 2
#: The middle of a blob is nowhere better known than to so many cells.
LEAST_RADIUS_CELLS = 1.5
#: Of an image with more blobs than this, the largest ones count.
MOST_BLOBS = 50


@dataclass(frozen=True)
class Blobs:
    """Connected foreground in one image.

    Attributes:
        centre_px: (blobs, 2), middles of the boxes, pixel centres at whole numbers.
        size_px: (blobs, 2), widths and heights of the boxes.
        whole: (blobs,), whether the blob is clear of the image's border.
    """

    centre_px: Float[np.ndarray, "blobs 2"]
    size_px: Float[np.ndarray, "blobs 2"]
    whole: Bool[np.ndarray, "blobs"]


@dataclass(frozen=True)
class ViewBlobs:
    """The blobs of all frames and cameras; the axis of blobs is as long as the fullest image needs.

    Attributes:
        centre_px, half_px: (frames, cameras, blobs, 2), middles of the boxes and half of their sides; NaN for none.
        whole: (frames, cameras, blobs), whether there is a blob, and clear of the image's border.
        least_radius_px: no middle is known better than to so much.
    """

    centre_px: Float[np.ndarray, "frames cameras blobs 2"]
    half_px: Float[np.ndarray, "frames cameras blobs 2"]
    whole: Bool[np.ndarray, "frames cameras blobs"]
    least_radius_px: float

    def __getitem__(self, frames: Bool[np.ndarray, "frames"]) -> ViewBlobs:
        """The blobs of some of the frames."""
        return replace(
            self, centre_px=self.centre_px[frames], half_px=self.half_px[frames], whole=self.whole[frames]
        )

    @property
    def radius_px(self) -> Float[np.ndarray, "frames cameras blobs"]:
        """Half of the smaller side: the middle of a drone's blob is nearer to its projection than that."""
        return np.maximum(self.half_px.min(axis=-1), self.least_radius_px)


def find_blobs(coverage: UInt8[np.ndarray, "height width"], reduction: int) -> Blobs:
    """Connected foreground of one silhouette, the largest first."""
    foreground = (coverage >= MIN_COVERAGE).astype(np.uint8)
    # Rotors and arms fall apart in thin silhouettes; a gap of one cell is none.
    closed = cv2.morphologyEx(foreground, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    stats = stats[1:][stats[1:, cv2.CC_STAT_AREA] >= MIN_BLOB_CELLS]
    stats = stats[np.argsort(-stats[:, 2] * stats[:, 3], kind="stable")[:MOST_BLOBS]]
    corner, size = stats[:, :2].astype(float), stats[:, 2:4].astype(float)
    height, width = coverage.shape
    whole = ((corner > 0) & (corner + size < (width, height))).all(axis=-1)
    return Blobs((corner + size / 2) * reduction - 0.5, size * reduction, whole)


def all_blobs(images: list[list[Blobs]], num_cameras: int, reduction: int) -> ViewBlobs:
    """Blobs of frames and cameras in arrays, with room for one blob at least."""
    most = max([1, *(len(blobs.whole) for frame in images for blobs in frame)])
    shape = (len(images), num_cameras, most)
    centre_px, half_px, whole = (
        np.full((*shape, 2), np.nan),
        np.full((*shape, 2), np.nan),
        np.zeros(shape, bool),
    )
    for frame, views in enumerate(images):
        for camera, blobs in enumerate(views):
            of = (frame, camera, slice(len(blobs.whole)))
            centre_px[of], half_px[of], whole[of] = blobs.centre_px, blobs.size_px / 2, blobs.whole
    return ViewBlobs(centre_px, half_px, whole, LEAST_RADIUS_CELLS * reduction)
