"""How drones move between frames: a Kalman filter with position, velocity and acceleration, a copy for each drone.

Jerk, the change of acceleration, is white noise: the Wiener-process acceleration model of Y. Bar-Shalom, X. R. Li,
T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2.3, discretised exactly, so
that frames may be any time apart. `predict` takes a state to the next frame, `update` corrects it by a measured
position and its covariance; over a gap one predicts only, and the uncertainty grows. All is pure, batched over drones
and free of calls to LAPACK, which would cost more than the arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from psotrack._typing import Array, Positions

#: The chi-square distribution with 3 degrees of freedom is below this with probability 0.999.
GATE_999 = 16.266236196238

#: Least variances, in roundings of the largest that they are computed from.
_ROUNDINGS = 8

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
    """

    jerk_density_m2_s5: Float[Array, "drones"]
    velocity_std_m_s: Float[Array, ""]
    acceleration_std_m_s2: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionState:
    """What is known of every drone at one time.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: (drones, 3), means.
        covariance: (drones, 9, 9), of position, velocity and acceleration, three axes each, in this order.
    """

    position_m: Float[Array, "*frames drones 3"]
    velocity_m_s: Float[Array, "*frames drones 3"]
    acceleration_m_s2: Float[Array, "*frames drones 3"]
    covariance: Float[Array, "*frames drones 9 9"]

    @property
    def position_covariance_m2(self) -> Float[Array, "*frames drones 3 3"]:
        """(drones, 3, 3), of the positions."""
        return self.covariance[..., :3, :3]

    @property
    def mean(self) -> Float[Array, "*frames drones 9"]:
        """(drones, 9), position, velocity and acceleration as one vector."""
        parts = (self.position_m, self.velocity_m_s, self.acceleration_m_s2)
        return jnp.concatenate([jnp.asarray(part) for part in parts], axis=-1)


def state_of(
    mean: Float[Array, "*frames drones 9"], covariance: Float[Array, "*frames drones 9 9"]
) -> MotionState:
    """The state with this mean, as `MotionState.mean` has it, and covariance."""
    return MotionState(mean[..., :3], mean[..., 3:6], mean[..., 6:], covariance)


def init(
    position_m: Positions, velocity_m_s: Positions, position_covariance_m2: Covariances, params: MotionParams
) -> MotionState:
    """State of drones of which position and velocity are known, the latter to `params.velocity_std_m_s`."""
    spread = jnp.stack([jnp.zeros(()), params.velocity_std_m_s, params.acceleration_std_m_s2])
    rest = jnp.diag(jnp.repeat(spread.astype(position_m.dtype) ** 2, 3))
    return MotionState(
        position_m=position_m,
        velocity_m_s=velocity_m_s,
        acceleration_m_s2=jnp.zeros_like(position_m),
        covariance=jnp.pad(_above_rounding(position_covariance_m2), ((0, 0), (0, 6), (0, 6))) + rest,
    )


def predict(state: MotionState, dt_s: Float[Array, ""], params: MotionParams) -> MotionState:
    """The state `dt_s` seconds later, from 0 up: F x, and F P F^T + Q with F and Q in closed form."""
    mean = transported(state.mean[..., None], dt_s)[..., 0]
    # F P F^T = F (F P)^T, as P is symmetric.
    spread = transported(jnp.swapaxes(transported(state.covariance, dt_s), 1, 2), dt_s)
    added = params.jerk_density_m2_s5[:, None, None] * jnp.kron(jerk_noise(dt_s), jnp.eye(3))
    return state_of(mean, _symmetric(spread + added))


