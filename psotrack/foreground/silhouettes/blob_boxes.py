"""Blobs as detections: boxes of the blobs of each camera, at the size of the video."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.foreground.silhouettes.blobs import find_blobs
from psotrack.foreground.silhouettes.frames import Silhouettes
from psotrack.foreground.silhouettes.settings import MIN_COVERAGE
from psotrack.recordings import Detections
from psotrack.support import Report, no_progress

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
