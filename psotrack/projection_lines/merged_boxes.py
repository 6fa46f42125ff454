"""Boxes that hold several drones, split: blobs that touch, and drones that a detector merged into one box.

The middle of such a box is the middle of no drone. But each edge of the box is an edge of the outermost drone on that
side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence import Sightings
from psotrack.geometry import NEAR_M, Camera, project_visible, sizes_px, to_camera

#: Additional standard deviation of a middle that follows from one edge and the drone's size, as a share of the box's
#: sides: the size changes as the drone turns.
PART_SHARE = 0.1


@dataclass(frozen=True)
class _Outlines:
    """Boxes by their corners; pixel centres are at whole numbers.

    Attributes:
        lower_px, upper_px: (..., 2), corners of smallest and largest x and y.
    """

    lower_px: Float[np.ndarray, "*boxes 2"]
    upper_px: Float[np.ndarray, "*boxes 2"]

    @property
    def size_px(self) -> Float[np.ndarray, "*boxes 2"]:
        """(..., 2), widths and heights."""
        return self.upper_px - self.lower_px

    def iou(self, other: _Outlines) -> Float[np.ndarray, "*boxes"]:
        """Intersection over union, of boxes that broadcast."""
        lower = np.maximum(self.lower_px, other.lower_px)
        shared = np.maximum(np.minimum(self.upper_px, other.upper_px) - lower, 0.0).prod(axis=-1)
        return shared / (self.size_px.prod(axis=-1) + other.size_px.prod(axis=-1) - shared)


def split_merged_boxes(
    cameras: Camera,
    view: Sightings,
    expected_m: Float[np.ndarray, "drones 3"],
    span_m: Float[np.ndarray, "drones 2"],
) -> Sightings:
    """The frame's boxes, with boxes of several drones replaced by one box for each drone whose place is known.

    A box is of several drones if several drones are expected in it, and if the box around all these drones fits it
    better than the box of any single one. A drone that has an edge of the box on both axes is placed by these edges
    and its size. The places of the other drones are not known: they are hidden.

    Args:
        cameras: cameras with one leading axis.
        view: boxes of the frame.
        expected_m: (drones, 3), expected positions, metres.
        span_m: (drones, 2), widths and heights of the drones, metres; NaN where they are not known: then no box is
            split.
    """
    outlines, inside = _expected(cameras, view, expected_m, span_m)
    camera, box = np.nonzero(inside.sum(axis=0) > 1)
    if not len(camera):
        return view
    half_px = view.size_px[camera, box] / 2
    seen = _Outlines(view.centre_px[camera, box] - half_px, view.centre_px[camera, box] + half_px)
    # (boxes, drones, 2): only drones that are expected in the box can have its edges.
    members = inside[:, camera, box].T
    lower_px = np.where(members[..., None], outlines.lower_px[:, camera].swapaxes(0, 1), np.inf)
    upper_px = np.where(members[..., None], outlines.upper_px[:, camera].swapaxes(0, 1), -np.inf)
    alone = np.full(members.shape, -1.0)
    row, drone = np.nonzero(members)
    each = _Outlines(lower_px[row, drone], upper_px[row, drone])
    alone[row, drone] = each.iou(_Outlines(seen.lower_px[row], seen.upper_px[row]))
    together = _Outlines(lower_px.min(axis=1), upper_px.max(axis=1)).iou(seen)
    several = together > alone.max(axis=-1)
    # Whether the lower and the upper edge of the box are this drone's.
    first = several[row, None] & (lower_px.argmin(axis=1)[row] == drone[:, None])
    last = several[row, None] & (upper_px.argmax(axis=1)[row] == drone[:, None])
    placed = (first | last).all(axis=-1)
    row, first, last, size_px = row[placed], first[placed], last[placed], each.size_px[placed]
    from_first, from_last = seen.lower_px[row] + size_px / 2, seen.upper_px[row] - size_px / 2
    middle_px = np.where(first & last, (from_first + from_last) / 2, np.where(first, from_first, from_last))
    off_px = PART_SHARE * np.sqrt(size_px.prod(axis=-1))
    noise_px = np.hypot(view.noise_px[camera, box][row], off_px)
    return _with(view.without(camera[several], box[several]), camera[row], middle_px, size_px, noise_px)


def _expected(
    cameras: Camera,
    view: Sightings,
    expected_m: Float[np.ndarray, "drones 3"],
    span_m: Float[np.ndarray, "drones 2"],
) -> tuple[_Outlines, Bool[np.ndarray, "drones cameras boxes"]]:
    """The expected boxes (drones, cameras, 2), and in which of the frame's boxes the drones are expected."""
    pixels, depth = (np.asarray(part) for part in project_visible(cameras, expected_m[:, None]))
    half_px = sizes_px(cameras, np.asarray(to_camera(cameras, expected_m[:, None])), span_m[:, None]) / 2
    known = np.isfinite(half_px).all(axis=-1) & (depth > NEAR_M)
    inside = (np.abs(pixels[:, :, None] - view.centre_px) < view.size_px / 2).all(axis=-1)
    return _Outlines(pixels - half_px, pixels + half_px), inside & known[..., None]


def _with(
    view: Sightings,
    camera: Int[np.ndarray, "more"],
    centre_px: Float[np.ndarray, "more 2"],
    size_px: Float[np.ndarray, "more 2"],
    noise_px: Float[np.ndarray, "more"],
) -> Sightings:
    """The frame's boxes and some more; `camera` is in ascending order."""
    place = np.arange(len(camera)) - np.searchsorted(camera, camera)
    room = int(place.max(initial=-1)) + 1

    def longer(values: np.ndarray, more: np.ndarray) -> np.ndarray:
        added = np.full((len(values), room, *values.shape[2:]), np.nan)
        added[camera, place] = more
        return np.concatenate([values, added], axis=1)

    return replace(
        view,
        centre_px=longer(view.centre_px, centre_px),
        size_px=longer(view.size_px, size_px),
        noise_px=longer(view.noise_px, noise_px),
    )
