"""Motion of a camera on a drone: prediction between frames, and correction by measured poses.

An error-state Kalman filter (J. Solà, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508) with
position, velocity and an acceleration that decays (R. A. Singer, IEEE Transactions on Aerospace and Electronic
Systems 6(4), 1970) along the world's axes, and orientation and turn rate about the camera's own axes. Small turns
multiply from the right; their Jacobians are those of J. Solà, J. Deray, D. Atchuthan, A micro Lie theory for state
estimation in robotics, arXiv:1812.01537, appendix B.

Poses of neighbouring frames have similar errors, because they come from the same corners at nearly the same places in
the image. Therefore a fraction of a measurement's covariance belongs to a correlated error, as in
`psotrack.tracking.motion`. The correlated error is L u: L is the symmetric root of that fraction, and u are six slowly
changing numbers of variance 1 that are part of the state. A filter that treated these errors as white noise would
become overconfident.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from psotrack.geometry import cross_matrices
from psotrack.geometry.estimation import backward_step
from psotrack.inside_out.pose import CameraPose

#: (21, 21), matrix of the error state.
Matrix = Float[np.ndarray, "n n"]

#: Size of the error state: position, velocity, acceleration, turn, turn rate (3 each), and the correlated error u (6).
SIZE = 21
_POSITION, _VELOCITY, _ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
_TURN, _RATE, _CORRELATED = slice(9, 12), slice(12, 15), slice(15, 21)
#: Indices of position and turn in the error state, and of velocity and turn rate.
POSE, RATES = np.r_[0:3, 9:12], np.r_[3:6, 12:15]

#: Time constant of the acceleration's exponential decay, seconds.
ACCELERATION_TIME_S = 1.0
#: Fraction of a measurement's covariance that belongs to the correlated error, and the error's time constant, seconds.
CORRELATED_FRACTION = 0.6
CORRELATED_TIME_S = 0.4
#: Smallest standard deviations of velocity and turn rate along each axis after the first pose; those of a wild camera
#: are what it gains in a second.
_VELOCITY_STD_M_S = 5.0
_RATE_STD_RAD_S = 3.0


@dataclass(frozen=True)
class Agility:
    """How wildly a camera moves.

    Attributes:
        acceleration_std_m_s2: standard deviation of the acceleration along each axis.
        rate_change_std_rad_s: standard deviation of the change of the turn rate within a second about each axis.
    """

    acceleration_std_m_s2: float = 5.0
    rate_change_std_rad_s: float = 3.0


@dataclass(frozen=True)
class Motion:
    """State of the filter at one time.

    Attributes:
        mean: (21,), in the order of the error state: position, velocity and acceleration along the world's axes; 0 for
            the turn, which is in `R_world_cam`; turn rate about the camera's axes; correlated error u, in standard
            deviations.
        R_world_cam: (3, 3), camera to world.
        covariance: (21, 21), covariance of the error state.
    """

    mean: Float[np.ndarray, "n"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "n n"]


@dataclass(frozen=True, kw_only=True)
class MotionEstimate(CameraPose):
    """An estimated pose of a camera and its motion.

    Attributes:
        velocity_m_s: (3,), world.
        rate_rad_s: (3,), turn rate about the camera's axes.
        rate_covariance: (6, 6), of velocity and turn rate.
    """

    velocity_m_s: Float[np.ndarray, "3"]
    rate_rad_s: Float[np.ndarray, "3"]
    rate_covariance: Float[np.ndarray, "6 6"]


@dataclass(frozen=True)
class Innovation:
    """Difference of a measured pose and the predicted one, with covariances.

    Attributes:
        off: (6,), measured minus predicted pose, along the world's axes and about the predicted camera's axes.
        covariance: (6, 6), covariance of `off`, from state and measurement together.
        cross: (21, 6), covariance of the error state with `off`.
    """

    off: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "6 6"]
    cross: Float[np.ndarray, "n 6"]


def initial_motion(pose: CameraPose, agility: Agility) -> Motion:
    """Make the state after the first pose; velocity, acceleration and turn rate have mean 0."""
    root = _correlated_root(pose.varying)
    spread = np.zeros((SIZE, SIZE))
    # The state's pose error contains the correlated error with the opposite sign.
    spread[np.ix_(POSE, POSE)] = pose.varying
    spread[POSE, _CORRELATED] = -root
    spread[_CORRELATED, POSE] = -root
    acceleration, rate_change = agility.acceleration_std_m_s2, agility.rate_change_std_rad_s
    of_others = (
        max(_VELOCITY_STD_M_S, acceleration),
        acceleration,
        max(_RATE_STD_RAD_S, rate_change),
        1.0,
        1.0,
    )
    others = np.r_[3:9, 12:21]
    spread[others, others] = np.square(np.repeat(of_others, 3))
    mean = np.zeros(SIZE)
    mean[_POSITION] = pose.position_m
    return Motion(mean, pose.R_world_cam, spread)


def predict(motion: Motion, dt_s: float, agility: Agility) -> tuple[Motion, Matrix, Matrix]:
    """Predict the motion `dt_s` seconds later, at least 0.

    Returns:
        The motion; and (21, 21) twice: transition F and process noise Q of the error state.
    """
    still, by_acceleration, by_turns, of_correlated = _model(round(dt_s, 9))
    mean, F = still @ motion.mean, still.copy()
    # The turn is 0 before, so that it is the turn rate times the time now.
    turn = mean[_TURN].copy()
    there = _rotation(turn)
    F[_TURN, _TURN] = there.T
    F[_TURN, _RATE] = dt_s * right_jacobian(turn)
    Q = of_correlated + agility.acceleration_std_m_s2**2 * by_acceleration
    Q = Q + agility.rate_change_std_rad_s**2 * by_turns
    mean[_TURN] = 0.0
    later = Motion(mean, motion.R_world_cam @ there, F @ motion.covariance @ F.T + Q)
    return later, F, Q


def turning(motion: Motion, agility: Agility) -> Motion:
    """The motion with an acceleration that may be any: what it was before the turn says nothing about it."""
    mean, spread = motion.mean.copy(), motion.covariance.copy()
    mean[_ACCELERATION], spread[_ACCELERATION], spread[:, _ACCELERATION] = 0.0, 0.0, 0.0
    spread[_ACCELERATION, _ACCELERATION] = agility.acceleration_std_m_s2**2 * np.eye(3)
    return replace(motion, mean=mean, covariance=spread)


def innovation(motion: Motion, pose: CameraPose) -> Innovation:
    """Compare a measured pose with the predicted one; the constant part of its covariance is left out."""
    turn = turn_between(motion.R_world_cam, pose.R_world_cam)
    # The measurement's small turns are about its own axes; the innovation's turn is a logarithm.
    by_noise = np.eye(6)
    by_noise[3:, 3:] = np.linalg.inv(right_jacobian(turn))
    H = np.zeros((6, SIZE))
    H[np.arange(6), POSE] = 1.0
    H[:, _CORRELATED] = by_noise @ _correlated_root(pose.varying)
    white = (1 - CORRELATED_FRACTION) * by_noise @ pose.varying @ by_noise.T
    off = np.append(pose.position_m, turn) - H @ motion.mean
    cross = motion.covariance @ H.T
    return Innovation(off, _symmetric(H @ cross + white), cross)


def correct(motion: Motion, measured: Innovation, right: float = 1.0) -> Motion:
    """Correct a motion by a measured pose.

    Args:
        motion: predicted motion.
        measured: innovation of the measured pose.
        right: probability that the pose belongs to this motion at all, which is its weight (Bar-Shalom, Daum & Huang,
            The probabilistic data association filter, IEEE Control Systems 29(6), 2009).
    """
    gain = np.linalg.solve(measured.covariance, measured.cross.T).T
    change = gain @ measured.off
    spread = motion.covariance - right * gain @ measured.cross.T
    spread = spread + right * (1 - right) * np.outer(change, change)
    return moved(replace(motion, covariance=_symmetric(spread)), right * change)


def moved(motion: Motion, change: Float[np.ndarray, "n"]) -> Motion:
    """Add an error state to a motion, and express its covariance about the axes of the turned camera."""
    J = np.eye(SIZE)
    J[_TURN, _TURN] = right_jacobian(change[_TURN])
    mean = motion.mean + change
    mean[_TURN] = 0.0
    return Motion(mean, motion.R_world_cam @ _rotation(change[_TURN]), J @ motion.covariance @ J.T)


def smoothed(now: Motion, predicted: Motion, F: Matrix, Q: Matrix, later: Motion) -> Motion:
    """Smooth one frame.

    Args:
        now: filtered motion of the frame.
        predicted: the motion of the next frame as `now` predicts it.
        F, Q: (21, 21), transition from `now` to `predicted`, and process noise.
        later: smoothed motion of the next frame.
    """
    apart = difference(predicted, later)
    # The covariance of `later` is about its own camera axes; the step needs it about those of the predicted camera.
    J = np.eye(SIZE)
    J[_TURN, _TURN] = np.linalg.inv(right_jacobian(apart[_TURN]))
    change, spread = backward_step(
        now.covariance, F, Q, predicted.covariance, J @ later.covariance @ J.T, apart[:, None]
    )
    return moved(replace(now, covariance=np.asarray(spread)), np.asarray(change)[:, 0])


def difference(motion: Motion, other: Motion) -> Float[np.ndarray, "n"]:
    """(21,), error state that takes `motion` to `other`."""
    apart = other.mean - motion.mean
    apart[_TURN] = turn_between(motion.R_world_cam, other.R_world_cam)
    return apart


def estimate(motion: Motion) -> MotionEstimate:
    """Pose and motion of a state."""
    return MotionEstimate(
        motion.mean[_POSITION],
        motion.R_world_cam,
        motion.covariance[np.ix_(POSE, POSE)],
        velocity_m_s=motion.mean[_VELOCITY],
        rate_rad_s=motion.mean[_RATE],
        rate_covariance=motion.covariance[np.ix_(RATES, RATES)],
    )


def turn_between(first: Float[np.ndarray, "3 3"], second: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """The turn about the first camera's axes, of at most pi, that takes it to the second."""
    return np.asarray(Rotation.from_matrix(first.T @ second).as_rotvec())


