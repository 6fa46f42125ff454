"""Search for small faults: all hypotheses are compared, and the best one is named if it is certain.

A fault is named if its evidence clearly exceeds that of a sound rig, if it moves the boxes by more than a calibration's
own error, and if its correction brings the boxes as much nearer to where the other cameras put the bodies. If faults of
several cameras explain the sightings equally well, as often with three cameras, none is named as certain.

Frames that are synchronous to the nearest frame leave lags of a fraction of a frame. The sightings of many frames show
such small errors for certain although no user need mend them. They are corrected without a name, because a larger
fault of another camera can have less evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.calibration.doctor.corrections import (
    PER_CAMERA,
    Corrected,
    WeightedPoints,
    linearise,
    misfit_px,
    weigh,
)
from psotrack.calibration.doctor.evidence import Hypothesis, Judged, gather, list_hypotheses
from psotrack.geometry import Rig

#: Logarithms of ratios of likelihoods that are very strong and strong evidence (R. Kass & A. Raftery, Bayes factors,
#: 1995, section 3.2): a fault needs the first over a sound rig and over other kinds of fault, the second over faults of
#: other cameras.
VERY_STRONG, STRONG = 5.0, 3.0
#: Smallest median shift of a camera's boxes by a fault that is named, pixels in an image of 1920 columns: a
#: calibration's own error.
LEAST_PX = 1.5
#: Smallest fraction of this shift that the correction takes from the boxes' distances from where the other cameras put
#: the bodies: what moves boxes must be visible in the residuals.
_VISIBLE = 0.3
#: Number of hypotheses that are fitted without linearisation, and number of their steps.
_REFINED, _STEPS = 6, 3
#: Largest number of errors without a name that are corrected.
_UNNAMED = 4
#: Smallest number of sightings of a camera that is judged.
_MIN_SIGHTINGS = 10
#: Largest standard deviation of a lag that the motion shows, frames.
_KNOWN_LAG = 0.5
_BOTH = "turned and moved"


@dataclass(frozen=True)
class FoundFault:
    """A fault that explains the sightings clearly better than a sound rig.

    Attributes:
        best: the fault, with the whole correction as its step.
        as_well: faults that explain the sightings nearly as well, best first; of other cameras if the fault is not
            certain.
        certain: whether only faults of one camera explain the sightings.
        shift_px: median shift of the camera's boxes by the fault, pixels.
    """

    best: Judged
    as_well: tuple[Judged, ...]
    certain: bool
    shift_px: float


def find_lags(rig: Rig, data: WeightedPoints) -> Float[np.ndarray, "2 cameras"]:
    """Frames by which each video is late relative to the median one, and standard deviations; NaN if nothing moves."""
    columns = tuple(range(PER_CAMERA - 1, PER_CAMERA * len(rig), PER_CAMERA))
    evidence = gather(Corrected(rig, np.zeros(len(rig))), data)
    judged = evidence.judge(Hypothesis("clocks", -1, columns), evidence.as_sound)
    lag, std = judged.step[list(columns)], judged.std[list(columns)]
    return np.where(std < _KNOWN_LAG, [lag - np.median(lag), std], np.nan)


def find_fault(rig: Rig, data: WeightedPoints) -> FoundFault | None:
    """The fault with the largest evidence, after errors that are too small for a name were corrected.

    Args:
        rig: the rig as it was read.
        data: points that were matched and weighted with this rig.
    """
    corrected = Corrected(rig, np.zeros(len(rig)))
    shown_px = misfit_px(corrected, data)
    least_px = LEAST_PX * max(1.0, float(np.median(rig.cameras.image_size_wh[:, 0])) / 1920)
    for _ in range(_UNNAMED):
        likely = _likely(corrected, data)
        if not likely:
            return None
        shifts_px = [_shift_px(corrected, data, one) for one in likely]
        enough = max(VERY_STRONG, likely[0].log_odds - STRONG)
        small = [
            one
            for one, shift_px in zip(likely, shifts_px, strict=True)
            if shift_px < least_px and one.log_odds > enough
        ]
        if not small:
            fault = _decided(likely, shifts_px)
            same = [one for one in likely if one.hypothesis.camera == fault.best.hypothesis.camera]
            # The kind may be uncertain where the camera is certain: any likely kind of its fault may be visible.
            visible_px = max(_explained_px(corrected, data, one) for one in same)
            # The table shows the rig as it was read: a fault that it does not show is none.
            visible_px = min(visible_px, _median(shown_px, fault.best))
            # A fault of all lenses mostly moves the points.
            visible = fault.best.hypothesis.kind == "focal lengths" or visible_px > _VISIBLE * fault.shift_px
            return fault if visible else None
        # A small error that explains the sightings as well as the best fault does is corrected first.
        corrected = corrected.by(small[0].step)
        # Sightings that looked like outliers may be right at the corrected rig.
        data = weigh(corrected, data.points)
    return None


def _explained_px(corrected: Corrected, data: WeightedPoints, judged: Judged) -> float:
    """The part of a camera's misfit that a fault explains, pixels."""
    squared = [_median(misfit_px(each, data), judged) ** 2 for each in (corrected, corrected.by(judged.step))]
    return float(np.sqrt(max(squared[0] - squared[1], 0.0)))


