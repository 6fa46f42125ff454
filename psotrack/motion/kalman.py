"""How drones move between frames: a Kalman filter with position, velocity and acceleration, a copy for each drone.

Jerk, the change of acceleration, is white noise: the Wiener-process acceleration model of Y. Bar-Shalom, X. R. Li,
T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2.3, discretised exactly, so
that frames may be any time apart. `predict` takes a state to the next frame, `update` corrects it by a measured
position and its covariance; over a gap one predicts only, and the uncertainty grows. All is pure, batched over drones
and free of calls to LAPACK, which would cost more than the arithmetic.

What is measured is off by much the same in one frame as in the next, as what a silhouette shows of a drone changes
only as the drone turns. A filter that takes such errors for white soon knows far better, or so it says, than any frame.
So a share of a measurement's covariance is that of an error that lasts, a first-order Gauss-Markov process which is
part of the state (autocorrelated noise: chapter 8 there); the rest is white. In the state is the apparent position,
which is the drone's own plus that error: measurements are of it and of nothing else, and correct it as any position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack._typing import Array, Positions

#: The chi-square distribution with 3 degrees of freedom is below this with probability 0.999.
GATE_999 = 16.266236196238

#: Over a gap a drone keeps its acceleration for about so long: the best over gaps of 0.5 to 2 s in simulated flights.
ACCELERATION_TIME_S = 0.5

#: Least variances, in roundings of the largest that they are computed from.
_ROUNDINGS = 8

#: Largest variance, summed over the axes, that a lasting error is taken to have: beside 1e4 of these, rounding would
#: cost a position its millimetres.
_LARGEST_ERROR_M2 = 3e2

Covariances = Float[Array, "drones 3 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionParams:
    """What is known of a drone's motion before it is seen; all may differ between calls without a new compilation.

    Attributes:
        jerk_density_m2_s5: (drones,), power spectral density of the jerk along each axis, m2/s5: over t seconds the
            acceleration wanders off by the root of density times t.
        velocity_std_m_s: standard deviation along each axis of the velocity that a state starts with.
        acceleration_std_m_s2: the same of the acceleration, which starts as 0.
        error_share: of a measurement's covariance, what is due to an error that lasts: from 0, where errors are white,
            to below 1.
        error_time_s: after which of such an error 1 / e is left, above 0.
    """

    jerk_density_m2_s5: Float[Array, "drones"]
    velocity_std_m_s: Float[Array, ""]
    acceleration_std_m_s2: Float[Array, ""]
    error_share: Float[Array, ""]
    error_time_s: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionState:
    """What is known of every drone at one time.

    Attributes:
        apparent_m: (drones, 3), mean of where drones seem to be, which is their position plus the error that lasts.
        velocity_m_s, acceleration_m_s2: (drones, 3), means, of the drones themselves.
        error_m: (drones, 3), mean of the error that lasts.
        covariance: (drones, 12, 12), of these four, three axes each, in this order.
        noise_m2: (drones, 3, 3), covariance of the last measurement, white share and all, within reason: a share of it
            is that of errors that begin now.
    """

    apparent_m: Float[Array, "*frames drones 3"]
    velocity_m_s: Float[Array, "*frames drones 3"]
    acceleration_m_s2: Float[Array, "*frames drones 3"]
    error_m: Float[Array, "*frames drones 3"]
    covariance: Float[Array, "*frames drones 12 12"]
    noise_m2: Float[Array, "*frames drones 3 3"]

    @property
    def position_m(self) -> Float[Array, "*frames drones 3"]:
        """(drones, 3), where the drones themselves are."""
        return self.apparent_m - self.error_m

    @property
    def position_covariance_m2(self) -> Float[Array, "*frames drones 3 3"]:
        """(drones, 3, 3), of `position_m`."""
        apparent, error = self.covariance[..., :3, :3], self.covariance[..., 9:, 9:]
        both = self.covariance[..., :3, 9:]
        largest = apparent.trace(axis1=-2, axis2=-1) + error.trace(axis1=-2, axis2=-1)
        # Where one knows much of the drone and little of the error this is a small difference of large numbers.
        return _above_rounding(apparent + error - (both + both.swapaxes(-1, -2)), largest)

    @property
    def mean(self) -> Float[Array, "*frames drones 12"]:
        """(drones, 12), apparent position, velocity, acceleration and error as one vector."""
        parts = (self.apparent_m, self.velocity_m_s, self.acceleration_m_s2, self.error_m)
        return jnp.concatenate([jnp.asarray(part) for part in parts], axis=-1)


def state_of(
    mean: Float[Array, "*frames drones 12"],
    covariance: Float[Array, "*frames drones 12 12"],
    noise_m2: Float[Array, "*frames drones 3 3"],
) -> MotionState:
    """The state with this mean, as `MotionState.mean` has it, this covariance, and noise."""
    return MotionState(mean[..., :3], mean[..., 3:6], mean[..., 6:9], mean[..., 9:], covariance, noise_m2)


def init(
    position_m: Positions, velocity_m_s: Positions, position_covariance_m2: Covariances, params: MotionParams
) -> MotionState:
    """State of drones of which position and velocity are known, the latter to `params.velocity_std_m_s`.

    The position counts as measured: if it is not known well, that is taken for an error of which a share lasts.
    """
    covariance_m2 = _held(position_covariance_m2)
    remembered = _remembered(covariance_m2)
    error_m2 = params.error_share * remembered * covariance_m2
    # The apparent position is off by the rest, which has nothing to do with the error that lasts.
    rest_m2 = (1 - params.error_share * remembered) * covariance_m2
    known = jnp.pad(rest_m2, ((0, 0), (0, 9), (0, 9))) + jnp.pad(error_m2, ((0, 0), (9, 0), (9, 0)))
    none = jnp.zeros_like(params.error_share)
    spread = jnp.stack([none, params.velocity_std_m_s, params.acceleration_std_m_s2, none])
    return MotionState(
        apparent_m=position_m,
        velocity_m_s=velocity_m_s,
        acceleration_m_s2=jnp.zeros_like(position_m),
        error_m=jnp.zeros_like(position_m),
        covariance=known + jnp.diag(jnp.repeat(spread**2, 3)),
        noise_m2=remembered * covariance_m2,
    )


def predict(state: MotionState, dt_s: Float[Array, ""], params: MotionParams) -> MotionState:
    """The state `dt_s` seconds later, from 0 up: F x, and F P F^T + Q with F and Q in closed form."""
    mean = transported(state.mean[..., None], dt_s, params)[..., 0]
    # F P F^T = F (F P)^T, as P is symmetric.
    spread = transported(jnp.swapaxes(transported(state.covariance, dt_s, params), 1, 2), dt_s, params)
    covariance = _symmetric(spread + process_noise(state.noise_m2, dt_s, params))
    return state_of(mean, covariance, state.noise_m2)


def transported(
    matrix: Float[Array, "drones 12 n"], dt_s: Float[Array, ""], params: MotionParams
) -> Float[Array, "drones 12 n"]:
    """F @ matrix: every column, a mean as `MotionState.mean` has it, `dt_s` later at constant acceleration."""
    apparent, velocity, acceleration, error = (matrix[:, 3 * k : 3 * k + 3] for k in range(4))
    gone = -jnp.expm1(-dt_s / params.error_time_s) * error
    velocity_later = velocity + dt_s * acceleration
    apparent_later = apparent + dt_s * (velocity + dt_s / 2 * acceleration) - gone
    return jnp.concatenate([apparent_later, velocity_later, acceleration, error - gone], axis=1)


def process_noise(
    noise_m2: Covariances, dt_s: Float[Array, ""], params: MotionParams
) -> Float[Array, "drones 12 12"]:
    """Q, what a state is off by after `dt_s` for the jerk, and for what has come to the error that lasts."""
    jerk = params.jerk_density_m2_s5[:, None, None] * jnp.kron(jerk_noise(dt_s), jnp.eye(3))
    begun = -jnp.expm1(-2 * dt_s / params.error_time_s) * params.error_share * noise_m2
    # The apparent position is off by all that the error is.
    both = jnp.array([1.0, 0.0, 0.0, 1.0])
    return jnp.pad(jerk, ((0, 0), (0, 3), (0, 3))) + jnp.kron(jnp.outer(both, both), begun)


def jerk_noise(dt_s: Float[Array, ""]) -> Float[Array, "3 3"]:
    """(3, 3), covariance of position, velocity and acceleration along one axis after `dt_s` of unit white jerk.

    The integral over s from 0 to dt of g g^T with g = (s^2 / 2, s, 1): Bar-Shalom et al. 2001, section 6.2.3.
    """
    one, two, three, four, five = (dt_s**power / divisor for power, divisor in enumerate((1, 2, 6, 8, 20), 1))
    return jnp.stack(
        [jnp.stack([five, four, three]), jnp.stack([four, 2 * three, two]), jnp.stack([three, two, one])]
    )


def update(
    state: MotionState,
    measured_m: Positions,
    measured_covariance_m2: Covariances,
    was_measured: Bool[Array, "drones"],
    params: MotionParams,
) -> tuple[MotionState, Float[Array, "drones"]]:
    """Correct the state by measured positions; drones that were not measured stay as they are.

    The covariance takes Joseph's form, (I - KH) P (I - KH)^T + K R K^T, and float32 does not make it indefinite.

    A measurement far off the prediction is rather wrong than that the drone jumped: beyond `GATE_999` it counts with a
    larger covariance, with which its normalised innovation would be just at the gate, and so the less the farther off
    it is. The gate is no wall: a drone that did jump is followed, but within a second, and with overshoot. One that is
    known to be elsewhere is better begun anew, with `init`.

    Args:
        measured_m: (drones, 3), world; any value, NaN too, where not measured.
        measured_covariance_m2: (drones, 3, 3), symmetric and positive definite where measured.
        was_measured: (drones,).

    Returns:
        The corrected state, and NIS (drones,): the squared innovation, normalised by its covariance before any gate.
        Where state and measurement are honest its mean is 3. NaN where not measured.
    """
    noise_m2 = _held(measured_covariance_m2)
    white_m2 = (1 - params.error_share) * noise_m2
    innovation, whiten, nis, excess = _innovation(state, measured_m, white_m2)
    excess = excess[:, None, None]
    before = jnp.asarray(state.covariance)
    # The innovation's covariance S becomes excess * S: that is what R has to grow by.
    precision = _product(jnp.swapaxes(whiten, 1, 2), whiten) / excess
    white_m2 = white_m2 + (excess - 1) * (before[:, :3, :3] + white_m2)

    gain = _product(before[:, :, :3], precision)
    correction = (gain * innovation[:, None, :]).sum(axis=-1)
    # I - KH is the identity but for its first three columns. Their topmost block is I - P S^-1 = R S^-1: written so,
    # nothing cancels, however precise the measurement and vague the prediction.
    columns = jnp.concatenate([_product(white_m2, precision), -gain[:, 3:]], axis=1)
    rows_done = before.at[:, :3].set(0.0) + _product(columns, before[:, :3])
    both_done = rows_done.at[:, :, :3].set(0.0) + _product(rows_done[:, :, :3], jnp.swapaxes(columns, 1, 2))
    after = _symmetric(both_done + _product(_product(gain, white_m2), jnp.swapaxes(gain, 1, 2)))
    # The rest does cancel, as when the second frame tells for the first time what velocity and acceleration are.
    rest = jnp.repeat(jnp.array([0.0, 1.0, 1.0, 1.0]), 3)
    least = _ROUNDINGS * jnp.finfo(before.dtype).eps * jnp.diag(rest)
    after = after + least * before

    corrected = state_of(state.mean + correction, after, _remembered(noise_m2) * noise_m2)
    return chosen(was_measured, corrected, state), jnp.where(was_measured, nis, jnp.nan)


def log_likelihood(
    state: MotionState, measured_m: Positions, measured_covariance_m2: Covariances, params: MotionParams
) -> Float[Array, "drones"]:
    """(drones,), logarithm of the density with which each predicted state expects its measurement, m^-3.

    Gaussian up to the gate; beyond it with the larger covariance that `update` uses, so that a wild measurement costs
    as the logarithm of its distance and decides nothing alone.
    """
    white_m2 = (1 - params.error_share) * _held(measured_covariance_m2)
    _, whiten, nis, excess = _innovation(state, measured_m, white_m2)
    log_root = jnp.log(jnp.diagonal(whiten, axis1=1, axis2=2)).sum(axis=-1)
    return log_root - (nis / excess + 3 * jnp.log(2 * jnp.pi * excess)) / 2


def tamed(
    state: MotionState,
    unseen: Bool[Array, "drones"],
    lost: Bool[Array, "drones"],
    *,
    dt_s: Float[Array, ""],
    bounds_m: Float[Array, "2 3"],
    max_speed_m_s: Float[Array, ""],
) -> MotionState:
    """The state within the room and no faster than drones are; unseen, ever straighter; and where lost, at rest."""
    at_rest = lost[:, None]
    straighter = jnp.where(unseen, jnp.exp(-dt_s / ACCELERATION_TIME_S), 1.0)[:, None]
    speed = jnp.linalg.norm(state.velocity_m_s, axis=-1, keepdims=True)
    velocity = state.velocity_m_s * jnp.minimum(1.0, max_speed_m_s / jnp.maximum(speed, 1e-9))
    return replace(
        state,
        apparent_m=jnp.clip(state.apparent_m, *bounds_m),
        velocity_m_s=jnp.where(at_rest, 0.0, velocity),
        acceleration_m_s2=jnp.where(at_rest, 0.0, straighter * state.acceleration_m_s2),
    )


def chosen(which: Bool[Array, "drones"], first: MotionState, second: MotionState) -> MotionState:
    """The states of `first` where `which`, else of `second`."""
    return jax.tree.map(
        lambda one, other: jnp.where(which.reshape(-1, *[1] * (one.ndim - 1)), one, other), first, second
    )


def _innovation(
    state: MotionState, measured_m: Positions, white_m2: Covariances
) -> tuple[Positions, Covariances, Float[Array, "drones"], Float[Array, "drones"]]:
    """Measured minus predicted, the matrix that whitens it, NIS, and what NIS exceeds the gate by, at least 1."""
    innovation = jnp.asarray(measured_m - state.apparent_m)
    whiten = _whitening(state.covariance[:, :3, :3] + white_m2)
    nis = ((whiten * innovation[:, None, :]).sum(axis=-1) ** 2).sum(axis=-1)
    return innovation, whiten, nis, jnp.maximum(nis / GATE_999, 1.0)


def _held(covariance: Covariances) -> Covariances:
    """The covariance with its least variances held above the rounding of its largest.

    Of a drone that all cameras see from one side one knows millimetres across and metres along. In float32 such a
    matrix may have a negative eigenvalue, which would make any sum with it indefinite sooner or later.
    """
    return _above_rounding(covariance, covariance.trace(axis1=-2, axis2=-1))


def _remembered(covariance: Covariances) -> Float[Array, "drones 1 1"]:
    """How much of a covariance lasting errors are taken from: a measurement that says nothing leaves no kilometres."""
    return jnp.minimum(1.0, _LARGEST_ERROR_M2 / covariance.trace(axis1=-2, axis2=-1))[:, None, None]


def _above_rounding(
    covariance: Float[Array, "*frames drones 3 3"], largest_m2: Float[Array, "*frames drones"]
) -> Float[Array, "*frames drones 3 3"]:
    """The covariance and some roundings of the largest variance that it is computed from, on its diagonal."""
    least_m2 = _ROUNDINGS * jnp.finfo(covariance.dtype).eps * largest_m2
    return covariance + least_m2[..., None, None] * np.eye(3, dtype=covariance.dtype)


def _whitening(covariance: Covariances) -> Covariances:
    """(drones, 3, 3), the inverse W of the Cholesky factor: W C W^T = I."""
    l_xx = jnp.sqrt(covariance[:, 0, 0])
    l_yx, l_zx = covariance[:, 1, 0] / l_xx, covariance[:, 2, 0] / l_xx
    l_yy = jnp.sqrt(covariance[:, 1, 1] - l_yx**2)
    l_zy = (covariance[:, 2, 1] - l_zx * l_yx) / l_yy
    l_zz = jnp.sqrt(covariance[:, 2, 2] - l_zx**2 - l_zy**2)
    w_yx = -l_yx / (l_xx * l_yy)
    w_zx = -(l_zx / l_xx + l_zy * w_yx) / l_zz
    w_zy = -l_zy / (l_yy * l_zz)
    none = jnp.zeros_like(l_xx)
    rows = ((1 / l_xx, none, none), (w_yx, 1 / l_yy, none), (w_zx, w_zy, 1 / l_zz))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=1)


def _product(
    left: Float[Array, "drones m 3"], right: Float[Array, "drones 3 n"]
) -> Float[Array, "drones m n"]:
    """left @ right. Three outer products fuse with what is about them; calls of a batched product do not."""
    outer = (left[:, :, k, None] * right[:, None, k, :] for k in range(3))
    return next(outer) + next(outer) + next(outer)


def _symmetric(matrix: Float[Array, "drones n n"]) -> Float[Array, "drones n n"]:
    return (matrix + jnp.swapaxes(matrix, 1, 2)) / 2
