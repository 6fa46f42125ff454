"""Evidence for faults: how well each hypothesis predicts the sightings, given what boxes do even for a sound rig.

The middle of a box is off the body's projection by an error with several parts. One part differs from frame to frame.
The others last, because the middle of the outline is not the same point of the body for two cameras: a part for each
piece of a path, and a part that a camera has in common for all bodies and changes slowly over the image. Both are
normal with standard deviations in units of the box's side, which are not known: compact lopsided bodies have errors
of a tenth of the side, flat drones of a hundredth. A sound calibration has a small error, too.

The points, the lasting errors and the sizes of the errors are integrated out (points: flat prior; sizes: a grid), so
that hypotheses compare by their marginal likelihoods (R. Kass & A. Raftery, Bayes factors, J. American Statistical
Association 90, 1995). A fault of one camera is taken only if the other cameras agree better than lasting errors of the
needed size would let them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from psotrack.calibration.doctor.common_points import CommonPoints
from psotrack.calibration.doctor.hypotheses import LOG_PRIOR, Corrected, Hypothesis, linearise, prior_std
from psotrack.geometry import Rig
from psotrack.geometry.estimation import cauchy_weight

#: Sizes that are tried of the lasting errors, as shares of a box's side: of each piece, and of each camera.
_PIECE_SHARES = (0.01, 0.02, 0.04, 0.08)
_CAMERA_SHARES = (0.007, 0.02, 0.05, 0.12)
#: Sizes that are tried of a sound calibration's errors, pixels in an image of 1920 columns.
_CALIBRATION_PX = (0.2, 0.5, 1.0)
_SIZES = list(product(_PIECE_SHARES, _CAMERA_SHARES, _CALIBRATION_PX))
#: Logarithm of the prior probability of each size: bodies that are so lopsided, and calibrations so poor, are rare.
_RARE = 3.0
_LOG_SIZES = np.array([-_RARE * ((of_camera > 0.1) + (pixels > 0.7)) for _, of_camera, pixels in _SIZES])
#: Sizes whose likelihood is smaller than the largest by more than this logarithm are not tried again.
_UNLIKELY = 12.0
#: Smallest standard deviation of the error of a piece, pixels.
_PIECE_PX = 0.3
#: First assumption of the noise from frame to frame: pixels, and share of a box's side.
_NOISE_PX, _NOISE_SHARE = 0.5, 0.02
#: Standard deviation of the error of a piece when outliers are searched, as a share of the side, and number of rounds.
_LOOSE_SHARE, _ROUNDS = 0.5, 6
#: A sighting at this number of standard deviations from its piece has a weight of 1/4.
_OUTLIER_STD = 3.0
#: Factors of the standard deviations of the parameters' prior distribution, all as likely.
_PRIOR_FACTORS = (0.1, 0.3, 1.0, 3.0)
#: Median of the length of a vector whose components have a standard deviation of 1 (Rayleigh distribution).
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True)
class PieceEquations:
    """Normal equations of each piece, points eliminated.

    The columns are the errors of the piece, the errors that a camera has in common, the parameters, and the right side.

    Attributes:
        products: (pieces, columns, columns), inner products of the columns.
        local_px: (pieces, locals), mean side of the boxes to which each error of a piece belongs, pixels.
    """

    products: Float[np.ndarray, "pieces columns columns"]
    local_px: Float[np.ndarray, "pieces locals"]


@dataclass(frozen=True)
class Judged:
    """A hypothesis and how well it explains the sightings.

    Attributes:
        hypothesis: the possible fault.
        evidence: logarithm of its marginal likelihood relative to that of a sound rig.
        step: (parameters,), the most likely change of the correction; 0 for all other parameters.
        std: (parameters,), standard deviations of the correction; 0 for all other parameters.
        sizes: sizes of the lasting errors with which it is most likely.
        likely: indices of all sizes that are not unlikely.
    """

    hypothesis: Hypothesis
    evidence: float
    step: Float[np.ndarray, "parameters"]
    std: Float[np.ndarray, "parameters"]
    sizes: tuple[float, float, float]
    likely: tuple[int, ...]


@dataclass(frozen=True)
class WeightedPoints:
    """Sightings with weights.

    Attributes:
        points: the points.
        position_m: (points, 3), positions, metres.
        weight: (points, cameras), inverse variances, 1 / px²; 0 for no sighting and for outliers.
    """

    points: CommonPoints
    position_m: Float[np.ndarray, "points 3"]
    weight: Float[np.ndarray, "points cameras"]


def weigh(corrected: Corrected, points: CommonPoints) -> WeightedPoints:
    """Weights of the sightings: outliers are far from where the same piece is otherwise seen by the same camera.

    A lasting error of a piece costs nothing here, so that faults do not make outliers.
    """
    seen, num_cameras = points.seen, len(corrected.rig)
    sigma = np.where(seen, _NOISE_PX + _NOISE_SHARE * np.nan_to_num(points.side_px), 1.0)
    weight, position_m, scale = seen / sigma**2, points.start_m, np.ones(num_cameras)
    for _ in range(_ROUNDS):
        slopes = linearise(corrected, position_m, points.velocity_m, points.centre_px, points.offset_frames)
        there = np.isfinite(slopes.off_px).all(axis=-1)
        weight = np.where(there, weight, 0.0)
        left_px, step_m = _local_fit(points, slopes.off_px, slopes.by_point, weight)
        position_m = position_m + step_m
        distance = np.linalg.norm(left_px, axis=-1) / sigma
        for camera in range(num_cameras):
            of = there[:, camera]
            if of.any():
                scale[camera] = max(float(np.median(distance[of, camera])) / _RAYLEIGH_MEDIAN, 0.1)
        # The fit has three unknowns per point, and follows the noise.
        freedom = 1 - 1.5 / np.maximum((weight > 0).sum(axis=1, keepdims=True), 2)
        std = scale * sigma / np.sqrt(freedom)
        robust = cauchy_weight((distance * sigma / std / _OUTLIER_STD) ** 2) ** 2
        weight = np.where(there, np.where(robust > 0.02, robust, 0.0) * points.information / std**2, 0.0)
        enough = (weight > 0).sum(axis=1, keepdims=True) >= 3
        weight = np.where(enough, weight, 0.0)
    return WeightedPoints(points, position_m, weight)


def _local_fit(
    points: CommonPoints,
    off_px: Float[np.ndarray, "points cameras 2"],
    by_point: Float[np.ndarray, "points cameras 2 3"],
    weight: Float[np.ndarray, "points cameras"],
) -> tuple[Float[np.ndarray, "points cameras 2"], Float[np.ndarray, "points 3"]]:
    """Residuals of a fit in which each camera has an own error for each piece, and the steps of the points."""
    num_cameras = weight.shape[1]
    left_px, step_m = np.zeros_like(off_px), np.zeros((len(off_px), 3))
    for piece in range(len(points.run)):
        rows = np.flatnonzero(points.piece == piece)
        e, J, w = np.nan_to_num(off_px[rows]), by_point[rows], weight[rows]
        bias = np.zeros((num_cameras, 2))
        stiff = 1 / (_LOOSE_SHARE * float(np.nanmean(points.side_px[rows])) + 1.0) ** 2
        normal = np.einsum("pc,pcik,pcil->pkl", w, J, J)
        normal += 1e-9 * np.trace(normal, axis1=-2, axis2=-1)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        inverse = np.linalg.inv(normal)
        for _ in range(15):
            step = np.einsum("pkl,pc,pcil,pci->pk", inverse, w, J, e - bias)
            left = e - (J @ step[:, None, :, None])[..., 0]
            bias = np.einsum("pc,pci->ci", w, left) / (w.sum(axis=0)[:, None] + stiff)
        step_m[rows], left_px[rows] = step, left - bias
    return left_px, step_m


def sum_up(corrected: Corrected, data: WeightedPoints) -> PieceEquations:
    """Normal equations of each piece at a corrected rig."""
    points, weight = data.points, data.weight
    rig, num_cameras = corrected.rig, weight.shape[1]
    slopes = linearise(corrected, data.position_m, points.velocity_m, points.centre_px, points.offset_frames)
    weight = np.where(np.isfinite(slopes.off_px).all(axis=-1), weight, 0.0)
    side_px = np.where(weight > 0, np.nan_to_num(points.side_px), 0.0)
    image = np.nan_to_num((points.centre_px - rig.cameras.K[:, :2, 2]) / (rig.cameras.image_size_wh / 2))
    over_image = np.concatenate([np.ones_like(side_px)[..., None], image], axis=-1)
    num_parameters = slopes.by_parameter.shape[-1]
    local, common = 2 * num_cameras, 12 * num_cameras
    columns = local + common + num_parameters + 1
    pieces = len(points.run)
    products, local_px = np.zeros((pieces, columns, columns)), np.ones((pieces, local))
    for piece in range(pieces):
        rows = np.flatnonzero((points.piece == piece) & (weight > 0).any(axis=1))
        if not len(rows):
            continue
        design = np.zeros((len(rows), num_cameras, 2, columns))
        for camera in range(num_cameras):
            side = side_px[rows, camera]
            mean = float(side.sum() / max((side > 0).sum(), 1)) or 1.0
            local_px[piece, 2 * camera : 2 * camera + 2] = mean
            for axis in range(2):
                design[:, camera, axis, 2 * camera + axis] = side / mean
                for part in range(3):
                    at = local + 12 * camera + 6 * axis + 2 * part
                    design[:, camera, axis, at] = side * over_image[rows, camera, part]
                    design[:, camera, axis, at + 1] = over_image[rows, camera, part]
        design[..., local + common : -1] = slopes.by_parameter[rows]
        design[..., -1] = np.nan_to_num(slopes.off_px[rows])
        root = np.sqrt(weight[rows])[..., None, None]
        J = (root * slopes.by_point[rows]).reshape(len(rows), -1, 3)
        D = (root * design).reshape(len(rows), -1, columns)
        Q, _ = np.linalg.qr(J)
        D = D - Q @ (Q.swapaxes(-1, -2) @ D)
        D = D.reshape(-1, columns)
        products[piece] = D.T @ D
    return PieceEquations(products, local_px)


def without_local(
    sums: PieceEquations, piece_share: float
) -> tuple[Float[np.ndarray, "pieces rest rest"], Float[np.ndarray, "pieces"]]:
    """Normal equations of each piece with the local errors integrated out, and logarithms of the determinants."""
    count = sums.local_px.shape[1]
    variance = (piece_share * sums.local_px) ** 2 + _PIECE_PX**2
    root = np.sqrt(variance)
    inner = np.eye(count) + root[:, :, None] * sums.products[:, :count, :count] * root[:, None, :]
    outer = root[:, :, None] * sums.products[:, :count, count:]
    rest = sums.products[:, count:, count:] - outer.swapaxes(-1, -2) @ np.linalg.solve(inner, outer)
    return rest, np.linalg.slogdet(inner)[1]


def nuisance_std(rig: Rig, camera_share: float, calibration: float) -> Float[np.ndarray, "nuisance"]:
    """Standard deviations of the errors that a camera has in common for all bodies."""
    calibration_px = calibration * np.asarray(rig.cameras.image_size_wh)[:, 0] / 1920
    pairs = np.stack([np.full(len(rig), camera_share), calibration_px], axis=-1)
    return np.tile(pairs, (1, 6)).ravel()


@dataclass(frozen=True)
class Evidence:
    """Normal equations of the parameters at one rig for each size of lasting errors, other unknowns integrated out.

    Attributes:
        sizes: (sizes,), indices of the sizes.
        rest: (sizes, parameters + 1, parameters + 1), left side, and the right side as last row and column.
        sound: (sizes,), logarithm of the marginal likelihood if all parameters are 0.
        std: (parameters,), standard deviations of the parameters' prior distribution.
    """

    sizes: tuple[int, ...]
    rest: Float[np.ndarray, "sizes rest rest"]
    sound: Float[np.ndarray, "sizes"]
    std: Float[np.ndarray, "parameters"]

    @property
    def as_sound(self) -> float:
        """Logarithm of the marginal likelihood if all parameters are 0."""
        return float(logsumexp(self.sound))

    def judge(
        self, hypothesis: Hypothesis, as_sound: float, done: Float[np.ndarray, "parameters"] | None = None
    ) -> Judged:
        """Evidence for a hypothesis relative to that of a sound rig.

        Args:
            hypothesis: the hypothesis.
            as_sound: logarithm of the marginal likelihood of the sound rig.
            done: (parameters,), correction that the rig already has; None: none.
        """
        columns = list(hypothesis.columns)
        before = np.zeros(len(columns)) if done is None else done[columns]
        found = [_gain(self.rest, columns, factor * self.std[columns], before) for factor in _PRIOR_FACTORS]
        logs = self.sound + np.stack([gain for gain, _, _ in found])
        factor, size = np.unravel_index(logs.argmax(), logs.shape)
        step, std = np.zeros((2, len(self.std)))
        step[columns], std[columns] = found[factor][1][size], found[factor][2][size]
        evidence = float(logsumexp(logs)) - np.log(len(_PRIOR_FACTORS)) - as_sound
        evidence += LOG_PRIOR.get(hypothesis.kind, 0.0)
        best = logs.max(axis=0)
        likely = tuple(np.array(self.sizes)[best > best.max() - _UNLIKELY].tolist())
        return Judged(hypothesis, evidence, step, std, _SIZES[self.sizes[size]], likely)


def gather(
    rig: Rig,
    sums: PieceEquations,
    std: Float[np.ndarray, "parameters"],
    free: Sequence[int] = (),
    sizes: Sequence[int] = range(len(_SIZES)),
) -> Evidence:
    """Integrate the lasting errors out, and parameters that are free.

    Args:
        rig: the rig.
        sums: normal equations at this rig.
        std: (parameters,), standard deviations of the parameters' prior distribution.
        free: indices of parameters that are unknown under every hypothesis.
        sizes: indices of the sizes of lasting errors that are tried.
    """
    rests, sound = [], []
    tried = [_SIZES[size] for size in sizes]
    pieces = {share: without_local(sums, share) for share in {share for share, *_ in tried}}
    totals = {share: (reduced.sum(axis=0), log.sum()) for share, (reduced, log) in pieces.items()}
    for piece_share, *of_camera in tried:
        reduced, log_of_pieces = totals[piece_share]
        total, nuisance = arranged(reduced, nuisance_std(rig, *of_camera), std, free)
        rest, log_det = _without_nuisance(total, nuisance)
        # A free parameter has no slope left.
        for column in sorted(free):
            rest = np.insert(np.insert(rest, column, 0.0, axis=0), column, 0.0, axis=1)
        rests.append(rest)
        sound.append(-0.5 * (rest[-1, -1] + log_of_pieces + log_det))
    return Evidence(tuple(sizes), np.stack(rests), np.array(sound) + _LOG_SIZES[list(sizes)], std)


def arranged(
    total: Float[np.ndarray, "*pieces columns columns"],
    nuisance: Float[np.ndarray, "nuisance"],
    std: Float[np.ndarray, "parameters"],
    free: Sequence[int],
) -> tuple[Float[np.ndarray, "*pieces columns columns"], Float[np.ndarray, "unknown"]]:
    """Normal equations with the free parameters behind the lasting errors, and standard deviations of both."""
    first = len(nuisance)
    chosen = [first + column for column in sorted(free)]
    rest = [column for column in range(first, total.shape[-1]) if column not in chosen]
    order = [*range(first), *chosen, *rest]
    # A free parameter has been found to be off, so its prior distribution is wide.
    return total[..., order, :][..., order], np.append(nuisance, 3 * std[sorted(free)])


def _without_nuisance(
    total: Float[np.ndarray, "columns columns"], std: Float[np.ndarray, "nuisance"]
) -> tuple[Float[np.ndarray, "rest rest"], float]:
    count = len(std)
    inner = np.eye(count) + std[:, None] * total[:count, :count] * std
    outer = std[:, None] * total[:count, count:]
    rest = total[count:, count:] - outer.T @ np.linalg.solve(inner, outer)
    return rest, float(np.linalg.slogdet(inner)[1])


def _gain(
    rest: Float[np.ndarray, "sizes columns columns"],
    columns: list[int],
    std: Float[np.ndarray, "chosen"],
    before: Float[np.ndarray, "chosen"],
) -> tuple[Float[np.ndarray, "sizes"], Float[np.ndarray, "sizes chosen"], Float[np.ndarray, "sizes chosen"]]:
    """Gain of evidence by parameters, their most likely change from what they are, and its standard deviation."""
    inner = np.eye(len(columns)) + std[:, None] * rest[:, columns][:, :, columns] * std
    right = std * rest[:, columns, -1] - before / std
    inverse = np.linalg.inv(inner)
    solved = (inverse @ right[..., None])[..., 0]
    log = (right * solved).sum(axis=-1) - np.sum((before / std) ** 2) - np.linalg.slogdet(inner)[1]
    return 0.5 * log, std * solved, std * np.sqrt(np.einsum("sii->si", inverse))


def prior_of(rig: Rig, data: WeightedPoints) -> Float[np.ndarray, "parameters"]:
    """Standard deviations of all parameters' prior distribution."""
    distance_m = np.linalg.norm(data.position_m[:, None] - rig.cameras.centre_world, axis=-1)
    return prior_std(len(rig), np.median(distance_m, axis=0))
