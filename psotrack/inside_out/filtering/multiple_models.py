"""Multiple-model filter of one camera's motion: the Kalman filter of `motion` at several levels of agility together.

How wildly a drone flies is not known. The same filter therefore runs with the process noise of hovering, flying and
racing, and each level is weighted by how well it predicted the recent poses (multiple models: Y. Bar-Shalom, X. R. Li,
T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 11.6). How good the poses are is
not known either: where innovations are smaller or larger than the covariances of the poses say, these covariances are
scaled (R. K. Mehra, Approaches to adaptive filtering, IEEE Transactions on Automatic Control 17(5), 1972).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from psotrack.errors import InputError
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.motion import ACCELERATION, MOTION, POSE, Innovation, Levels, Motion
from psotrack.inside_out.filtering.records import MeasuredPose, PoseEstimate, PoseFilterParams

#: Standard deviations of the levels for hovering, flying and racing: of acceleration along each axis (m/s2), and of
#: the change of the turn rate within a second about each axis (rad/s). All pairs of the two are levels.
_ACCELERATION_STD_M_S2 = np.array([0.5, 5.0, 50.0])
_RATE_CHANGE_STD_RAD_S = np.array([0.1, 1.0, 10.0])
LEVELS = Levels(
    np.repeat(2 * _ACCELERATION_STD_M_S2**2 / pose_motion.ACCELERATION_TIME_S, 3),
    np.tile(_RATE_CHANGE_STD_RAD_S**2, 3),
)
#: Initial weights for hovering, flying and racing: most cameras hover or fly, few race.
_FIRST_WEIGHT = np.array([0.7, 0.25, 0.05])
_FIRST_LOG_WEIGHT = np.log(np.outer(_FIRST_WEIGHT, _FIRST_WEIGHT).ravel())
#: Time after which the influence of a prediction on a level's weight has fallen to 1 / e, seconds; and the smallest
#: weight of a level, because a level that was wrong so far may be right in the next frame.
_MEMORY_S = 1.0
_LEAST_WEIGHT = 1e-3
#: Smallest weight of a level that takes part in the estimate.
_ESTIMATE_WEIGHT = 0.01
#: Degrees of freedom of the Student distribution that weighs levels: heavy tails, so that a single wild pose does not
#: make a hovering camera race.
_FREEDOM = 4.0
#: Covariances of poses are scaled up or down by at most this factor; by the frames of about this time, seconds; and
#: against a prior for their stated values that weighs as much as this number of squares, which is two frames.
_MOST_SCALED = 4.0
_NOISE_MEMORY_S = 5.0
_NOISE_PRIOR = 12.0
#: Weight of the levels' expectation of the turn rate's corrections, as a number of squares: those of two frames.
_WOBBLE_PRIOR = 6.0
#: Largest squared innovation that scales covariances; at most 4 good poses in 100,000 are larger, and outliers are not
#: noise.
_LARGEST_SQUARE = 30.0
#: Standard deviation of the wrong one of two poses from the right one, along each axis (m) and about each axis (rad).
_OTHER_POSE_STD = 1.0


@dataclass(frozen=True)
class PoseState:
    """State of the filter at one time.

    Attributes:
        time_s: time of the state, seconds.
        motion: motion and covariance at every level.
        log_weight: (levels,), logarithms of the levels' weights.
        seen_s: time of the last pose that fitted, seconds.
        support: number of poses that fitted.
        log_density: log density of the last of these poses, as all levels together predicted it, without its constant.
        ambiguity: probability that all these poses belong to another camera pose that looks the same.
        p_wrong: upper bound on the probability that the surest of these poses is wrong, from its frame alone.
        noise_observed, noise_expected: weighted sums, over recent poses, of the squares of their noise as observed and
            as their covariances say.
        wobble_observed, wobble_expected: weighted sums, over recent poses, of the squares by which poses corrected the
            turn rate, as observed and as the levels let expect.
    """

    time_s: float
    motion: Motion
    log_weight: Float[np.ndarray, "levels"]
    seen_s: float
    support: int
    log_density: float
    ambiguity: float
    p_wrong: float
    noise_observed: float = _NOISE_PRIOR
    noise_expected: float = _NOISE_PRIOR
    wobble_observed: float = _WOBBLE_PRIOR
    wobble_expected: float = _WOBBLE_PRIOR

    @property
    def noise_scale(self) -> float:
        """Factor by which covariances of measured poses are multiplied."""
        return min(max(self.noise_observed / self.noise_expected, 1 / _MOST_SCALED), _MOST_SCALED)

    @property
    def wobble_density_rad2_s3(self) -> float:
        """Power spectral density of the angular acceleration about each axis.

        The levels are far apart. A level that expects twice the squared corrections of the turn rate that are observed
        assumes about twice the density.
        """
        of_levels = np.exp(_weights(self) @ np.log(LEVELS.wobble_density_rad2_s3))
        return float(of_levels * self.wobble_observed / self.wobble_expected)


def init(measurement: MeasuredPose) -> PoseState:
    """The state after the first pose.

    Raises:
        InputError: the pose's covariance is not positive definite.
    """
    _check(measurement)
    motion = pose_motion.initial_motion(
        measurement.position_m,
        measurement.orientation_wxyz,
        measurement.covariance,
        measurement.common,
        LEVELS,
        measurement.motion,
    )
    return PoseState(
        time_s=measurement.time_s,
        motion=motion,
        log_weight=_FIRST_LOG_WEIGHT,
        seen_s=measurement.time_s,
        support=1,
        log_density=-np.inf,
        ambiguity=measurement.ambiguity,
        p_wrong=measurement.p_wrong,
    )


def predict(state: PoseState, time_s: float) -> PoseState:
    """The state at a later time, without a measurement.

    Raises:
        InputError: the time is before the state's time.
    """
    if time_s == state.time_s:
        return state
    if not time_s > state.time_s:
        raise InputError("time_s", expected=f"a time after {state.time_s:g} s", found=f"{time_s:g} s")
    motion, _ = pose_motion.predict(state.motion, time_s - state.time_s, LEVELS)
    return replace(state, time_s=time_s, motion=motion)


def update(state: PoseState, measurement: MeasuredPose, params: PoseFilterParams) -> tuple[PoseState, bool]:
    """The state after a measured pose, and whether the pose was gated; a gated pose leaves the state as predicted.

    A pose is gated where its squared Mahalanobis distance from the prediction of all levels together exceeds the value
    that chi-square with 6 degrees of freedom exceeds with probability `false_alarm`. An ambiguous pose is weighted by
    the probability that it is the right one, given how well it fits.

    Raises:
        InputError: the measurement is before the state, or its covariance is not positive definite.
    """
    _check(measurement)
    state = predict(state, measurement.time_s)
    scaled = measurement.scaled(state.noise_scale)
    innovation = pose_motion.innovation(
        state.motion,
        scaled.position_m,
        scaled.orientation_wxyz,
        scaled.covariance,
        scaled.common,
        scaled.motion,
    )
    off, spread = _mixture(_weights(state), innovation.off, innovation.whole_covariance)
    # The pose alone decides, not the motion that the rows of a rolling shutter show.
    off, spread, covariance = off[:6], spread[:6, :6], innovation.noise[:6, :6]
    precision = np.linalg.inv(spread)
    whitened = precision @ off
    nis = float(off @ whitened)
    if nis > chdtri(6, params.false_alarm):
        return state, True
    right = probability_right(off, spread, measurement.ambiguity)
    since_s = measurement.time_s - state.seen_s
    log_weight = np.exp(-since_s / _MEMORY_S) * state.log_weight + right * _log_densities(innovation)
    log_weight = np.maximum(_normalised(log_weight), np.log(_LEAST_WEIGHT))
    kept = float(np.exp(-since_s / _NOISE_MEMORY_S))
    # The part of the squared innovation that is the noise's (maximum likelihood of a scale).
    corrected, correctable = (_weights(state) @ part for part in pose_motion.rate_changes(innovation))
    wobbled = float(np.exp(-since_s / _MEMORY_S))
    observed = state.noise_scale * min(float(whitened @ covariance @ whitened), _LARGEST_SQUARE)
    return PoseState(
        time_s=measurement.time_s,
        motion=pose_motion.correct(state.motion, innovation, right),
        log_weight=_normalised(log_weight),
        seen_s=measurement.time_s,
        support=state.support + 1,
        log_density=-(nis + float(np.linalg.slogdet(spread)[1])) / 2,
        ambiguity=min(state.ambiguity, measurement.ambiguity),
        p_wrong=min(state.p_wrong, measurement.p_wrong),
        noise_observed=_NOISE_PRIOR + kept * (state.noise_observed - _NOISE_PRIOR) + observed,
        noise_expected=_NOISE_PRIOR
        + kept * (state.noise_expected - _NOISE_PRIOR)
        + float((precision * covariance).sum()),
        wobble_observed=_WOBBLE_PRIOR
        + wobbled * (state.wobble_observed - _WOBBLE_PRIOR)
        + right * 3 * float(corrected / correctable),
        wobble_expected=_WOBBLE_PRIOR + wobbled * (state.wobble_expected - _WOBBLE_PRIOR) + right * 3,
    ), False


def estimate(state: PoseState) -> PoseEstimate:
    """Mean pose of the mixture of all levels, and the covariance of the mixture."""
    weight = _weights(state)
    best = pose_motion.level_of(state.motion, int(weight.argmax()))
    apart = pose_motion.difference(best, state.motion)
    change, covariance = _mixture(weight, apart, state.motion.covariance)
    middle = pose_motion.shift(best, change[None])
    covariance = covariance + _outer(np.tensordot(weight, state.motion.common, axes=1))
    return PoseEstimate(
        position_m=middle.position_m[0],
        orientation_wxyz=middle.orientation_wxyz[0],
        covariance=covariance[np.ix_(POSE, POSE)],
        velocity_m_s=middle.velocity_m_s[0],
        rate_rad_s=middle.rate_rad_s[0],
        motion_covariance=covariance[np.ix_(MOTION, MOTION)],
        acceleration_m_s2=acceleration_rms(middle, covariance),
        wobble_density_rad2_s3=state.wobble_density_rad2_s3,
    )


def acceleration_rms(motion: Motion, covariance: Float[np.ndarray, "n n"]) -> float:
    """Root mean square of the acceleration along an axis, by the state and the state's covariance."""
    variance = np.trace(covariance[ACCELERATION, ACCELERATION])
    return float(np.sqrt(((motion.acceleration_m_s2[0] ** 2).sum() + variance) / 3))


