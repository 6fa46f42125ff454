"""A reference against points that a rig triangulates: another clock, unit, handedness or origin."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.trajectories import Trajectories

#: Reference points are on the drones: lever arms of real recordings are up to 0.15 m.
NEAR_M = 0.3
#: Offsets of the clock that are tried, and those that are none, in frames: lever arms pass for less.
_REACH_S, _NO_OFFSET = 2.0, 1.0
#: A clearly better offset leaves less than this share of the distance.
_CLEARLY = 0.5
_ROUNDS = 20


@dataclass(frozen=True)
class ReferenceFit:
    """How points and reference are at odds, in median distances.

    Attributes:
        before_m: as they are.
        after_m: with the offset, or with the motion, in the scale of the points.
        offset_frames: the reference's clock shows so much more than the video's, to a whole frame.
        scale: reference = scale · R · point + shift.
        R: (3, 3), a rotation, or one with a mirror.
        shift_m: (3,).
    """

    before_m: float
    after_m: float
    offset_frames: int
    scale: float
    R: Float[np.ndarray, "3 3"]
    shift_m: Float[np.ndarray, "3"]

    @property
    def agrees(self) -> bool:
        """Whether nothing has to be changed."""
        return self.offset_frames == 0 and self.scale == 1.0 and not self.shift_m.any()


def fit_reference(
    frame: Int[np.ndarray, "points"],
    point_m: Float[np.ndarray, "points 3"],
    reference: Trajectories,
    fps: float,
) -> ReferenceFit:
    """The clock's offset that brings points to the reference; if none does, the motion and the scale.

    Args:
        frame: (points,), of each point.
        point_m: (points, 3), triangulated; which drone each is of is not known.
        reference: at the video's frames, from 0.
        fps: frames per second.
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
    # Points that are scaled to one spot fit anything: distances are judged in the scale of the rig.
    return ReferenceFit(before_m, after_m, 0, scale, R, shift_m) if after_m < NEAR_M else still


def _nearest(
    point_m: Float[np.ndarray, "points 3"], reference_m: Float[np.ndarray, "points drones 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest drone of the reference to each point, and its distance."""
    distance = np.nan_to_num(np.linalg.norm(reference_m - point_m[:, None], axis=-1), nan=np.inf)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(point_m))
    return reference_m[rows, nearest], distance[rows, nearest]


def _without_arm(point_m: np.ndarray, reference_m: np.ndarray) -> float:
    """The median distance after a median lever arm is taken out."""
    nearest_m, distance = _nearest(point_m, reference_m)
    there = np.isfinite(distance)
    if there.sum() < len(point_m) / 2:
        return float("inf")
    off = (nearest_m - point_m)[there]
    return float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=-1)))


def _starts() -> list[np.ndarray]:
    """All signed permutations of the axes, and each turned by 45° about the world's vertical."""
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
    """Median distance in the points' scale, scale, rotation, shift: paired with the nearest drones, fitted, again."""
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
        scale, R, shift_m = _similarity(point_m[kept], nearest_m[kept], np.sign(np.linalg.det(start)))
    distance = _nearest(scale * point_m @ R.T + shift_m, reference_m)[1]
    return float(np.median(distance)) / max(scale, 1e-9), scale, R, shift_m


def _similarity(
    from_m: np.ndarray, to_m: np.ndarray, handedness: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Least squares (S. Umeyama, PAMI 1991), with the handedness given."""
    a, b = from_m - from_m.mean(axis=0), to_m - to_m.mean(axis=0)
    U, singular, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, handedness * np.linalg.det(U @ Vt)])
    R = U @ np.diag(signs) @ Vt
    scale = float((singular * signs).sum() / max((a**2).sum(), 1e-300))
    return scale, R, to_m.mean(axis=0) - scale * R @ from_m.mean(axis=0)
