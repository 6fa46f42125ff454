"""How a camera on a drone moves between frames, and how a measured pose corrects what is known of it.

An error-state Kalman filter (J. Solà, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508):
position, velocity and an acceleration that dies away (R. A. Singer, IEEE Transactions on Aerospace and Electronic
Systems 6(4), 1970) along the world's axes, orientation and turn rate about the camera's own. It runs at several levels
of jerk and of angular acceleration at once.

Poses of neighbouring frames are off by much the same, because they are from the same corners at nearly the same
places in the image. So a share of a measurement's covariance is that of an error that lasts. It is L u, with L the
symmetric root of that share, which turns with the world, and six numbers u of variance 1 that are part of the state
and change slowly. A filter that took such errors for white would soon believe itself far better than any frame
(`psotrack.motion` does alike for positions).

Errors of the map and of the focal length never change. No motion tells them, and no number of frames averages them
away: they are considered, not estimated (S. F. Schmidt, Application of state-space methods to navigation problems,
Advances in Control Systems 3, 1966). What each does to a pose is known, and what that does to the state is carried
along; gains are as if there were none of them.
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

#: The error state: position, velocity, acceleration, turn, turn rate (3 each), and the error that lasts, u (6).
SIZE = 21
_TURN, _RATE, _LASTING = slice(9, 12), slice(12, 15), slice(15, 21)
#: Where position and turn are in it.
POSE = np.r_[0:3, 9:12]

#: A drone keeps its acceleration for about so long.
ACCELERATION_TIME_S = 1.0
#: Of a measurement's covariance, what is due to errors that last, and after which time 1 / e is left of them.
LASTING_SHARE = 0.6
LASTING_TIME_S = 0.4
#: Standard deviations along each axis of what is not known of a camera whose pose was just seen first.
_VELOCITY_STD_M_S = 5.0
_RATE_STD_RAD_S = 3.0

_NO_TURN = np.array([[1.0, 0.0, 0.0, 0.0]])
# Nodes and weights on [0, 1]: exact to rounding for all times between frames, where the closed form cancels.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


@dataclass(frozen=True)
class Levels:
    """How wildly a camera may move, one value per level.

    Attributes:
        jerk_density_m2_s5: (levels,), power spectral density of the jerk along each axis.
        wobble_density_rad2_s3: (levels,), that of the angular acceleration about each axis.
    """

    jerk_density_m2_s5: Float[np.ndarray, "levels"]
    wobble_density_rad2_s3: Float[np.ndarray, "levels"]


@dataclass(frozen=True)
class Motion:
    """What each level knows of a camera at one time.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: (levels, 3), world.
        orientation_wxyz: (levels, 4), unit quaternions, camera to world.
        rate_rad_s: (levels, 3), turn rate about the camera's axes.
        lasting: (levels, 6), the error u that lasts, in standard deviations.
        covariance: (levels, 21, 21), of all these in this order, as if there were no errors that never change.
        common: (levels, 21, errors), by how much one standard deviation of each error that never changes puts it off.
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
    """What was measured less what was foretold, and how they vary.

    Attributes:
        pose: (levels, 6), along the world's axes and about the foretold camera's.
        covariance: (levels, 6, 6), of `pose`: of state and measurement together.
        shared: (levels, 21, 6), covariance of the state with it.
        common: (levels, 6, errors), what one standard deviation of each error that never changes adds to `pose`.
    """

    pose: Float[np.ndarray, "levels 6"]
    covariance: Float[np.ndarray, "levels 6 6"]
    shared: Float[np.ndarray, "levels n 6"]
    common: Float[np.ndarray, "levels 6 errors"]

    @property
    def whole_covariance(self) -> Float[np.ndarray, "levels 6 6"]:
        """(levels, 6, 6), of `pose`, with errors that never change."""
        return self.covariance + self.common @ self.common.swapaxes(1, 2)


def begun(
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"],
    covariance: Float[np.ndarray, "6 6"],
    common: Float[np.ndarray, "6 errors"],
    levels: Levels,
) -> Motion:
    """What is known after the first pose: that pose, and that drones have some speed."""
    count = len(levels.jerk_density_m2_s5)
    spread = np.zeros((count, SIZE, SIZE))
    root = _lasting_root(covariance)
    # The pose is off by the error that lasts, with the opposite sign, and by the rest.
    spread[:, POSE[:, None], POSE] = covariance
    spread[:, POSE, _LASTING] = -root
    spread[:, _LASTING, POSE] = -root
    variance = np.einsum("lii->li", spread)
    variance[:, 3:6] = _VELOCITY_STD_M_S**2
    variance[:, 6:9] = levels.jerk_density_m2_s5[:, None] * ACCELERATION_TIME_S / 2
    variance[:, _RATE] = _RATE_STD_RAD_S**2
    variance[:, _LASTING] = 1.0
    off = np.zeros((count, SIZE, common.shape[1]))
    off[:, POSE] = common
    none = np.zeros((count, 3))
    return Motion(
        position_m=np.tile(position_m, (count, 1)),
        velocity_m_s=none,
        acceleration_m_s2=none,
        orientation_wxyz=np.tile(orientation_wxyz / np.linalg.norm(orientation_wxyz), (count, 1)),
        rate_rad_s=none,
        lasting=np.zeros((count, 6)),
        covariance=spread,
        common=off,
    )