def with_equal_weights(state: PoseState) -> PoseState:
    """The state with equal weights of all levels, as if nothing were known of the camera's agility."""
    return replace(state, log_weight=np.full_like(state.log_weight, -np.log(len(state.log_weight))))


def probability_right(
    off: Float[np.ndarray, "6"], spread: Float[np.ndarray, "6 6"], ambiguity: float
) -> float:
    """Probability that an ambiguous pose is the right one, given how well it fits the motion.

    Bayes' rule. A wrong pose is distributed about the right one with a metre and a radian along and about each axis.

    Args:
        off: (6,), difference of the pose from the prediction, metres and radians.
        spread: (6, 6), covariance of this difference.
        ambiguity: probability, before the motion is considered, that another pose is the right one.
    """
    if ambiguity == 0:
        return 1.0
    wide = spread + _OTHER_POSE_STD**2 * np.eye(6)
    fits, other = (
        -(off @ np.linalg.solve(matrix, off) + np.linalg.slogdet(matrix)[1]) / 2 for matrix in (spread, wide)
    )
    return float(1 / (1 + ambiguity / (1 - ambiguity) * np.exp(other - fits)))


def _weights(state: PoseState) -> Float[np.ndarray, "levels"]:
    """Weights of the levels, with those below the smallest weight of an estimate set to 0."""
    weight = np.exp(state.log_weight)
    weight = np.where(weight < _ESTIMATE_WEIGHT, 0.0, weight)
    return weight / weight.sum()


