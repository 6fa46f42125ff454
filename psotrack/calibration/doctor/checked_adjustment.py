"""Adjustment of a rig that is taken only where it is certain, and better on views that it did not use.

The middles of boxes have errors that last, and a bundle adjustment moves sound cameras to make such errors small. So a
camera is moved only if the evidence for its fault exceeds that of a sound rig whose boxes have lasting errors of any
size (`evidence`), and that of small errors of all cameras: if all cameras are a little off, the sound ones among them
cannot be told, and cameras that were moved to agree with the others would move the world. Then the adjustment is made
without a part of the recording, for each part in turn, and must fit the part that was left out better than the rig as
it was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration import DroneViews, Improved, adjust, improve
from psotrack.calibration.doctor.common_points import BLOCK_FRAMES, CommonPoints
from psotrack.calibration.doctor.evidence import gather, prior_of, sum_up, weigh
from psotrack.calibration.doctor.hypotheses import PER_CAMERA, Corrected, Hypothesis
from psotrack.errors import InputError
from psotrack.geometry import Rig, project, triangulate_linearly

#: Smallest evidence by which a moved camera must explain the sightings better: logarithm of a likelihood ratio.
CERTAIN = 5.5
#: Smallest evidence by which errors of some cameras must explain the sightings better than small errors of all cameras.
SOME = 3.0
#: Number of parts of the recording that are left out in turn, and smallest number of them that must fit better.
PARTS, BETTER_PARTS = 4, 3
#: Largest distance of a sighting that counts in full, standard deviations.
_FAR_STD = 4.0


@dataclass(frozen=True)
class CheckedAdjustment:
    """An adjustment, and how it was checked.

    Attributes:
        improved: the adjustment; the rig as it was read if nothing is certain.
        uncertain: names of cameras that the adjustment would have moved without being certain.
        left_out_px: median distances of the sightings that were left out, pixels: with the rig as it was read, and with
            the adjusted one; None if nothing was adjusted.
        better: whether the adjusted rig fits views better that it did not use; False if `improved` is unchanged for
            that reason.
        all_off: whether small errors of all cameras explain the sightings as well as errors of some; if so,
            `improved` is unchanged.
    """

    improved: Improved
    uncertain: tuple[str, ...]
    left_out_px: tuple[float, float] | None
    better: bool
    all_off: bool = False


def improve_with_check(
    rig: Rig,
    views: DroneViews,
    noise_px: float | None = None,
    *,
    fixed: Sequence[str] = (),
    refine_focal_length: bool = False,
) -> CheckedAdjustment:
    """Adjust the cameras that are certainly wrong, if this fits views better that were left out.

    Args:
        rig: the rig as it was read.
        views: bodies in the images.
        noise_px: see `calibration.adjust`; None: that of the views.
        fixed: names of cameras that do not move.
        refine_focal_length: see `calibration.improve`.

    Raises:
        SettingsError, InputError: see `calibration.adjust`.
    """
    noise = views.noise_px if noise_px is None else noise_px
    free = improve(
        rig,
        views.points_px,
        noise,
        fixed=fixed,
        refine_focal_length=refine_focal_length,
        common_errors=views.common_errors,
    )
    if not free.moved and not free.rescaled:
        return CheckedAdjustment(free, (), None, True)
    moved, rescaled, all_off = _certain_faults(rig, views, free.moved, free.rescaled, fixed)
    if all_off:
        return CheckedAdjustment(_unchanged(rig, free), free.moved, None, True, all_off=True)
    uncertain = tuple(name for name in free.moved if name not in moved)
    improved = free
    if not moved and not rescaled:
        return CheckedAdjustment(_unchanged(rig, free), uncertain, None, True)
    if uncertain or rescaled != free.rescaled:
        improved = improve(
            rig,
            views.points_px,
            noise,
            fixed=fixed,
            refine_focal_length=rescaled,
            common_errors=views.common_errors,
            suspects=moved,
        )
    if not improved.moved and not improved.rescaled:
        return CheckedAdjustment(_unchanged(rig, free), uncertain, None, True)
    left_out_px, better = _left_out(rig, views, noise, improved)
    if not better:
        return CheckedAdjustment(_unchanged(rig, free), improved.moved, left_out_px, False)
    return CheckedAdjustment(improved, uncertain, left_out_px, True)


def _unchanged(rig: Rig, free: Improved) -> Improved:
    return Improved(rig, (), {}, False, free.everything, None, free.everything.centre_covariance_m2)


def _certain_faults(
    rig: Rig, views: DroneViews, moved: tuple[str, ...], rescaled: bool, fixed: Sequence[str]
) -> tuple[tuple[str, ...], bool, bool]:
    """Cameras among `moved` that are certainly wrong; whether all focal lengths are; whether all cameras may be."""
    points = _common_points(rig, views)
    corrected = Corrected(rig, np.zeros(len(rig)))
    data = weigh(corrected, points)
    evidence = gather(rig, sum_up(corrected, data), prior_of(rig, data))
    as_sound = evidence.as_sound

    def explained(indices: Sequence[int], with_lenses: bool = False, parts: int = 6) -> float:
        columns = [PER_CAMERA * index + part for index in indices for part in range(parts)]
        columns += [PER_CAMERA * len(rig)] if with_lenses else []
        return evidence.judge(Hypothesis("turned and moved", -1, tuple(columns)), as_sound).evidence

    lenses = rescaled and explained([], True) > CERTAIN
    left = [rig.names.index(name) for name in moved]
    certain: list[int] = []
    gained = explained([], True) if lenses else 0.0
    while left:
        gains = {index: explained([*certain, index], lenses) for index in left}
        best = max(gains, key=lambda index: gains[index])
        if gains[best] < gained + CERTAIN:
            # Several cameras may be certain together although no single one is.
            together = explained([*certain, *left], lenses)
            if together > gained + 2 * CERTAIN:
                certain, left, gained = [*certain, *left], [], together
            break
        certain, gained = [*certain, best], gains[best]
        left.remove(best)
    # Fixed cameras are known to be right, and hold the world.
    all_off = False
    if certain and not fixed:
        turned, turned_and_moved = (explained(range(len(rig)), lenses, parts) for parts in (3, 6))
        all_off = bool(max(turned, turned_and_moved) > gained - SOME)
    return tuple(name for index, name in enumerate(rig.names) if index in certain), lenses, all_off


def _common_points(rig: Rig, views: DroneViews) -> CommonPoints:
    """The views as points in pieces of paths: a body's points in some neighbouring rows."""
    seen = np.isfinite(views.points_px).all(axis=-1)
    position_m = triangulate_linearly(rig.cameras, views.points_px)
    kept = np.flatnonzero((seen.sum(axis=1) >= 2) & np.isfinite(position_m).all(axis=-1))
    _, row = np.unique(views.frame[kept], return_inverse=True)
    block = row // BLOCK_FRAMES
    pair, piece = np.unique(np.stack([block, views.drone[kept]]), axis=1, return_inverse=True)
    return CommonPoints(
        views.frame[kept],
        piece.ravel(),
        pair[0],
        position_m[kept],
        np.zeros((len(kept), 3)),
        views.points_px[kept],
        views.side_px[kept],
        np.zeros((len(kept), len(rig))),
        np.ones((len(kept), len(rig))),
        np.ones(len(rig)),
    )


