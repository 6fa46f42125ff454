"""Search for small faults: all hypotheses are compared, and the best one is named if it is certain.

**Evidence.** A hypothesis is compared by how well it predicts the sightings, given what boxes do even for a sound rig.
The middle of a box is not at the body's projection: its error has several parts. One part is white noise. The others
are correlated, because the middle of the outline is not the same point of the body for two cameras: an error for each
piece of a path, and an error of each camera for all bodies, which changes slowly over the image. Both are normal with
standard deviations in units of the box's side, which are not known: compact lopsided bodies have errors of a tenth of
the side, flat drones of a hundredth. A sound calibration has a small error, too.

The points, the correlated errors and the sizes of the errors are integrated out (points: flat prior; sizes: a grid), so
that hypotheses compare by their marginal likelihoods (R. Kass & A. Raftery, Bayes factors, J. American Statistical
Association 90, 1995). A fault of one camera is taken only if the other cameras agree better than correlated errors of
the needed size would let them.

**Decision.** A fault is named if its evidence clearly exceeds that of a sound rig, if it moves the boxes by more than a
calibration's own error, and if its correction brings the boxes as much nearer to where the other cameras put the
bodies. If faults of several cameras explain the sightings equally well, as often with three cameras, none is named as
certain.

Frames that are synchronous to the nearest frame leave lags of a fraction of a frame. The sightings of many frames show
such small errors for certain although no user need mend them. They are corrected without a name, because a larger
fault of another camera can have less evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from psotrack.calibration.doctor.common_points import (
    PER_CAMERA,
    Corrected,
    WeightedPoints,
    linearise,
    misfit_px,
    weigh,
)
from psotrack.geometry import Rig

#: Sizes that are tried of the correlated errors, as fractions of a box's side: of each piece, and of each camera.
_PIECE_ERRORS = (0.01, 0.03, 0.09, 0.27)
_CAMERA_ERRORS = (0.007, 0.02, 0.05, 0.12)
#: Sizes that are tried of a sound calibration's errors, pixels in an image of 1920 columns.
_CALIBRATION_PX = (0.2, 0.5, 1.0)
#: Logarithm of the prior probability of the largest sizes: such lopsided bodies, and such poor calibrations, are rare.
_RARE = -3.0
#: A box of this side has errors as if it were larger by the square root of 2, pixels: pixels are not infinitely small.
_SMALL_BOX_PX = 10.0
#: Factors of the standard deviations of the parameters' prior distribution, all as likely.
_PRIOR_FACTORS = (0.1, 0.3, 1.0, 3.0)
#: Standard deviations of the parameters: turns, degrees; ways, as a fraction of the distance of the bodies; logarithm
#: of the focal length; lag of a video, frames.
_TURN_DEG, _WAY, _ZOOM, _LAG_FRAMES = 0.7, 0.02, 0.03, 1.5
#: Faults of one camera: their parameters, and the logarithm of their prior probability relative to the others: who
#: pushes a camera turns it.
_FAULTS = {
    "turned": ((0, 1, 2), 0.0),
    "moved": ((3, 4, 5), -0.5),
    "turned and moved": ((0, 1, 2, 3, 4, 5), -2.0),
    "focal length": ((6,), 0.0),
    "clock": ((7,), 0.0),
}
#: The same logarithm of faults of all cameras: the perspective of extended bodies and boxes that merge look a little
#: like a fault of all lenses.
_OF_ALL = -7.0
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
class Hypothesis:
    """A possible fault.

    Attributes:
        kind: turned, moved, turned and moved, focal length or clock; several for turns of all cameras; focal lengths
            for all lenses together; clocks for all videos.
        camera: index of the camera; -1 for all cameras.
        columns: indices of the parameters among those of the whole rig.
        log_prior: logarithm of its prior probability relative to that of other faults.
    """

    kind: str
    camera: int
    columns: tuple[int, ...]
    log_prior: float = 0.0


@dataclass(frozen=True)
class Judged:
    """A hypothesis and how well it explains the sightings.

    Attributes:
        hypothesis: the possible fault.
        log_odds: logarithm of its marginal likelihood relative to that of a sound rig.
        step: (parameters,), the most likely correction; 0 for all other parameters.
        std: (parameters,), standard deviations of the correction; 0 for all other parameters.
    """

    hypothesis: Hypothesis
    log_odds: float
    step: Float[np.ndarray, "parameters"]
    std: Float[np.ndarray, "parameters"]


@dataclass(frozen=True)
class Evidence:
    """Normal equations of the parameters at one rig for each size of correlated errors, other unknowns integrated out.

    Attributes:
        equations: (sizes, parameters + 1, parameters + 1), left side, and the right side as last row and column.
        sound: (sizes,), logarithm of the marginal likelihood if all parameters are 0.
        prior_std: (parameters,), standard deviations of the parameters' prior distribution.
    """

    equations: Float[np.ndarray, "sizes columns columns"]
    sound: Float[np.ndarray, "sizes"]
    prior_std: Float[np.ndarray, "parameters"]

    @property
    def as_sound(self) -> float:
        """Logarithm of the marginal likelihood of a sound rig."""
        return float(logsumexp(self.sound))

    def judge(
        self, hypothesis: Hypothesis, as_sound: float, done: Float[np.ndarray, "parameters"] | None = None
    ) -> Judged:
        """Compare a hypothesis with a sound rig.

        Args:
            hypothesis: the hypothesis.
            as_sound: logarithm of the marginal likelihood of the sound rig.
            done: (parameters,), correction that the rig of these equations already has; None: none.
        """
        columns = list(hypothesis.columns)
        before = np.zeros_like(self.prior_std) if done is None else done
        left, right = self.equations[:, columns][:, :, columns], self.equations[:, columns, -1]
        found: list[tuple[float, np.ndarray, np.ndarray]] = []
        for factor in _PRIOR_FACTORS:
            std = factor * self.prior_std[columns]
            inner = np.eye(len(columns)) + std[:, None] * left * std
            pull = std * right - before[columns] / std
            inverse = np.linalg.inv(inner)
            solved = np.matvec(inverse, pull)
            log = np.vecdot(pull, solved) - np.sum((before[columns] / std) ** 2) - np.linalg.slogdet(inner)[1]
            found += zip(
                self.sound + log / 2, std * solved, std * np.sqrt(np.einsum("sii->si", inverse)), strict=True
            )
        logs = np.array([log for log, _, _ in found])
        step, std = before.copy(), np.zeros_like(before)
        _, change, std[columns] = found[int(logs.argmax())]
        step[columns] += change
        log_odds = float(logsumexp(logs)) - np.log(len(_PRIOR_FACTORS)) - as_sound
        return Judged(hypothesis, log_odds + hypothesis.log_prior, step, std)


def list_hypotheses(num_cameras: int, cameras: Sequence[int]) -> list[Hypothesis]:
    """All hypotheses about some cameras of a rig, and those about all of them together."""
    found = [
        Hypothesis(kind, camera, tuple(PER_CAMERA * camera + part for part in parts), log_prior)
        for camera in cameras
        for kind, (parts, log_prior) in _FAULTS.items()
    ]
    turns = tuple(column for one in found if one.kind == "turned" for column in one.columns)
    of_lenses = Hypothesis("focal lengths", -1, (PER_CAMERA * num_cameras,), _OF_ALL)
    return [*found, Hypothesis("several", -1, turns, _OF_ALL), of_lenses]


def gather(corrected: Corrected, data: WeightedPoints) -> Evidence:
    """Eliminate the points, and integrate the correlated errors out."""
    count, rest = len(corrected.rig), PER_CAMERA * len(corrected.rig) + 2
    products = _products(corrected, data)
    calibration_px = np.asarray(corrected.rig.cameras.image_size_wh)[:, 0] / 1920
    pieces = {size: _integrated(products, np.full(2 * count, size)) for size in _PIECE_ERRORS}
    equations, sound = [], []
    for of_piece, of_camera, pixels in product(_PIECE_ERRORS, _CAMERA_ERRORS, _CALIBRATION_PX):
        by_piece, log_pieces = pieces[of_piece]
        std = np.column_stack([np.full((count, 3), of_camera), np.tile(pixels * calibration_px[:, None], 3)])
        left, log = _integrated(by_piece.sum(axis=0), np.repeat(std, 2, axis=0).ravel())
        rare = (of_camera == _CAMERA_ERRORS[-1]) + (pixels == _CALIBRATION_PX[-1])
        sound.append(_RARE * rare - 0.5 * (left[-1, -1] + log_pieces.sum() + log))
        equations.append(left[-rest:, -rest:])
    distance_m = np.linalg.norm(data.position_m[:, None] - corrected.rig.cameras.centre_world, axis=-1)
    std = np.empty((count, PER_CAMERA))
    std[:, :3], std[:, 3:6] = np.deg2rad(_TURN_DEG), _WAY * np.median(distance_m, axis=0)[:, None]
    std[:, 6:] = _ZOOM, _LAG_FRAMES
    return Evidence(np.stack(equations), np.array(sound), np.append(std.ravel(), _ZOOM))


def _products(corrected: Corrected, data: WeightedPoints) -> Float[np.ndarray, "pieces columns columns"]:
    """Inner products of each piece's columns, points eliminated.

    The columns are an error of the piece for each camera and axis, six errors of each camera and axis for all bodies,
    the parameters, and the residuals.
    """
    points, cameras = data.points, corrected.rig.cameras
    slopes = linearise(corrected, points, data.position_m)
    weight = np.where(np.isfinite(slopes.residual_px).all(axis=-1), data.weight, 0.0)
    side_px = np.nan_to_num(points.side_px)[..., None]
    image = np.nan_to_num((points.centre_px - cameras.K[:, :2, 2]) / (cameras.image_size_wh / 2))
    over_image = np.concatenate([np.ones_like(side_px), image], axis=-1)
    columns = [
        _of_each(np.hypot(side_px, _SMALL_BOX_PX)),
        _of_each(np.concatenate([side_px * over_image, over_image], axis=-1)),
        slopes.by_parameter,
        np.nan_to_num(slopes.residual_px)[..., None],
    ]
    root = np.sqrt(weight)[..., None, None]
    J = (root * slopes.by_point).reshape(len(weight), -1, 3)
    design = (root * np.concatenate(columns, axis=-1)).reshape(*J.shape[:2], -1)
    Q, _ = np.linalg.qr(J)
    design -= Q @ (Q.swapaxes(-1, -2) @ design)
    pieces = [design[points.piece == piece] for piece in range(points.piece.max(initial=0) + 1)]
    return np.stack([np.tensordot(each, each, axes=((0, 1), (0, 1))) for each in pieces])


def _of_each(
    values: Float[np.ndarray, "points cameras terms"],
) -> Float[np.ndarray, "points cameras 2 columns"]:
    """Columns for each camera and axis, which are 0 for the other cameras and the other axis."""
    points, cameras, terms = values.shape
    columns = np.einsum("nct,cd,ij->ncidjt", values, np.eye(cameras), np.eye(2))
    return columns.reshape(points, cameras, 2, 2 * cameras * terms)


def _integrated(
    products: Float[np.ndarray, "*pieces columns columns"], std: Float[np.ndarray, "unknown"]
) -> tuple[Float[np.ndarray, "*pieces rest rest"], Float[np.ndarray, "*pieces"]]:
    """Integrate the first unknowns out: the other equations, and logarithms of determinants."""
    count = len(std)
    inner = np.eye(count) + std[:, None] * products[..., :count, :count] * std
    outer = std[:, None] * products[..., :count, count:]
    rest = products[..., count:, count:] - outer.swapaxes(-1, -2) @ np.linalg.solve(inner, outer)
    return rest, np.asarray(np.linalg.slogdet(inner)[1])


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