def _median(px: Float[np.ndarray, "points cameras"], judged: Judged) -> float:
    """The median of the cameras that have a fault."""
    camera = judged.hypothesis.camera
    return float(np.nanmedian(px if camera < 0 else px[:, camera]))


def _shift_px(corrected: Corrected, data: WeightedPoints, judged: Judged) -> float:
    """Median shift of the boxes by a fault, pixels."""
    slopes = linearise(corrected, data.points, data.position_m)
    shift_px = np.linalg.norm(slopes.by_parameter @ judged.step, axis=-1)
    return _median(np.where(data.used, shift_px, np.nan), judged)


def _decided(likely: list[Judged], shifts_px: list[float]) -> FoundFault:
    """The fault among the likely ones, the best first."""
    camera = likely[0].hypothesis.camera
    single = [one for one in likely if one.hypothesis.kind != _BOTH]
    # A camera is turned and moved only if neither alone is nearly as likely.
    best = next((one for one in single if one.hypothesis.camera == camera), likely[0])
    # Two faults at once of one camera are too rare to make a single fault of another camera uncertain, and one fault
    # per camera is enough to say which cameras may be wrong.
    others = {
        one.hypothesis.camera: one
        for one in reversed(single)
        if one.hypothesis.camera != camera and one.log_odds > likely[0].log_odds - STRONG
    }
    same = [one for one in single if one.hypothesis.camera == camera and one is not best]
    as_well = others.values() if others else same
    return FoundFault(
        best, tuple(as_well), not others, shifts_px[[one is best for one in likely].index(True)]
    )


def _likely(corrected: Corrected, data: WeightedPoints) -> list[Judged]:
    """The hypotheses against which there is no very strong evidence, best first; none if the rig may be sound."""
    evidence = gather(corrected, data)
    as_sound = evidence.as_sound
    cameras = np.flatnonzero(data.used.sum(axis=0) >= _MIN_SIGHTINGS).tolist()
    judged = [evidence.judge(each, as_sound) for each in list_hypotheses(len(corrected.rig), cameras)]
    judged.sort(key=lambda one: -one.log_odds)
    top = judged[0]
    refined = [
        _refined(corrected, data, one, as_sound)
        for number, one in enumerate(judged)
        if one.log_odds > top.log_odds / 3 - VERY_STRONG
        and (number < _REFINED or one.hypothesis.camera == top.hypothesis.camera)
    ]
    refined.sort(key=lambda one: -one.log_odds)
    best = refined[0].log_odds
    return [one for one in refined if best > VERY_STRONG and one.log_odds > best - VERY_STRONG]


def _refined(corrected: Corrected, data: WeightedPoints, judged: Judged, as_sound: float) -> Judged:
    """The hypothesis with its correction fitted anew at the corrected rig, a few times."""
    for _ in range(_STEPS):
        evidence = gather(corrected.by(judged.step), data)
        judged = evidence.judge(judged.hypothesis, as_sound, judged.step)
    return judged
