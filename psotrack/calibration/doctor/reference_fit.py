"""Fit of a reference to triangulated points: offset of the clock, unit, handedness and origin."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.support import similarity
from psotrack.trajectories import Trajectories

#: Largest median distance between reference and points that agree, metres: lever arms of real recordings are up to
#: 0.15 m.
NEAR_M = 0.3
#: Largest offset of the clock that is tried, seconds, and largest offset that is ignored, frames: lever arms look like
#: small offsets.
_REACH_S, _NO_OFFSET = 2.0, 1.0
#: An offset is clearly better if the remaining distance is below this share of the distance without an offset.
_CLEARLY = 0.5
#: Number of rounds in which points are paired with drones and the motion is fitted.
_ROUNDS = 20


@dataclass(frozen=True)
class ReferenceFit:
    """Differences between points and reference: reference = scale · R · point + shift.

    Attributes:
        before_m: median distance of the points from the reference as it was read, metres.
        after_m: median distance with the offset or with the motion, in the scale of the points, metres.
        offset_frames: offset by which the reference's clock is ahead of the video's, whole frames.
        scale: scale of the reference relative to the points.
        R: (3, 3), rotation, or rotation with a mirror.
        shift_m: (3,), shift, metres.
    """

    before_m: float
    after_m: float
    offset_frames: int
    scale: float
    R: Float[np.ndarray, "3 3"]
    shift_m: Float[np.ndarray, "3"]

    @property
    def agrees(self) -> bool:
        """True if neither an offset nor a motion is needed."""
        return self.offset_frames == 0 and self.scale == 1.0 and not self.shift_m.any()


def fit_reference(
    frame: Int[np.ndarray, "points"],
    point_m: Float[np.ndarray, "points 3"],
    reference: Trajectories,
    fps: float,
) -> ReferenceFit:
    """Find the offset of the clock that brings the points to the reference; without one, the motion and the scale.

    Args:
        frame: (points,), number of each point's frame.
        point_m: (points, 3), triangulated points of unknown drones, metres.
        reference: reference at the video's frames, from frame 0.
        fps: frames per second of the video.
    """
    reach = round(_REACH_S * fps)
    median = {}
    for offset in range(-reach, reach + 1):
        at = frame + offset
        inside = (at >= 0) & (at < reference.num_frames)
        if inside.sum() > len(frame) / 2:
            median[offset] = _without_arm(point_m[inside], reference.position_m[at[inside]])
    before_m = float(np.median(_nearest(point_m, reference.position_m[frame])[1]))
    best = min(median, key=lambda offset: median[offset])
    still = ReferenceFit(before_m, before_m, 0, 1.0, np.eye(3), np.zeros(3))
    if median[best] < NEAR_M and abs(best) > _NO_OFFSET and median[best] < _CLEARLY * median[0]:
        at = np.clip(frame + best, 0, reference.num_frames - 1)
        after_m = float(np.median(_nearest(point_m, reference.position_m[at])[1]))
        return ReferenceFit(before_m, after_m, best, 1.0, np.eye(3), np.zeros(3))
    if before_m < NEAR_M:
        return still
    fits = [_iterated(point_m, reference.position_m[frame], start) for start in _starts()]
    after_m, scale, R, shift_m = min(fits, key=lambda fit: fit[0])
    # Points that are scaled to one place fit every reference, so distances are compared in the scale of the rig.
    return ReferenceFit(before_m, after_m, 0, scale, R, shift_m) if after_m < NEAR_M else still


def _nearest(
    point_m: Float[np.ndarray, "points 3"], reference_m: Float[np.ndarray, "points drones 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The reference's drone that is nearest to each point, and its distance."""
    distance = np.nan_to_num(np.linalg.norm(reference_m - point_m[:, None], axis=-1), nan=np.inf)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(point_m))
    return reference_m[rows, nearest], distance[rows, nearest]


def _without_arm(point_m: np.ndarray, reference_m: np.ndarray) -> float:
    """Median distance after the median lever arm is subtracted."""
    nearest_m, distance = _nearest(point_m, reference_m)
    there = np.isfinite(distance)
    if there.sum() < len(point_m) / 2:
        return float("inf")
    off = (nearest_m - point_m)[there]
    return float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=-1)))


def _starts() -> list[np.ndarray]:
    """Initial rotations: all signed permutations of the axes, and the same turned by 45° about the world's vertical."""
    eighth = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    signed = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return [turn @ one for one in signed for turn in (np.eye(3), eighth)]


def _iterated(
    point_m: np.ndarray, reference_m: np.ndarray, start: np.ndarray
) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Pair the points with the nearest drones and fit a similarity, repeatedly: median distance, scale, R, shift."""
    all_m = reference_m[np.isfinite(reference_m).all(axis=-1)]
    centre_m, middle_m = np.median(point_m, axis=0), np.median(all_m, axis=0)
    scale = float(np.median(np.abs(all_m - middle_m).sum(-1)) / np.median(np.abs(point_m - centre_m).sum(-1)))
    R, shift_m = start, middle_m - scale * start @ centre_m
    for _ in range(_ROUNDS):
        moved_m = scale * point_m @ R.T + shift_m
        nearest_m, distance = _nearest(moved_m, reference_m)
        kept = distance <= 2 * np.median(distance)
        if not np.isfinite(distance[kept]).all() or kept.sum() < 4:
            break
        mirrored = bool(np.linalg.det(start) < 0)
        scale, R, shift_m = similarity(point_m[kept], nearest_m[kept], mirrored=mirrored)
    distance = _nearest(scale * point_m @ R.T + shift_m, reference_m)[1]
    return float(np.median(distance)) / max(scale, 1e-9), scale, R, shift_m