def right_jacobian(turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """J with exp(turn + d) = exp(turn) exp(J d) for small d."""
    angle, crossed = float(np.linalg.norm(turn)), cross_matrices(turn)
    # (1 - cos a) / a² and (a - sin a) / a³, by series where both numerators vanish.
    first = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    second = (angle - np.sin(angle)) / angle**3 if angle > 1e-2 else 1 / 6 - angle**2 / 120
    return np.eye(3) - first * crossed + second * (crossed @ crossed)


def _rotation(turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return np.asarray(Rotation.from_rotvec(turn).as_matrix())


def _correlated_root(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Symmetric root L of the correlated error's covariance: L L is that covariance."""
    variances, axes = np.linalg.eigh(covariance)
    return (axes * np.sqrt(CORRELATED_FRACTION * np.maximum(variances, 0.0))) @ axes.T


@lru_cache(maxsize=256)
def _model(dt_s: float) -> tuple[Matrix, ...]:
    """Transition of the error state of a camera that does not turn in `dt_s` seconds, and process noise by its causes.

    The causes are accelerations of 1 m/s², changes of the turn rate of 1 rad/s in a second, and the correlated error.

    By the matrix exponential (C. F. Van Loan, Computing integrals involving the matrix exponential, IEEE Transactions
    on Automatic Control 23(3), 1978). The part of the turns neglects the turn of the axes during `dt_s`.
    """
    A = np.zeros((7, 7))
    A[0, 1] = A[1, 2] = A[3, 4] = 1.0
    A[2, 2], A[5, 5], A[6, 6] = -1 / ACCELERATION_TIME_S, -1 / CORRELATED_TIME_S, -1 / CORRELATED_TIME_S
    parts = []
    causes = ([2], 2 / ACCELERATION_TIME_S), ([4], 1.0), ([5, 6], 2 / CORRELATED_TIME_S)
    for driven, density in causes:
        noise = np.zeros((7, 7))
        noise[driven, driven] = density
        both = expm(np.block([[-A, noise], [np.zeros((7, 7)), A.T]]) * dt_s)
        F = both[7:, 7:].T
        parts.append(np.kron(F @ both[:7, 7:], np.eye(3)))
    return np.kron(F, np.eye(3)), *parts


def _symmetric(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return (matrix + matrix.T) / 2
