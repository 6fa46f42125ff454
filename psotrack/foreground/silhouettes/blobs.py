"""Blobs: connected regions of foreground, in one silhouette, and in the silhouettes of several frames."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.foreground.silhouettes.frames import Silhouettes
from psotrack.foreground.silhouettes.settings import MIN_COVERAGE
from psotrack.recordings import Detections
from psotrack.support import Report, no_progress
from psotrack.support.array_types import Array

#: Neighbours of a cell that close a gap.
_CLOSING = np.ones((3, 3), np.uint8)
#: Cells beside the foreground on which the closing there depends.
_BESIDE = 2


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
    # Most of a silhouette is empty: only the part about the foreground is looked at, with cells for the closing.
    x, y, width, height = cv2.boundingRect(coverage)
    left, top = max(x - _BESIDE, 0), max(y - _BESIDE, 0)
    part = coverage[top : y + height + _BESIDE, left : x + width + _BESIDE] >= MIN_COVERAGE
    # In thin silhouettes, gaps of one cell separate rotors and arms from the body.
    closed = cv2.morphologyEx(part.view(np.uint8), cv2.MORPH_CLOSE, _CLOSING)
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
    corner, size = corner[order] + (left, top), size[order]
    end = coverage.shape[::-1] if border is None else border
    whole = ((corner > 0) & (corner + size < end)).all(axis=-1)
    return Blobs((corner + size / 2) * reduction - 0.5, size * reduction, whole)


#: Number of frames that are read together.
_CHUNK_FRAMES = 50


def blob_detections(
    silhouettes: Silhouettes,
    image_sizes_wh: Float[np.ndarray, "cameras 2"],
    report: Report = no_progress,
) -> dict[str, Detections]:
    """The blobs of each camera, in the frames of its own video, as the methods that track blobs find them.

    A box has whole cells of the silhouettes, `reduction` pixels each, and ends at the image's border. Its confidence is
    the mean coverage of its foreground cells.

    Args:
        silhouettes: stored silhouettes of all cameras, by frames, not by instants.
        image_sizes_wh: (cameras, 2), widths and heights of the videos, pixels.
        report: receives the progress, in frames.
    """
    found: dict[str, Detections] = {}
    with report("blobs", sum(array.shape[0] for array in silhouettes.arrays)) as advance:
        for name, array, size_wh in zip(silhouettes.cameras, silhouettes.arrays, image_sizes_wh, strict=True):
            rows = [np.empty((0, 6))]
            for begin in range(0, array.shape[0], _CHUNK_FRAMES):
                chunk = np.asarray(array[begin : begin + _CHUNK_FRAMES])
                for frame, coverage in enumerate(chunk, begin):
                    rows.append(_rows(frame, coverage, silhouettes.reduction, size_wh))
                advance(len(chunk))
            table = np.concatenate(rows)
            found[name] = Detections(table[:, 0].astype(np.int64), table[:, 1:5], table[:, 5])
    return found


def _rows(
    frame: int, coverage: np.ndarray, reduction: int, size_wh: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "blobs 6"]:
    """Frame, box and confidence of each blob of one silhouette."""
    blobs = find_blobs(coverage, reduction)
    # Pixel centres are at whole numbers, so that the edges of a box are half a pixel further.
    x0_y0 = blobs.centre_px - blobs.size_px / 2 + 0.5
    xyxy = np.hstack([x0_y0, x0_y0 + blobs.size_px])
    cells = np.rint(xyxy / reduction).astype(int).tolist()
    inside = [coverage[y0:y1, x0:x1] for x0, y0, x1, y1 in cells]
    confidence = [each[each >= MIN_COVERAGE].mean() / 255 for each in inside]
    return np.column_stack(
        [np.full(len(xyxy), frame), np.minimum(xyxy, np.tile(size_wh, 2)), np.array(confidence)]
    )
