"""Search for small faults: all hypotheses are compared, and the best one is named if it is certain.

A fault is named if its evidence clearly exceeds that of a sound rig, if it moves the boxes by more than a calibration's
own error, and if it predicts blocks of frames from the other blocks better than a sound rig does. If faults of several
cameras explain the sightings equally well, as often with three cameras, none is named as certain.

Frames that are synchronous to the nearest frame leave lags of a fraction of a frame. The sightings of many frames show
such small errors for certain although no user need mend them. They are corrected without a name, because a larger
fault of another camera can have less evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from psotrack.calibration.doctor.common_points import CommonPoints
from psotrack.calibration.doctor.evidence import (
    Judged,
    PieceEquations,
    WeightedPoints,
    arranged,
    gather,
    nuisance_std,
    prior_of,
    sum_up,
    weigh,
    without_local,
)
from psotrack.calibration.doctor.hypotheses import Corrected, linearise, list_hypotheses
from psotrack.geometry import Rig

#: Smallest evidence of the first fault, and of further faults: logarithms of likelihood ratios. Of 60 sound rigs by
#: formula, none has a fault with more than 4.
FIRST, FURTHER = 5.0, 12.0
#: Smallest evidence by which a fault exceeds those of other cameras, and by which a kind that has more parameters, or
#: is rarer, exceeds a simpler kind of the same camera.
OTHER_CAMERA, SIMPLER = 4.0, 4.0
#: Kinds of the same camera whose evidence is nearer than this to the named kind are mentioned. A turn and a way differ
#: only in how the shift depends on the distance, as errors in units of the box's side do: in rigs by formula, the right
#: one of the two has up to 5.3 less.
AS_WELL = 6.0
#: Smallest median shift of a camera's boxes by a fault that is named, pixels in an image of 1920 columns.
LEAST_PX = 1.5
#: Number of parts of the recording, each predicted from the others, and smallest share of the parts that a fault
#: predicts better than a sound rig does. Neighbouring blocks of frames are in one part, because their errors are alike.
FOLDS, BETTER_PARTS = 4, 0.5
#: Number of hypotheses that are fitted without linearisation, and number of their steps.
_REFINED, _STEPS = 6, 3
#: A hypothesis whose linearised evidence is less than a third of the largest by more than this is not fitted.
_REACH = 5.0


@dataclass(frozen=True)
class FoundFault:
    """A fault that explains the sightings clearly better than a sound rig.

    Attributes:
        best: the fault, with the whole correction as its step.
        as_well: faults that explain the sightings nearly as well, best first; with other cameras if the fault is not
            certain.
        certain: whether only faults of one camera explain the sightings.
        shift_px: median shift of the camera's boxes by the fault, pixels.
    """

    best: Judged
    as_well: tuple[Judged, ...]
    certain: bool
    shift_px: float


def consistent_share(rig: Rig, points: CommonPoints) -> float:
    """Share of the matched sightings that go on from frame to frame; the rest of a body's sightings are outliers.

    Sightings that only agree by chance, such as spots of noise, do not move as one body in all cameras.
    """
    weight = weigh(Corrected(rig, np.zeros(len(rig))), points).weight
    return float((weight > 0).sum() / max(points.seen.sum(), 1))


def find_faults(rig: Rig, points: CommonPoints) -> tuple[list[FoundFault], Corrected]:
    """Find faults one after the other, and correct them.

    Args:
        rig: the rig as it was read.
        points: points that were matched with this rig.

    Returns:
        The faults, the clearest first; and the rig with all certain faults and all errors too small for a name
        corrected.
    """
    corrected = Corrected(rig, np.zeros(len(rig)))
    found: list[FoundFault] = []
    if not len(points.frame):
        return found, corrected
    data = weigh(corrected, points)
    free: list[int] = []
    cameras = [index for index in range(len(rig)) if (data.weight[:, index] > 0).sum() >= 10]
    # At least half of the cameras are taken as sound.
    while len(found) < max(1, len(rig) // 2):
        fault = _find_fault(corrected, data, cameras, free, FURTHER if found else FIRST)
        if fault is None:
            break
        is_small = fault.shift_px < _least_px(rig)
        if not fault.certain and (found or is_small):
            break
        if not is_small:
            found.append(fault)
            if not fault.certain:
                break
            cameras = [each for each in cameras if each != fault.best.hypothesis.camera]
        corrected = corrected.by(fault.best.step)
        free += fault.best.hypothesis.columns
        # Sightings that looked like outliers may be right at the corrected rig.
        data = weigh(corrected, points)
    return found, corrected


def _find_fault(
    corrected: Corrected, data: WeightedPoints, cameras: list[int], free: list[int], least: float
) -> FoundFault | None:
    """The fault with the largest evidence; or a shift too small for a name, if it explains the sightings as well."""
    rig = corrected.rig
    sums, std = sum_up(corrected, data), prior_of(corrected.rig, data)
    evidence = gather(rig, sums, std, free)
    as_sound = evidence.as_sound
    hypotheses = [
        each
        for each in list_hypotheses(len(rig), cameras)
        if not set(each.columns) & set(free) and (each.camera >= 0 or not free)
    ]
    judged = sorted((evidence.judge(each, as_sound) for each in hypotheses), key=lambda one: -one.evidence)
    if not judged or judged[0].evidence < least:
        return None
    tried = [
        one
        for number, one in enumerate(judged)
        if (number < _REFINED or one.hypothesis.camera == judged[0].hypothesis.camera)
        and one.evidence > judged[0].evidence / 3 - _REACH
    ]
    refined = [_refine(corrected, data, one, std, free, as_sound) for one in tried]
    refined.sort(key=lambda one: -one.evidence)
    top, best = refined[0].evidence, _simplest(refined)
    if top < least:
        return None
    for one in refined:
        # A small error that explains the sightings as well as the best fault does is corrected first.
        if one.evidence > max(least, top - OTHER_CAMERA):
            small_px = _shift_px(corrected, data, one)
            if small_px < _least_px(rig):
                return FoundFault(one, (), True, small_px)
    shift_px = _shift_px(corrected, data, best)
    same = [one for one in refined if one.hypothesis.camera == best.hypothesis.camera]
    # The kind may be uncertain where the camera is certain: any likely kind of its fault may predict.
    if not any(_predicts_better(rig, sums, data, one, std, free) for one in same if one.evidence >= least):
        return None
    # Two faults at once of one camera are too rare to make a single fault of another camera uncertain.
    single = [one for one in refined if one is not best and one.hypothesis.kind != "turned and moved"]
    others = [
        one
        for one in single
        if one.hypothesis.camera != best.hypothesis.camera and one.evidence > top - OTHER_CAMERA
    ]
    if others:
        # One fault per camera is enough to say which cameras may be wrong.
        first = {one.hypothesis.camera: one for one in reversed(others)}
        return FoundFault(best, tuple(first.values()), False, shift_px)
    as_well = [
        one
        for one in single
        if one.hypothesis.camera == best.hypothesis.camera and one.evidence > best.evidence - AS_WELL
    ]
    return FoundFault(best, tuple(as_well), True, shift_px)


def _least_px(rig: Rig) -> float:
    """Smallest median shift of a camera's boxes by a fault that is named, pixels of this rig's images."""
    return LEAST_PX * max(1.0, float(np.median(rig.cameras.image_size_wh[:, 0])) / 1920)


def _simplest(refined: list[Judged]) -> Judged:
    """The best hypothesis; a camera is turned and moved only if neither alone is nearly as likely."""
    best = refined[0]
    if best.hypothesis.kind != "turned and moved":
        return best
    simpler = [
        one
        for one in refined
        if one.hypothesis.camera == best.hypothesis.camera and one.hypothesis.kind != "turned and moved"
    ]
    return simpler[0] if simpler and simpler[0].evidence > best.evidence - SIMPLER else best


def _refine(
    corrected: Corrected,
    data: WeightedPoints,
    judged: Judged,
    std: Float[np.ndarray, "parameters"],
    free: list[int],
    as_sound: float,
) -> Judged:
    """The hypothesis with its correction fitted anew at the corrected rig, a few times."""
    step = judged.step
    for _ in range(_STEPS):
        there = corrected.by(step)
        evidence = gather(there.rig, sum_up(there, data), std, free, judged.likely)
        now = evidence.judge(judged.hypothesis, as_sound, step)
        change = np.abs(now.step / std).max()
        step = step + now.step
        judged = replace(now, step=step)
        if change < 1e-2:
            break
    return judged


def _shift_px(corrected: Corrected, data: WeightedPoints, judged: Judged) -> float:
    """Median shift of the boxes by a fault, pixels."""
    slopes = linearise(
        corrected, data.position_m, data.points.velocity_m, data.points.centre_px, data.points.offset_frames
    )
    shift = np.linalg.norm(slopes.by_parameter @ judged.step, axis=-1)
    camera = judged.hypothesis.camera
    seen = data.weight > 0
    if camera >= 0:
        shift, seen = shift[:, camera], seen[:, camera]
    return float(np.median(shift[seen])) if seen.any() else 0.0


def _predicts_better(
    rig: Rig,
    sums: PieceEquations,
    data: WeightedPoints,
    judged: Judged,
    std: Float[np.ndarray, "parameters"],
    free: list[int],
) -> bool:
    """Whether a fault, fitted to the other parts of the recording, predicts most parts better than a sound rig."""
    piece_share, *of_camera = judged.sizes
    pieces, _ = without_local(sums, piece_share)
    pieces, nuisance = arranged(pieces, nuisance_std(rig, *of_camera), std, free)
    first = len(nuisance)
    moved = sum(column < min(judged.hypothesis.columns) for column in free)
    chosen = [first + column - moved for column in judged.hypothesis.columns]
    parts = np.array_split(np.unique(data.points.run), FOLDS)
    parts = [part for part in parts if len(part)]
    if len(parts) < 2:
        return True
    total = pieces.sum(axis=0)
    gains = []
    for part in parts:
        here = pieces[np.isin(data.points.run, part)].sum(axis=0)
        rest = total - here
        costs = []
        for columns, prior in (
            (list(range(first)), nuisance),
            ([*range(first), *chosen], np.append(nuisance, 3 * std[list(judged.hypothesis.columns)])),
        ):
            at = np.ix_(columns, columns)
            solved = np.linalg.solve(rest[at] + np.diag(prior**-2.0), rest[columns, -1])
            costs.append(here[-1, -1] - 2 * solved @ here[columns, -1] + solved @ here[at] @ solved)
        gains.append(costs[0] - costs[1])
    gain = np.array(gains)
    # A part in which nothing tells between both counts for neither.
    telling = np.abs(gain) > 0.02 * np.abs(gain).max()
    return bool(gain.sum() > 0 and (gain > 0)[telling].mean() >= BETTER_PARTS)
