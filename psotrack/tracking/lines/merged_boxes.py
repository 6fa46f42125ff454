"""Boxes that hold several drones, split: blobs that touch, and drones that a detector merged into one box.

The middle of such a box is the middle of no drone. But each edge of the box is an edge of the outermost drone on that
side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from psotrack.tracking.matching import Sightings, by_image

#: Additional standard deviation of a middle that follows from one edge and the drone's size, as a share of the box's
#: sides: the size changes as the drone turns.
PART_SHARE = 0.1


def split_merged_boxes(view: Sightings, expected_px: Float[np.ndarray, "drones cameras 4"]) -> Sightings:
    """The frame's boxes, with boxes of several drones replaced by one box for each drone whose place is known.

    A box is of several drones if several drones are expected in it, and if the box around all these drones fits it
    better than the box of any single one. A drone that has an edge of the box on both axes is placed by these edges
    and its size. The places of the other drones are not known: they are hidden.

    Args:
        view: boxes of the frame.
        expected_px: (drones, cameras, 4), middles and half lengths of the drones' expected boxes, pixel centres at
            whole numbers; NaN where a drone has no image, or its size is not known: then it is in no box.
    """
    middle_px, half_px = expected_px[..., :2], expected_px[..., 2:]
    # (drones, cameras, boxes): comparisons with NaN are false.
    inside = (np.abs(middle_px[:, :, None] - view.centre_px) < view.size_px / 2).all(axis=-1)
    inside &= np.isfinite(half_px).all(axis=-1)[..., None]
    camera, box = np.nonzero(inside.sum(axis=0) > 1)
    if not len(camera):
        return view
    centre_px, seen_half_px = view.centre_px[camera, box], view.size_px[camera, box] / 2
    seen_px = centre_px - seen_half_px, centre_px + seen_half_px
    # (boxes, drones, 2): only drones that are expected in the box can have its edges.
    members = inside[:, camera, box].T
    lower_px, upper_px = (
        edges[:, camera].swapaxes(0, 1) for edges in (middle_px - half_px, middle_px + half_px)
    )
    alone = np.where(members, _iou((lower_px, upper_px), [edges[:, None] for edges in seen_px]), -1.0)
    first_px = np.where(members[..., None], lower_px, np.inf)
    last_px = np.where(members[..., None], upper_px, -np.inf)
    several = _iou((first_px.min(axis=1), last_px.max(axis=1)), seen_px) > alone.max(axis=-1)
    row, drone = np.nonzero(members & several[:, None])
    # Whether the lower and the upper edge of the box are this drone's.
    first = first_px.argmin(axis=1)[row] == drone[:, None]
    last = last_px.argmax(axis=1)[row] == drone[:, None]
    placed = (first | last).all(axis=-1)
    row, drone, first, last = row[placed], drone[placed], first[placed], last[placed]
    size_px = (upper_px - lower_px)[row, drone]
    from_first, from_last = seen_px[0][row] + size_px / 2, seen_px[1][row] - size_px / 2
    placed_px = np.where(first & last, (from_first + from_last) / 2, np.where(first, from_first, from_last))
    noise_px = np.hypot(view.noise_px[camera, box][row], PART_SHARE * np.sqrt(size_px.prod(axis=-1)))
    kept = np.ones(view.noise_px.shape, bool)
    kept[camera[several], box[several]] = False
    rest = view.where(kept)

    def with_placed(values: np.ndarray, more: np.ndarray) -> np.ndarray:
        return np.concatenate([values, by_image(camera[row], more, len(values))], axis=1)

    return replace(
        rest,
        centre_px=with_placed(rest.centre_px, placed_px),
        size_px=with_placed(rest.size_px, size_px),
        noise_px=with_placed(rest.noise_px, noise_px),
    )


def _iou(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> np.ndarray:
    """Intersection over union of boxes (..., 2) that broadcast, each given by its lower and its upper corners."""
    sides = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    shared = np.maximum(sides, 0.0).prod(axis=-1)
    return shared / ((one[1] - one[0]).prod(axis=-1) + (other[1] - other[0]).prod(axis=-1) - shared)
