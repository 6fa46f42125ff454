"""How well a network does on samples: pixels, drones found, false alarms, and the loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from psotrack.foreground.learning.samples import Samples
from psotrack.foreground.learning.steps import Batch, look
from psotrack.foreground.network import USUAL_CONFIDENCE, Network, boxes_of, padded

#: A box is a drone's from this intersection over union on.
_LEAST_IOU = 0.3


class Scores(NamedTuple):
    """How well a network does, over all samples.

    Attributes:
        loss: mean loss.
        pixel_f: F-measure of pixels that are covered by a half at least, where masks are known.
        recall: share of the drones that are found.
        false_per_frame: boxes per frame that are no drone's.
    """

    loss: float
    pixel_f: float
    recall: float
    false_per_frame: float


def score(network: Network, samples: Sequence[Samples]) -> Scores:
    """Score a network on whole frames, without random changes."""
    loss, found_px, shown_px, both_px = 0.0, 0, 0, 0
    found, drones, false, frames = 0, 0, 0, 0
    for each in samples:
        height, width = each.background.shape[:2]
        for index in range(len(each)):
            batch = _whole(each, index)
            total, share, middle, box = map(np.asarray, look(network, batch))
            is_found, is_shown = share[:height, :width] >= 0.5, np.asarray(each.covered[index]) >= 128
            if not each.by_boxes:
                found_px, shown_px = found_px + is_found.sum(), shown_px + is_shown.sum()
                both_px += (is_found & is_shown).sum()
            boxes, _ = boxes_of(middle, box, USUAL_CONFIDENCE)
            truth = np.array(each.box_px[index])
            truth = truth[np.isfinite(truth).all(axis=1)]
            right = matched(boxes, truth)
            found, drones, false = found + right, drones + len(truth), false + len(boxes) - right
            loss, frames = loss + float(total), frames + 1
    pixel_f = 2 * both_px / max(found_px + shown_px, 1)
    return Scores(loss / frames, float(pixel_f), found / max(drones, 1), false / frames)


def _whole(samples: Samples, index: int) -> Batch:
    """A whole frame, with a border to the multiple of pixels that the network takes."""
    image, background = padded(samples.image[index]), padded(np.asarray(samples.background))
    covered = np.zeros(image.shape[:2], np.uint8)
    rows, columns = samples.covered[index].shape
    covered[:rows, :columns] = samples.covered[index]
    box_px = np.array(samples.box_px[index], np.float32)
    counts = (covered == 0) | (not samples.by_boxes)
    arrays = image, background, covered, counts, box_px, np.array(not samples.by_boxes)
    return Batch(*(each[None] for each in arrays))


def matched(boxes: Float[np.ndarray, "found 4"], truth: Float[np.ndarray, "drones 4"]) -> int:
    """Number of drones that have a box, each at most one, the best box first."""
    free = np.ones(len(truth), bool)
    for box in boxes:
        low, high = np.maximum(box[:2], truth[:, :2]), np.minimum(box[2:], truth[:, 2:])
        common = np.maximum(high - low, 0).prod(axis=1)
        areas = np.prod(box[2:] - box[:2]) + (truth[:, 2:] - truth[:, :2]).prod(axis=1)
        overlap = np.where(free, common / (areas - common), -1.0)
        if overlap.size and overlap.max() >= _LEAST_IOU:
            free[overlap.argmax()] = False
    return int((~free).sum())