def transported(matrix: Float[Array, "drones 9 n"], dt_s: Float[Array, ""]) -> Float[Array, "drones 9 n"]:
    """F @ matrix: every column, a position, velocity and acceleration, `dt_s` later at constant acceleration."""
    position, velocity, acceleration = matrix[:, :3], matrix[:, 3:6], matrix[:, 6:]
    velocity_later = velocity + dt_s * acceleration
    position_later = position + dt_s * (velocity + dt_s / 2 * acceleration)
    return jnp.concatenate([position_later, velocity_later, acceleration], axis=1)


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
    noise_m2 = _above_rounding(measured_covariance_m2)
    innovation, whiten, nis, excess = _innovation(state, measured_m, noise_m2)
    excess = excess[:, None, None]
    # The innovation's covariance S becomes excess * S: that is what R has to grow by.
    precision = _product(jnp.swapaxes(whiten, 1, 2), whiten) / excess
    noise_m2 = noise_m2 + (excess - 1) * (state.position_covariance_m2 + noise_m2)

    before = jnp.asarray(state.covariance)
    gain = _product(before[:, :, :3], precision)
    correction = (gain * innovation[:, None, :]).sum(axis=-1)
    # I - KH is the identity but for its first three columns. Their topmost block is I - P S^-1 = R S^-1: written so,
    # nothing cancels, however precise the measurement and vague the prediction.
    columns = jnp.concatenate([_product(noise_m2, precision), -gain[:, 3:]], axis=1)
    rows_done = before.at[:, :3].set(0.0) + _product(columns, before[:, :3])
    both_done = rows_done.at[:, :, :3].set(0.0) + _product(rows_done[:, :, :3], jnp.swapaxes(columns, 1, 2))
    after = _symmetric(both_done + _product(_product(gain, noise_m2), jnp.swapaxes(gain, 1, 2)))
    # Velocity and acceleration do cancel, when the second frame tells for the first time what they are.
    least = _ROUNDINGS * jnp.finfo(before.dtype).eps * jnp.diag(jnp.repeat(jnp.array([0.0, 1.0, 1.0]), 3))
    after = after + least * before

    corrected = state_of(state.mean + correction, after)
    return chosen(was_measured, corrected, state), jnp.where(was_measured, nis, jnp.nan)


def log_likelihood(
    state: MotionState, measured_m: Positions, measured_covariance_m2: Covariances
) -> Float[Array, "drones"]:
    """(drones,), logarithm of the density with which each predicted state expects its measurement, m^-3.

    Gaussian up to the gate; beyond it with the larger covariance that `update` uses, so that a wild measurement costs
    as the logarithm of its distance and decides nothing alone.
    """
    _, whiten, nis, excess = _innovation(state, measured_m, _above_rounding(measured_covariance_m2))
    log_root = jnp.log(jnp.diagonal(whiten, axis1=1, axis2=2)).sum(axis=-1)
    return log_root - (nis / excess + 3 * jnp.log(2 * jnp.pi * excess)) / 2


def chosen(which: Bool[Array, "drones"], first: MotionState, second: MotionState) -> MotionState:
    """The states of `first` where `which`, else of `second`."""
    return jax.tree.map(
        lambda one, other: jnp.where(which.reshape(-1, *[1] * (one.ndim - 1)), one, other), first, second
    )


def _innovation(
    state: MotionState, measured_m: Positions, noise_m2: Covariances
) -> tuple[Positions, Covariances, Float[Array, "drones"], Float[Array, "drones"]]:
    """Measured minus predicted, the matrix that whitens it, NIS, and what NIS exceeds the gate by, at least 1."""
    innovation = jnp.asarray(measured_m - state.position_m)
    whiten = _whitening(state.position_covariance_m2 + noise_m2)
    nis = ((whiten * innovation[:, None, :]).sum(axis=-1) ** 2).sum(axis=-1)
    return innovation, whiten, nis, jnp.maximum(nis / GATE_999, 1.0)


def _above_rounding(covariance: Covariances) -> Covariances:
    """The covariance with its least variances held above the rounding of its largest.

    Of a drone that all cameras see from one side one knows millimetres across and metres along. In float32 such a
    matrix may have a negative eigenvalue, which would make any sum with it indefinite sooner or later.
    """
    total = jnp.trace(covariance, axis1=1, axis2=2)[:, None, None]
    return covariance + _ROUNDINGS * jnp.finfo(covariance.dtype).eps * total * jnp.eye(
        3, dtype=covariance.dtype
    )


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
