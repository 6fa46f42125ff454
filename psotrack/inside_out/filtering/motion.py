"""Motion of a camera on a drone: prediction between frames, and correction by measured poses.

An error-state Kalman filter (J. Solà, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508) with
position, velocity and an acceleration that decays (R. A. Singer, IEEE Transactions on Aerospace and Electronic
Systems 6(4), 1970) along the world's axes, and orientation and turn rate about the camera's own axes. The filter runs
for several levels of jerk and angular acceleration at once.

Poses of neighbouring frames have similar errors, because they come from the same corners at nearly the same places in
the image. Therefore a share of a measurement's covariance belongs to a lasting error, as in `psotrack.tracking.motion`.
The lasting error is L u: L is the symmetric root of that share, and u are six slowly changing numbers of variance 1
that are part of the state. A filter that treated these errors as white noise would become overconfident.

Errors of the map, of the focal length and of the line time are constant. No motion reveals them, and no number of
frames averages them out, so the filter considers them without estimating them (S. F. Schmidt, Application of
state-space methods to navigation problems, Advances in Control Systems 3, 1966). The effect of each constant error on a
pose is known, and the filter carries its effect on the state along (`common`). The gains are computed without constant
errors.

A pose by a rolling shutter depends on the motion during the frame (`FrameMotion`). The measurement is then the pose for
the assumed motion, which also depends on the state's velocity and turn rate, and the motion that the rows show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.filtering.manifold import (
    right_jacobian,
    right_jacobian_inverse,
    rotation_matrices,
    turn_between,
    turned,
)
from psotrack.inside_out.frame_motion import FrameMotion
from psotrack.tracking.motion import white_jerk_noise

#: Size of the error state: position, velocity, acceleration, turn, turn rate (3 each), and the lasting error u (6).
SIZE = 21
_TURN, _RATE, _LASTING = slice(9, 12), slice(12, 15), slice(15, 21)
ACCELERATION = slice(6, 9)
#: Indices of position and turn in the error state, and of velocity and turn rate.
POSE, MOTION = np.r_[0:3, 9:12], np.r_[3:6, 12:15]

#: Time constant of the acceleration's exponential decay, seconds.
ACCELERATION_TIME_S = 1.0
#: Share of a measurement's covariance that belongs to the lasting error, and the error's time constant, seconds.
LASTING_SHARE = 0.6
LASTING_TIME_S = 0.4
#: Standard deviations of velocity and turn rate along each axis after the first pose.
_VELOCITY_STD_M_S = 5.0
_RATE_STD_RAD_S = 3.0

#: Factor on the covariance of the motion that the rows of a frame show. A part of its errors lasts, as those of poses
#: do, and is the same in the few frames in which a hand's motion changes little: in three of them, errors of which the
#: share `LASTING_SHARE` lasts have a mean with 0.4 / 3 + 0.6 of the variance, 2.2 times that of white errors.
_ROWS_SCALE = 1 + 2 * LASTING_SHARE

_NO_TURN = np.array([[1.0, 0.0, 0.0, 0.0]])
# Gauss-Legendre nodes and weights on [0, 1]. The quadrature is exact to rounding, and the closed form has cancellation.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


@dataclass(frozen=True)
class Levels:
    """Levels of agility of a camera, one value per level.

    Attributes:
        jerk_density_m2_s5: (levels,), power spectral density of the jerk along each axis.
        wobble_density_rad2_s3: (levels,), power spectral density of the angular acceleration about each axis.
    """

    jerk_density_m2_s5: Float[np.ndarray, "levels"]
    wobble_density_rad2_s3: Float[np.ndarray, "levels"]


@dataclass(frozen=True)
class Motion:
    """State of the filter at one time, for each level.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: (levels, 3), world.
        orientation_wxyz: (levels, 4), unit quaternions, camera to world.
        rate_rad_s: (levels, 3), turn rate about the camera's axes.
        lasting: (levels, 6), lasting error u, in standard deviations.
        covariance: (levels, 21, 21), covariance of the error state, without constant errors.
        common: (levels, 21, errors), effect of one standard deviation of each constant error on the error state.
    """

    position_m: Float[np.ndarray, "levels 3"]
    velocity_m_s: Float[np.ndarray, "levels 3"]
    acceleration_m_s2: Float[np.ndarray, "levels 3"]
    orientation_wxyz: Float[np.ndarray, "levels 4"]
    rate_rad_s: Float[np.ndarray, "levels 3"]
    lasting: Float[np.ndarray, "levels 6"]
    covariance: Float[np.ndarray, "levels n n"]
    common: Float[np.ndarray, "levels n errors"]


@dataclass(frozen=True)
class Innovation:
    """Difference of a measured pose and the predicted one, with covariances.

    Attributes:
        off: (levels, m), measured minus predicted: the pose (6), along the world's axes and about the predicted
            camera's axes; of a rolling shutter also velocity and turn rate (6).
        covariance: (levels, m, m), covariance of `off`, from state and measurement together.
        noise: (m, m), covariance of the measurement.
        shared: (levels, 21, m), covariance of the error state with `off`.
        common: (levels, m, errors), effect of one standard deviation of each constant error on `off`.
    """

    off: Float[np.ndarray, "levels m"]
    covariance: Float[np.ndarray, "levels m m"]
    noise: Float[np.ndarray, "m m"]
    shared: Float[np.ndarray, "levels n m"]
    common: Float[np.ndarray, "levels m errors"]

    @property
    def whole_covariance(self) -> Float[np.ndarray, "levels m m"]:
        """(levels, m, m), covariance of `off` with constant errors."""
        return self.covariance + self.common @ self.common.swapaxes(1, 2)


def initial_motion(
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"],
    covariance: Float[np.ndarray, "6 6"],
    common: Float[np.ndarray, "6 errors"],
    levels: Levels,
    seen: FrameMotion | None = None,
) -> Motion:
    """Make the state after the first pose; velocity, acceleration and turn rate have mean 0.

    With `seen`, the frame of a rolling shutter, velocity and turn rate are those that its rows show.
    """
    count = len(levels.jerk_density_m2_s5)
    spread = np.zeros((count, SIZE, SIZE))
    of_motion = np.diag(np.repeat([_VELOCITY_STD_M_S**2, _RATE_STD_RAD_S**2], 3))
    off = np.zeros((count, SIZE, common.shape[1] if seen is None else seen.common.shape[1]))
    mean, change = np.zeros(6), np.zeros(6)
    if seen is None:
        off[:, POSE] = common
    else:
        gain = np.linalg.solve(of_motion + _ROWS_SCALE * seen.measured_covariance, of_motion).T
        mean, of_motion = gain @ seen.measured, of_motion - gain @ of_motion
        change = -seen.by_motion @ (mean - seen.assumed)
        covariance = seen.covariance
        off[:, MOTION] = gain @ seen.common[6:]
        off[:, POSE] = seen.common[:6] - seen.by_motion @ (gain @ seen.common[6:])
    root = _lasting_root(covariance)
    # The state's pose error contains the lasting error with the opposite sign.
    spread[:, POSE[:, None], POSE] = covariance
    spread[:, POSE, _LASTING] = -root
    spread[:, _LASTING, POSE] = -root
    spread[:, MOTION[:, None], MOTION] = of_motion
    if seen is not None:
        shared = -seen.by_motion @ of_motion
        spread[:, POSE[:, None], POSE] = covariance - shared @ seen.by_motion.T
        spread[:, POSE[:, None], MOTION] = shared
        spread[:, MOTION[:, None], POSE] = shared.T
    variance = np.einsum("lii->li", spread)
    variance[:, 6:9] = levels.jerk_density_m2_s5[:, None] * ACCELERATION_TIME_S / 2
    variance[:, _LASTING] = 1.0
    first = orientation_wxyz[None] / np.linalg.norm(orientation_wxyz)
    return Motion(
        position_m=np.tile(position_m + change[:3], (count, 1)),
        velocity_m_s=np.tile(mean[:3], (count, 1)),
        acceleration_m_s2=np.zeros((count, 3)),
        orientation_wxyz=np.tile(turned(first, change[None, 3:]), (count, 1)),
        rate_rad_s=np.tile(mean[3:], (count, 1)),
        lasting=np.zeros((count, 6)),
        covariance=spread,
        common=off,
    )


def predict(motion: Motion, dt_s: float, levels: Levels) -> tuple[Motion, Float[np.ndarray, "levels n n"]]:
    """Predict the motion `dt_s` seconds later, at least 0; also return F, (levels, 21, 21), for the error state."""
    along, turn = _transition_per_axis(dt_s), motion.rate_rad_s * dt_s
    kept = np.exp(-dt_s / LASTING_TIME_S)
    F = np.zeros_like(motion.covariance)
    F[:, :9, :9] = _each_axis(along)
    F[:, _TURN, _TURN] = rotation_matrices(turned(_NO_TURN, -turn))
    F[:, _TURN, _RATE] = dt_s * right_jacobian(turn)
    F[:, _RATE, _RATE] = np.eye(3)
    F[:, _LASTING, _LASTING] = kept * np.eye(6)
    position_m, velocity_m_s, acceleration_m_s2 = np.tensordot(
        along, np.stack([motion.position_m, motion.velocity_m_s, motion.acceleration_m_s2]), axes=1
    )
    later = Motion(
        position_m=position_m,
        velocity_m_s=velocity_m_s,
        acceleration_m_s2=acceleration_m_s2,
        orientation_wxyz=turned(motion.orientation_wxyz, turn),
        rate_rad_s=motion.rate_rad_s,
        lasting=kept * motion.lasting,
        covariance=F @ motion.covariance @ F.swapaxes(1, 2) + process_noise(dt_s, levels),
        common=F @ motion.common,
    )
    return later, F


def process_noise(dt_s: float, levels: Levels) -> Float[np.ndarray, "levels n n"]:
    """Q, (levels, 21, 21), process noise of `dt_s` seconds: jerk, angular acceleration, and new lasting error.

    The jerk's part is the integral over s from 0 to dt of g gᵀ, where g(s) is the response to a unit jerk s seconds
    earlier. It differs from `white_jerk_noise`, because the acceleration decays. The part of the white angular
    acceleration neglects the turn of the axes during `dt_s`.
    """
    response = _acceleration_response(_NODES * dt_s)
    jerk = _each_axis((response.T * (_WEIGHTS * dt_s)) @ response)
    wobble = _each_axis(np.asarray(white_jerk_noise(dt_s))[1:, 1:])
    Q = np.zeros((len(levels.jerk_density_m2_s5), SIZE, SIZE))
    Q[:, :9, :9] = levels.jerk_density_m2_s5[:, None, None] * jerk
    Q[:, 9:15, 9:15] = levels.wobble_density_rad2_s3[:, None, None] * wobble
    Q[:, _LASTING, _LASTING] = -np.expm1(-2 * dt_s / LASTING_TIME_S) * np.eye(6)
    return Q


def innovation(
    motion: Motion,
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"],
    covariance: Float[np.ndarray, "6 6"],
    common: Float[np.ndarray, "6 errors"],
    seen: FrameMotion | None = None,
) -> Innovation:
    """Compare a measured pose with the predicted one.

    Args:
        motion: the prediction.
        position_m, orientation_wxyz: the measured pose.
        covariance, common: covariance as in `CameraPath`, without constant errors, and effects of these errors.
        seen: the frame of a rolling shutter, whose covariance and effects are used instead; None of a global shutter.
    """
    if seen is not None:
        covariance, common = seen.covariance, seen.common[:6]
    turn = turn_between(motion.orientation_wxyz, orientation_wxyz[None])
    # The measurement's small turns are about its own axes; the innovation's turn is a logarithm.
    by_noise = np.zeros((len(turn), 6, 6))
    by_noise[:, :3, :3] = np.eye(3)
    by_noise[:, 3:, 3:] = right_jacobian_inverse(turn)
    H = np.zeros((len(turn), 6, SIZE))
    H[:, np.arange(6), POSE] = 1.0
    H[:, :, _LASTING] = by_noise @ _lasting_root(covariance)
    white = (1 - LASTING_SHARE) * by_noise @ covariance @ by_noise.swapaxes(1, 2)
    expected = np.einsum("lij,lj->li", H[:, :, _LASTING], motion.lasting)
    off = np.concatenate([position_m - motion.position_m, turn], axis=1) - expected
    differs, noise = by_noise @ common, covariance
    if seen is not None:
        H[:, :, MOTION] = by_noise @ seen.by_motion
        predicted = np.concatenate([motion.velocity_m_s, motion.rate_rad_s], axis=1)
        off -= np.einsum("lij,lj->li", H[:, :, MOTION], predicted - seen.assumed)
        off = np.concatenate([off, seen.measured - predicted], axis=1)
        H_motion = np.zeros_like(H)
        H_motion[:, np.arange(6), MOTION] = 1.0
        H = np.concatenate([H, H_motion], axis=1)
        of_motion = np.broadcast_to(seen.common[6:], differs.shape)
        differs = np.concatenate([differs, of_motion], axis=1)
        white, white_pose = np.zeros((len(turn), 12, 12)), white
        white[:, :6, :6], white[:, 6:, 6:] = white_pose, _ROWS_SCALE * seen.measured_covariance
        noise = np.zeros((12, 12))
        noise[:6, :6], noise[6:, 6:] = covariance, _ROWS_SCALE * seen.measured_covariance
    shared = motion.covariance @ H.swapaxes(1, 2)
    differs = differs - H @ motion.common
    return Innovation(off, _symmetric(H @ shared + white), noise, shared, differs)


def correct(motion: Motion, measured: Innovation, right: float = 1.0) -> Motion:
    """Correct a motion by a measured pose.

    Args:
        motion: predicted motion.
        measured: innovation of the measured pose.
        right: probability that the pose belongs to this motion at all, which is its weight (Bar-Shalom, Daum & Huang,
            The probabilistic data association filter, IEEE Control Systems 29(6), 2009).
    """
    gain = gain_of(measured)
    change = np.einsum("lij,lj->li", gain, measured.off)
    spread = motion.covariance - right * gain @ measured.shared.swapaxes(1, 2)
    if right < 1:
        spread = spread + right * (1 - right) * change[:, :, None] * change[:, None, :]
    off = motion.common + right * gain @ measured.common
    return retract(replace(motion, covariance=_symmetric(spread), common=off), right * change)


def gain_of(measured: Innovation) -> Float[np.ndarray, "levels n m"]:
    """Gains of the Kalman filter: change of the error state by the innovation."""
    return np.linalg.solve(measured.covariance, measured.shared.swapaxes(1, 2)).swapaxes(1, 2)


def rate_changes(measured: Innovation) -> tuple[Float[np.ndarray, "levels"], Float[np.ndarray, "levels"]]:
    """(levels,) twice: squared correction of the turn rate by a measured pose, and its expectation."""
    gain = gain_of(measured)[:, _RATE]
    observed = (np.einsum("lij,lj->li", gain, measured.off) ** 2).sum(axis=1)
    return observed, np.einsum("lij,lij->l", gain, measured.shared[:, _RATE])


def retract(motion: Motion, change: Float[np.ndarray, "levels n"]) -> Motion:
    """Add an error state to a motion, and express its covariance about the axes of the turned camera."""
    J = right_jacobian(change[:, _TURN])
    spread, off = motion.covariance.copy(), motion.common.copy()
    off[:, _TURN] = J @ off[:, _TURN]
    spread[:, _TURN] = J @ spread[:, _TURN]
    spread[:, :, _TURN] = spread[:, :, _TURN] @ J.swapaxes(1, 2)
    return replace(shift(motion, change), covariance=spread, common=off)


def shift(motion: Motion, change: Float[np.ndarray, "levels n"]) -> Motion:
    """Add an error state, (levels, 21), to a motion without a change of its covariance."""
    return replace(
        motion,
        position_m=motion.position_m + change[:, :3],
        velocity_m_s=motion.velocity_m_s + change[:, 3:6],
        acceleration_m_s2=motion.acceleration_m_s2 + change[:, 6:9],
        orientation_wxyz=turned(motion.orientation_wxyz, change[:, _TURN]),
        rate_rad_s=motion.rate_rad_s + change[:, _RATE],
        lasting=motion.lasting + change[:, _LASTING],
    )


def difference(motion: Motion, other: Motion) -> Float[np.ndarray, "levels n"]:
    """(levels, 21), error state that takes `motion` to `other`; each may have a single level."""
    turn = turn_between(motion.orientation_wxyz, other.orientation_wxyz)
    parts = [
        other.position_m - motion.position_m,
        other.velocity_m_s - motion.velocity_m_s,
        other.acceleration_m_s2 - motion.acceleration_m_s2,
        turn,
        other.rate_rad_s - motion.rate_rad_s,
        other.lasting - motion.lasting,
    ]
    return np.concatenate(parts, axis=1)


def level_of(motion: Motion, level: int) -> Motion:
    """Take one level of a motion, as a motion of a single level."""
    only = slice(level, level + 1)
    return Motion(*(getattr(motion, name)[only] for name in Motion.__dataclass_fields__))


def _lasting_root(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Symmetric root L of the lasting error's covariance: L L is that covariance."""
    variances, axes = np.linalg.eigh(covariance)
    return (axes * np.sqrt(LASTING_SHARE * np.maximum(variances, 0.0))) @ axes.T


def _transition_per_axis(dt_s: float) -> Float[np.ndarray, "3 3"]:
    """(3, 3), F of position, velocity and acceleration along one axis after `dt_s`."""
    F = np.eye(3)
    F[0, 1], F[:, 2] = dt_s, _acceleration_response(np.array([dt_s]))[0]
    return F


def _acceleration_response(s: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 3"]:
    """(times, 3), response to a unit acceleration at time 0: position, velocity and acceleration at the times s."""
    decayed = -np.expm1(-s / ACCELERATION_TIME_S)
    velocity = ACCELERATION_TIME_S * decayed
    return np.stack([ACCELERATION_TIME_S * (s - velocity), velocity, 1 - decayed], axis=-1)


def _each_axis(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "m m"]:
    """Kronecker product with the (3, 3) identity: extend a matrix for one axis to three axes."""
    return (matrix[:, None, :, None] * np.eye(3)[:, None, :]).reshape(3 * len(matrix), -1)


def _symmetric(matrices: Float[np.ndarray, "levels n n"]) -> Float[np.ndarray, "levels n n"]:
    return (matrices + matrices.swapaxes(1, 2)) / 2
