"""The filter of one camera's motion: `motion` at several levels of agility, and what they tell together.

Nobody knows how wildly a drone flies. So the same filter runs as if it hovered, flew and raced, and levels count by
how well they foretold the poses of late (multiple models: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 11.6). Nor does anybody know how good poses are: where
innovations keep being smaller or larger than covariances of poses say, these are scaled (R. K. Mehra, Approaches to
adaptive filtering, IEEE Transactions on Automatic Control 17(5), 1972).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from psotrack.errors import InputError
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.motion import POSE, Innovation, Levels, Motion
from psotrack.inside_out.filtering.records import MeasuredPose, PoseEstimate, PoseFilterParams

#: Accelerations (m/s2, along each axis) and changes of the turn rate within a second (rad/s, about each axis) that are
#: tried, each with each: hovering, flying, racing.
_ACCELERATION_STD_M_S2 = np.array([0.5, 5.0, 50.0])
_RATE_CHANGE_STD_RAD_S = np.array([0.1, 1.0, 10.0])
LEVELS = Levels(
    np.repeat(2 * _ACCELERATION_STD_M_S2**2 / pose_motion.ACCELERATION_TIME_S, 3),
    np.tile(_RATE_CHANGE_STD_RAD_S**2, 3),
)
#: Most cameras hover or fly, and few race: how much the levels of each count at first.
_FIRST_WEIGHT = np.array([0.7, 0.25, 0.05])
_FIRST_LOG_WEIGHT = np.log(np.outer(_FIRST_WEIGHT, _FIRST_WEIGHT).ravel())
#: How well levels did is forgotten: after so long 1 / e of it is left. None counts less than so much: it may be right
#: in the next frame.
_MEMORY_S = 1.0
_LEAST_WEIGHT = 1e-3
#: Levels that count for less may be right in a frame to come, but say nothing of where the camera is.
_TOLD_WEIGHT = 0.01
#: Levels are judged by a Student distribution of so many degrees of freedom: a single wild pose does not make a
#: hovering camera race.
_FREEDOM = 4.0
#: Covariances of poses are scaled by at most so much up or down, by the frames of about so long, and with so many
#: squares' worth of faith in them as they are: two frames.
_MOST_SCALED = 4.0
_NOISE_MEMORY_S = 5.0
_NOISE_FAITH = 12.0
#: An innovation's share in this counts up to as much as that of 1 pose in 100,000; outliers are no noise.
_MOST_POWER = 30.0
#: How far off the wrong one of two poses is apt to be: along each axis, m, and about each, rad.
_OTHER_POSE_STD = 1.0


@dataclass(frozen=True)
class PoseState:
    """What is known of a camera at a time.

    Attributes:
        time_s: the time.
        motion: at every level.
        log_weight: (levels,), logarithms of how much each counts.
        seen_s: time of the last pose that fitted.
        support: poses that fitted.
        log_density: with which the last of them was foretold, but for a constant; its covariance is that of all levels.
        ambiguity: probability that all of them are of another camera pose that looks the same.
        doubt: probability at most that the surest of them is wrong, by itself.
        noise_power, noise_faith: squares that the noise of poses had of late, and should have had.
    """

    time_s: float
    motion: Motion
    log_weight: Float[np.ndarray, "levels"]
    seen_s: float
    support: int
    log_density: float
    ambiguity: float
    doubt: float
    noise_power: float = _NOISE_FAITH
    noise_faith: float = _NOISE_FAITH

    @property
    def noise_scale(self) -> float:
        """What covariances of measured poses are multiplied with."""
        return min(max(self.noise_power / self.noise_faith, 1 / _MOST_SCALED), _MOST_SCALED)


def init(measurement: MeasuredPose) -> PoseState:
    """What is known after one pose.

    Raises:
        InputError: its covariance is not positive definite.
    """
    _check(measurement)
    motion = pose_motion.initial_motion(
        measurement.position_m,
        measurement.orientation_wxyz,
        measurement.covariance,
        measurement.common,
        LEVELS,
    )
    return PoseState(
        time_s=measurement.time_s,
        motion=motion,
        log_weight=_FIRST_LOG_WEIGHT,
        seen_s=measurement.time_s,
        support=1,
        log_density=-np.inf,
        ambiguity=measurement.ambiguity,
        doubt=measurement.doubt,
    )


def predict(state: PoseState, time_s: float) -> PoseState:
    """What is known of a later time without a look at it.

    Raises:
        InputError: the time is before the state's.
    """
    if time_s == state.time_s:
        return state
    if not time_s > state.time_s:
        raise InputError("time_s", expected=f"a time after {state.time_s:g} s", found=f"{time_s:g} s")
    motion, _ = pose_motion.predict(state.motion, time_s - state.time_s, LEVELS)
    return replace(state, time_s=time_s, motion=motion)


def update(state: PoseState, measurement: MeasuredPose, params: PoseFilterParams) -> tuple[PoseState, bool]:
    """What is known after a pose, and whether it was gated, which leaves the state as predicted.

    It is gated where its squared Mahalanobis distance from what all levels together foretold is beyond what chi-square
    with 6 degrees of freedom exceeds with the probability `false_alarm`. An ambiguous pose counts by the probability
    that it is the right one, given how well it fits.

    Raises:
        InputError: the measurement is before the state, or its covariance is not positive definite.
    """
    _check(measurement)
    state = predict(state, measurement.time_s)
    covariance = state.noise_scale * measurement.covariance
    told = pose_motion.innovation(
        state.motion, measurement.position_m, measurement.orientation_wxyz, covariance, measurement.common
    )
    off, spread = _merged(_weights(state), told.pose, told.whole_covariance)
    precision = np.linalg.inv(spread)
    whitened = precision @ off
    nis = float(off @ whitened)
    if nis > chdtri(6, params.false_alarm):
        return state, True
    right = right_pose(off, spread, measurement.ambiguity)
    since_s = measurement.time_s - state.seen_s
    log_weight = np.exp(-since_s / _MEMORY_S) * state.log_weight + right * _log_densities(told)
    log_weight = np.maximum(_normalised(log_weight), np.log(_LEAST_WEIGHT))
    kept = float(np.exp(-since_s / _NOISE_MEMORY_S))
    # The noise's part of the innovation's squares, by what it should be (the maximum likelihood of a scale).
    power = state.noise_scale * min(float(whitened @ covariance @ whitened), _MOST_POWER)
    return PoseState(
        time_s=measurement.time_s,
        motion=pose_motion.correct(state.motion, told, right),
        log_weight=_normalised(log_weight),
        seen_s=measurement.time_s,
        support=state.support + 1,
        log_density=-(nis + float(np.linalg.slogdet(spread)[1])) / 2,
        ambiguity=min(state.ambiguity, measurement.ambiguity),
        doubt=min(state.doubt, measurement.doubt),
        noise_power=_NOISE_FAITH + kept * (state.noise_power - _NOISE_FAITH) + power,
        noise_faith=_NOISE_FAITH
        + kept * (state.noise_faith - _NOISE_FAITH)
        + float((precision * covariance).sum()),
    ), False


def estimate(state: PoseState) -> PoseEstimate:
    """The pose that all levels together tell, and its covariance: theirs, and how far they are apart."""
    weight = _weights(state)
    best = pose_motion.level_of(state.motion, int(weight.argmax()))
    apart = pose_motion.difference(best, state.motion)
    change, covariance = _merged(weight, apart, state.motion.covariance)
    middle = pose_motion.shift(best, change[None])
    common = np.tensordot(weight, state.motion.common[:, POSE], axes=1)
    return PoseEstimate(
        position_m=middle.position_m[0],
        orientation_wxyz=middle.orientation_wxyz[0],
        covariance=covariance[np.ix_(POSE, POSE)] + common @ common.T,
        velocity_m_s=middle.velocity_m_s[0],
    )


def open_minded(state: PoseState) -> PoseState:
    """The state as if any level might be right from now on."""
    return replace(state, log_weight=np.full_like(state.log_weight, -np.log(len(state.log_weight))))


def right_pose(off: Float[np.ndarray, "6"], spread: Float[np.ndarray, "6 6"], ambiguity: float) -> float:
    """Probability that an ambiguous pose is the right one, now that it is known how well it fits the motion.

    Bayes' rule: the wrong one would fit as if it were somewhere within a metre and a radian.

    Args:
        off: (6,), how far it is off what was foretold.
        spread: (6, 6), covariance of that.
        ambiguity: probability before.
    """
    if ambiguity == 0:
        return 1.0
    wide = spread + _OTHER_POSE_STD**2 * np.eye(6)
    fits, other = (
        -(off @ np.linalg.solve(matrix, off) + np.linalg.slogdet(matrix)[1]) / 2 for matrix in (spread, wide)
    )
    return float(1 / (1 + ambiguity / (1 - ambiguity) * np.exp(other - fits)))


def _weights(state: PoseState) -> Float[np.ndarray, "levels"]:
    """How much each level counts, of those that count."""
    weight = np.exp(state.log_weight)
    weight = np.where(weight < _TOLD_WEIGHT, 0.0, weight)
    return weight / weight.sum()


def _merged(
    weight: Float[np.ndarray, "levels"],
    mean: Float[np.ndarray, "levels n"],
    covariance: Float[np.ndarray, "levels n n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Mean and covariance of a mixture."""
    middle = weight @ mean
    apart = mean - middle
    return middle, np.tensordot(weight, covariance, axes=1) + (apart.T * weight) @ apart


def _normalised(log_weight: Float[np.ndarray, "levels"]) -> Float[np.ndarray, "levels"]:
    log_weight = log_weight - log_weight.max()
    return log_weight - np.log(np.exp(log_weight).sum())


def _log_densities(told: Innovation) -> Float[np.ndarray, "levels"]:
    """Logarithms of the densities with which the levels foretold a measurement, but for a constant."""
    covariance = told.whole_covariance
    nis = np.einsum("li,lij,lj->l", told.pose, np.linalg.inv(covariance), told.pose)
    return -((_FREEDOM + 6) * np.log1p(nis / _FREEDOM) + np.linalg.slogdet(covariance)[1]) / 2


def _check(measurement: MeasuredPose) -> None:
    """Raise `InputError` unless a measurement has a positive definite covariance."""
    covariance = measurement.covariance
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        raise InputError(
            f"covariance at {measurement.time_s:g} s",
            expected="a positive definite matrix",
            found="another",
        )
