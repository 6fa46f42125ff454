"""Blobs as detections: boxes of the blobs of each camera, at the size of the video."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.recordings import Detections
from psotrack.silhouettes.blobs import find_blobs
from psotrack.silhouettes.computation import Silhouettes
from psotrack.silhouettes.settings import MIN_COVERAGE
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
        for index, name in enumerate(silhouettes.cameras):
            array, border = silhouettes.arrays[index], silhouettes.borders[index]
            frames, boxes, scores = [], [], []
            for begin in range(0, array.shape[0], _CHUNK_FRAMES):
                chunk = np.asarray(array[begin : begin + _CHUNK_FRAMES])
                for frame, coverage in enumerate(chunk, begin):
                    blobs = find_blobs(coverage, silhouettes.reduction, border)
                    # Pixel centres are at whole numbers, so that the edges of a box are half a pixel further.
                    xyxy = (
                        np.hstack([blobs.centre_px - blobs.size_px / 2, blobs.centre_px + blobs.size_px / 2])
                        + 0.5
                    )
                    cells = np.rint(xyxy / silhouettes.reduction).astype(int)
                    frames += [frame] * len(xyxy)
                    boxes.append(np.minimum(xyxy, np.tile(image_sizes_wh[index], 2)))
                    scores += [_confidence(coverage[y0:y1, x0:x1]) for x0, y0, x1, y1 in cells]
                advance(len(chunk))
            found[name] = Detections(
                np.array(frames, np.int64),
                np.concatenate([np.empty((0, 4)), *boxes]),
                np.array(scores, np.float64),
            )
    return found


def _confidence(coverage: np.ndarray) -> float:
    inside = coverage[coverage >= MIN_COVERAGE]
    return float(inside.mean() / 255) if inside.size else 0.0