def _left_out(
    rig: Rig, views: DroneViews, noise_px: float | Float[np.ndarray, "points cameras"], improved: Improved
) -> tuple[tuple[float, float], bool]:
    """Median distances in the parts that are left out in turn, before and after; and whether most parts fit better."""
    noise = np.broadcast_to(np.asarray(noise_px, np.float64), views.points_px.shape[:2])
    stay = [name for name in rig.names if name not in improved.moved]
    rescaled = rig.names if improved.rescaled else ()
    before, after, better = [], [], 0
    for frames in np.array_split(np.unique(views.frame), PARTS):
        out = np.isin(views.frame, frames)
        try:
            there = adjust(rig, views.points_px[~out], noise[~out], fixed=stay, rescaled=rescaled).rig
        except InputError:
            # The other parts see too little: this part does not speak for the adjustment.
            continue
        distance = [_distances(each, views.points_px[out], noise[out]) for each in (rig, there)]
        squared = [np.minimum(px / std, _FAR_STD) ** 2 for px, std in distance]
        if len(squared[0]) and squared[1].mean() < squared[0].mean():
            better += 1
        before.append(distance[0][0])
        after.append(distance[1][0])
    medians = [
        float(np.median(np.concatenate(px))) if px and sum(map(len, px)) else np.nan for px in (before, after)
    ]
    return (medians[0], medians[1]), better >= BETTER_PARTS


def _distances(
    rig: Rig, points_px: Float[np.ndarray, "points cameras 2"], noise_px: Float[np.ndarray, "points cameras"]
) -> tuple[Float[np.ndarray, "seen"], Float[np.ndarray, "seen"]]:
    """Distances of sightings from the projections of their points, pixels, and the sightings' noise."""
    position_m = triangulate_linearly(rig.cameras, points_px, 1 / np.nan_to_num(noise_px, nan=1.0) ** 2)
    off_px = np.linalg.norm(points_px - project(rig.cameras, position_m[:, None])[0], axis=-1)
    # Two rays nearly always meet.
    seen: Bool[np.ndarray, "points cameras"] = np.isfinite(off_px)
    seen &= seen.sum(axis=1, keepdims=True) >= 3
    return off_px[seen], noise_px[seen]