def _mixture(
    weight: Float[np.ndarray, "levels"],
    mean: Float[np.ndarray, "levels n"],
    covariance: Float[np.ndarray, "levels n n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Mean and covariance of a mixture."""
    middle = weight @ mean
    apart = mean - middle
    return middle, np.tensordot(weight, covariance, axes=1) + (apart.T * weight) @ apart


def _outer(common: Float[np.ndarray, "n errors"]) -> Float[np.ndarray, "n n"]:
    return common @ common.T


def _normalised(log_weight: Float[np.ndarray, "levels"]) -> Float[np.ndarray, "levels"]:
    log_weight = log_weight - log_weight.max()
    return log_weight - np.log(np.exp(log_weight).sum())


def _log_densities(innovation: Innovation) -> Float[np.ndarray, "levels"]:
    """Log densities of a measurement by the prediction of each level, without their constant."""
    covariance = innovation.whole_covariance
    nis = np.einsum("li,lij,lj->l", innovation.off, np.linalg.inv(covariance), innovation.off)
    return (
        -((_FREEDOM + innovation.off.shape[1]) * np.log1p(nis / _FREEDOM) + np.linalg.slogdet(covariance)[1])
        / 2
    )


def _check(measurement: MeasuredPose) -> None:
    """Raise `InputError` unless a measurement has a positive definite covariance."""
    motion = measurement.motion
    covariance = measurement.covariance if motion is None else motion.covariance
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        raise InputError(
            f"covariance at {measurement.time_s:g} s",
            expected="a positive definite matrix",
            found="another",
        )