def foretold(motion: Motion, dt_s: float, levels: Levels) -> tuple[Motion, Float[np.ndarray, "levels n n"]]:
    """The motion `dt_s` seconds later, from 0 up, and F, (levels, 21, 21), which takes the errors there."""
    along, turn = _grown_from(dt_s), motion.rate_rad_s * dt_s
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
    """Q, (levels, 21, 21), what is unknown after `dt_s` for jerk and wobble, and has come to the error that lasts.

    The jerk's is the integral over s from 0 to dt of g gᵀ, where g(s) is what a jerk has led to s later; the wobble's
    is that of white angular acceleration, of which the turn of the axes meanwhile is left out.
    """
    grown = _grown(_NODES * dt_s)
    jerk = _each_axis((grown.T * (_WEIGHTS * dt_s)) @ grown)
    wobble = _each_axis(np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]]))
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
) -> Innovation:
    """What a measured pose tells that was not foretold; its covariance, as in `CameraPath`, is without `common`."""
    turn = turn_between(motion.orientation_wxyz, orientation_wxyz[None])
    # The measurement's small turns are about its own axes; these are of the logarithm.
    by_noise = np.zeros((len(turn), 6, 6))
    by_noise[:, :3, :3] = np.eye(3)
    by_noise[:, 3:, 3:] = right_jacobian_inverse(turn)
    H = np.zeros((len(turn), 6, SIZE))
    H[:, np.arange(6), POSE] = 1.0
    H[:, :, _LASTING] = by_noise @ _lasting_root(covariance)
    H_t = H.swapaxes(1, 2)
    shared = motion.covariance @ H_t
    white = (1 - LASTING_SHARE) * by_noise @ covariance @ by_noise.swapaxes(1, 2)
    expected = np.einsum("lij,lj->li", H[:, :, _LASTING], motion.lasting)
    off = np.concatenate([position_m - motion.position_m, turn], axis=1) - expected
    differs = by_noise @ common - H @ motion.common
    return Innovation(off, _symmetric(H @ shared + white), shared, differs)


def corrected(motion: Motion, told: Innovation, right: float = 1.0) -> Motion:
    """The motion after a measurement.

    Args:
        motion: as foretold.
        told: by the measurement.
        right: probability that the measurement is of this motion at all; the less, the less it counts
            (Bar-Shalom, Daum & Huang, The probabilistic data association filter, IEEE Control Systems 29(6), 2009).
    """
    gain = np.linalg.solve(told.covariance, told.shared.swapaxes(1, 2)).swapaxes(1, 2)
    change = np.einsum("lij,lj->li", gain, told.pose)
    spread = motion.covariance - right * gain @ told.shared.swapaxes(1, 2)
    if right < 1:
        spread = spread + right * (1 - right) * change[:, :, None] * change[:, None, :]
    off = motion.common + right * gain @ told.common
    return moved(replace(motion, covariance=_symmetric(spread), common=off), right * change)


def moved(motion: Motion, change: Float[np.ndarray, "levels n"]) -> Motion:
    """The motion changed by an error state; its errors are then about the axes of the turned camera."""
    J = right_jacobian(change[:, _TURN])
    spread, off = motion.covariance.copy(), motion.common.copy()
    off[:, _TURN] = J @ off[:, _TURN]
    spread[:, _TURN] = J @ spread[:, _TURN]
    spread[:, :, _TURN] = spread[:, :, _TURN] @ J.swapaxes(1, 2)
    return replace(shifted(motion, change), covariance=spread, common=off)


def shifted(motion: Motion, change: Float[np.ndarray, "levels n"]) -> Motion:
    """The motion changed by an error state, (levels, 21), its errors left as they are."""
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
    """The error state that takes `motion` to `other`; of one of them there may be a single level."""
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
    """The motion of one level, as one of a single level."""
    only = slice(level, level + 1)
    return Motion(*(getattr(motion, name)[only] for name in Motion.__dataclass_fields__))


def _lasting_root(covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """L, symmetric, with L L the covariance of the error that lasts."""
    variances, axes = np.linalg.eigh(covariance)
    return (axes * np.sqrt(LASTING_SHARE * np.maximum(variances, 0.0))) @ axes.T


def _grown_from(dt_s: float) -> Float[np.ndarray, "3 3"]:
    """F of position, velocity and acceleration along one axis after `dt_s`."""
    F = np.eye(3)
    F[0, 1], F[:, 2] = dt_s, _grown(np.array([dt_s]))[0]
    return F


def _grown(s: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 3"]:
    """Position, velocity and acceleration a time s after there was an acceleration of 1 and nothing else."""
    gone = -np.expm1(-s / ACCELERATION_TIME_S)
    velocity = ACCELERATION_TIME_S * gone
    return np.stack([ACCELERATION_TIME_S * (s - velocity), velocity, 1 - gone], axis=-1)


def _each_axis(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "m m"]:
    """The Kronecker product with the identity: what holds along one axis, along three."""
    return (matrix[:, None, :, None] * np.eye(3)[:, None, :]).reshape(3 * len(matrix), -1)


def _symmetric(matrices: Float[np.ndarray, "levels n n"]) -> Float[np.ndarray, "levels n n"]:
    return (matrices + matrices.swapaxes(1, 2)) / 2
