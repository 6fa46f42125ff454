"""One drone from two sources: the arm between their points, a scale of each source's covariances, and the weights.

The two sources share no errors, so their difference contains no motion and has the sum of their variances. The weighted
mean of two positions with independent errors (Bar-Shalom et al. 2001, section 8.3.3) is right in every frame, however
long the errors of a source last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from psotrack.geometry import cross_matrices
from psotrack.inside_out.fusing.sources import CHI2_3_MEDIAN, GATE, Inside

#: Tracked point of a drone: the centre of its camera, or the middle of its silhouette.
Point = Literal["camera", "middle"]

#: Prior standard deviations of the logarithms of the variances. The differences determine only their sum; an outside
#: track may be of any program.
_PRIOR = np.array([1.0, 3.0])
#: Number of times that the arm, the variances, and the frames in which the sources agree are estimated in turn.
_ROUNDS = 3
#: Distance from the median, in median distances, beyond which a frame is left out of the arm.
_FAR = 4.0
#: Number of blocks of frames whose means show how certain the arm is, and the factor on its standard error: blocks are
#: few, and those of a flight of some seconds are correlated with each other.
_BLOCKS, _ERRORS = 6, 2.0
#: Smallest variance of a position, m2, and smallest factor on variances, for sources that never differ at all.
_LEAST_M2, _LEAST = 1e-10, 1e-6
#: Largest standard deviation of an orientation about an axis, radians: nothing is known.
_LARGEST_TURN_RAD = np.pi / 2

_Positions = Float[np.ndarray, "frames 3"]
_Covariances = Float[np.ndarray, "frames 3 3"]


@dataclass(frozen=True)
class Weighted:
    """A drone's position from both sources.

    Attributes:
        position_m, covariance_m2: (frames, 3), (frames, 3, 3), NaN where neither source knows the drone.
        known: (frames, 2), whether the inside and the outside were used.
        gross: (frames, 2), whether a source contradicts the other one and was not used.
        scale: (2,), standard deviation of the errors of each source divided by the stated one.
        arm_m, arm_std_m: (3,), from the camera's centre to the middle, in the camera's axes, and standard errors.
    """

    position_m: _Positions
    covariance_m2: _Covariances
    known: Bool[np.ndarray, "frames 2"]
    gross: Bool[np.ndarray, "frames 2"]
    scale: Float[np.ndarray, "2"]
    arm_m: Float[np.ndarray, "3"]
    arm_std_m: float

    def sources(self) -> dict[str, dict[str, float]]:
        """The scale of each source, and its number of frames with gross errors, fit for JSON."""
        pairs = zip(self.scale.tolist(), self.gross.sum(axis=0).tolist(), strict=True)
        words = ({"scale": scale, "gross_frames": frames} for scale, frames in pairs)
        return dict(zip(("inside", "outside"), words, strict=True))


def weigh(
    inside: Inside,
    middle_m: _Positions,
    middle_m2: _Covariances,
    point: Point,
) -> Weighted:
    """The weighted mean of a path and a track that have frames in common.

    Args:
        inside: the path at the frames.
        middle_m, middle_m2: (frames, 3), (frames, 3, 3), positions of the track and stated covariances; NaN where it is
            not tracked.
        point: tracked point of the result.
    """
    known = np.stack([np.isfinite(each).all(axis=1) for each in (inside.position_m, middle_m)], axis=1)
    both = np.asarray(known.all(axis=1))
    agree = both
    variances = np.array([max(inside.white, 1.0), 1.0])
    for _ in range(_ROUNDS):
        arm_m, arm_std_m, count = estimate_arm(inside, np.where(agree[:, None], middle_m, np.nan))
        arm_m2 = _arm_covariance_m2(inside, arm_m, arm_std_m)
        at_arm_m = np.matvec(inside.rotation, arm_m)
        apart_m = middle_m - inside.position_m - at_arm_m
        fixed_m2 = inside.at_variance_m2(0.0) + arm_m2
        stated_m2 = np.stack([inside.stated_m2, middle_m2], axis=1)
        sum_m2 = fixed_m2 + np.einsum("s,fsij->fij", variances, stated_m2)
        misfit = np.full(len(both), np.inf)
        misfit[both] = _misfit(apart_m[both], sum_m2[both])
        usual = max(float(np.median(misfit[agree])) / CHI2_3_MEDIAN, _LEAST)
        agree = misfit <= usual * GATE
        variances = _fit_variances(
            apart_m[agree], fixed_m2[agree], stated_m2[agree], count, usual * variances, inside.white
        )
    gross = _wrong_source(np.stack([inside.pose_m, middle_m], axis=1), both & ~agree)
    known &= ~gross
    # One of the two sources is moved along the arm, to the point that the other one tracks.
    moved = 1 if point == "camera" else 0
    parts_m = np.stack([inside.position_m, middle_m], axis=1)
    parts_m2 = np.stack([inside.at_variance_m2(variances[0]), variances[1] * middle_m2], axis=1)
    parts_m[:, moved] += -at_arm_m if point == "camera" else at_arm_m
    parts_m2[:, moved] += arm_m2
    used = known[..., None, None]
    weight = np.where(used, np.linalg.inv(np.where(used, parts_m2, np.eye(3))), 0.0)
    somewhere = np.asarray(known.any(axis=1))
    covariance_m2 = np.full_like(arm_m2, np.nan)
    covariance_m2[somewhere] = np.linalg.inv(weight[somewhere].sum(axis=1))
    gain = covariance_m2[:, None] @ weight
    position_m = np.matvec(gain, np.where(known[..., None], parts_m, 0.0)).sum(axis=1)
    # The error of the arm is the same in all frames, and its standard error itself is uncertain.
    covariance_m2 += (_ERRORS**2 - 1) * arm_std_m**2 * gain[:, moved] @ gain[:, moved].mT
    return Weighted(position_m, covariance_m2, known, gross, np.sqrt(variances), arm_m, arm_std_m)


def estimate_arm(inside: Inside, middle_m: _Positions) -> tuple[Float[np.ndarray, "3"], float, float]:
    """The arm from the camera's centre to the middle, its standard error, and the number of independent frames.

    The arm (3,), in the camera's axes, metres, is constant, because the camera is fixed to the body. It is the mean of
    the arms near their median, which a minority of gross errors moves little. Errors of neighbouring frames are
    correlated, so that the standard error along an axis is that of the means of a few blocks of frames.

    Args:
        inside: the path at the frames.
        middle_m: (frames, 3), middle of the silhouette; NaN where unknown.
    """
    arms_m = np.matvec(inside.rotation.mT, middle_m - inside.position_m)
    arms_m = arms_m[np.isfinite(arms_m).all(axis=1)]
    if not len(arms_m):
        return np.zeros(3), 0.0, 0.0
    away_m = np.linalg.norm(arms_m - np.median(arms_m, axis=0), axis=1)
    arms_m = arms_m[away_m <= _FAR * np.median(away_m) + np.sqrt(_LEAST_M2)]
    arm_m = arms_m.mean(axis=0)
    if len(arms_m) < _BLOCKS:
        return arm_m, float(np.linalg.norm(arm_m)), 1.0
    means_m = [block.mean(axis=0) for block in np.array_split(arms_m, _BLOCKS)]
    variance_m2 = float(np.var(means_m, axis=0, ddof=1).mean()) / _BLOCKS + _LEAST_M2
    count = arms_m.var(axis=0).mean() / variance_m2 / _ERRORS**2
    return arm_m, float(np.sqrt(variance_m2)), max(float(count), 1.0)


def _arm_covariance_m2(inside: Inside, arm_m: Float[np.ndarray, "3"], arm_std_m: float) -> _Covariances:
    """(frames, 3, 3), covariance of the arm's end, world, m²."""
    by_turn = (
        np.minimum(inside.turn_rad, _LARGEST_TURN_RAD)[:, None, None]
        * inside.rotation
        @ cross_matrices(arm_m)
    )
    return by_turn @ by_turn.mT + (arm_std_m**2 + _LEAST_M2) * np.eye(3)


def _fit_variances(
    apart_m: _Positions,
    fixed_m2: _Covariances,
    stated_m2: Float[np.ndarray, "frames 2 3 3"],
    count: float,
    start: Float[np.ndarray, "2"],
    white: float,
) -> Float[np.ndarray, "2"]:
    """(2,), factors on the stated variances of both sources, of the highest posterior density given the differences."""
    # The differences are without the mean arm, which takes a part of the variance.
    independent, lost = count / len(apart_m), count / max(count - 1, 0.5)

    # What a path does not state of its errors is taken to be half white noise and half correlated.
    expected = np.log([max(1.0, 2 * white - 1), 1.0])

    def cost(logs: Float[np.ndarray, "2"]) -> float:
        sum_m2 = fixed_m2 + np.einsum("s,fsij->fij", np.exp(logs), stated_m2)
        misfit = lost * _misfit(apart_m, sum_m2) + np.linalg.slogdet(sum_m2)[1]
        prior = (((logs - expected) / _PRIOR) ** 2).sum()
        return float(independent * misfit.sum() + prior) / 2

    least = np.log([max(white, _LEAST), _LEAST])
    bounds = [(low, low + 40.0) for low in least]
    return np.exp(minimize(cost, np.maximum(np.log(start), least), method="L-BFGS-B", bounds=bounds).x)


def _wrong_source(
    positions_m: Float[np.ndarray, "frames 2 3"], contradict: Bool[np.ndarray, "frames"]
) -> Bool[np.ndarray, "frames 2"]:
    """(frames, 2), which source is wrong where two contradict each other: the one with the larger jump in the run.

    A jump is a second difference of unsmoothed positions, up to one frame outside of the run.
    """
    jump_m = np.zeros(positions_m.shape[:2])
    jump_m[1:-1] = np.nan_to_num(np.linalg.norm(np.diff(positions_m, n=2, axis=0), axis=2))
    wrong = np.zeros(jump_m.shape, bool)
    ends = np.flatnonzero(np.diff(np.pad(contradict, 1).astype(int)))
    for first, last in zip(ends[::2], ends[1::2], strict=True):
        wrong[first:last, jump_m[max(first - 1, 0) : last + 1].max(axis=0).argmax()] = True
    return wrong


def _misfit(
    vectors: Float[np.ndarray, "rows 3"], covariance: Float[np.ndarray, "rows 3 3"]
) -> Float[np.ndarray, "rows"]:
    """Squared lengths of vectors, normalised by their covariances."""
    return np.vecdot(vectors, np.linalg.solve(covariance, vectors[..., None])[..., 0])
