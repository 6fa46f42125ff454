"""A Kalman filter for the motion of drones: position, velocity and acceleration, with one filter for each drone.

The jerk, the derivative of the acceleration, is white noise: the Wiener-process acceleration model of Y. Bar-Shalom,
X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2.3. The model is
discretised exactly, so the time between frames may vary. `predict` takes a state to the next frame, and `update`
corrects the state by a measured position and its covariance. In a gap a caller only predicts, and the uncertainty
grows. All functions are pure and batched over drones. They avoid LAPACK, whose calls cost more than the arithmetic.

Measurement errors are similar in neighbouring frames, because a drone's silhouette changes only as the drone turns. A
filter that treats such errors as white becomes overconfident. Therefore a share of each measurement's covariance is
modelled as a correlated error: a first-order Gauss-Markov process that is part of the state (autocorrelated measurement
noise: Bar-Shalom et al. 2001, chapter 8). The rest of the covariance is white noise. The state holds the apparent
position, which is the drone's position plus the correlated error. Measurements observe the apparent position directly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack.settings import MotionSettings
from psotrack.support import as_written
from psotrack.support.array_types import Array, Positions

#: The chi-square distribution with 3 degrees of freedom is below this with probability 0.999.
GATE_999 = 16.266236196238

#: Time constant with which an unseen drone's acceleration decays, seconds. This value predicts best over gaps of 0.5
#: to 2 s in simulated flights.
ACCELERATION_TIME_S = 0.5

#: Smallest variance that is kept, in rounding units (machine epsilon) of the largest variance in its computation.
_ROUNDINGS = 8

#: Largest variance of a correlated error, summed over the axes, m². Larger values would cost float32 positions their
#: millimetres by rounding.
_LARGEST_ERROR_M2 = 3e2

Covariances = Float[Array, "drones 3 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionParams:
    """Parameters of the motion model. All values may change between calls without a new compilation.

    Attributes:
        jerk_density_m2_s5: (drones,), power spectral density of the jerk along each axis, m²/s⁵: after t seconds the
            standard deviation of the change of acceleration is sqrt(density * t).
        velocity_std_m_s: standard deviation of the initial velocity along each axis, m/s.
        acceleration_std_m_s2: standard deviation of the initial acceleration along each axis, m/s²; its mean is 0.
        error_share: share of a measurement's covariance that belongs to the correlated error: from 0 (all errors are
            white) to below 1.
        error_time_s: time constant of the correlated error's exponential decay, seconds, above 0.
    """

    jerk_density_m2_s5: Float[Array, "drones"]
    velocity_std_m_s: Float[Array, ""]
    acceleration_std_m_s2: Float[Array, ""]
    error_share: Float[Array, ""]
    error_time_s: Float[Array, ""]


@as_written()
def motion_params(settings: MotionSettings, num_drones: int) -> MotionParams:
    """Parameters of the motion model for `num_drones` drones, as float32 arrays."""
    return MotionParams(
        jerk_density_m2_s5=np.full(num_drones, settings.jerk_density, np.float32),
        velocity_std_m_s=np.asarray(settings.velocity_std_m_s, np.float32),
        acceleration_std_m_s2=np.asarray(settings.acceleration_std_m_s2, np.float32),
        error_share=np.asarray(settings.error_share, np.float32),
        error_time_s=np.asarray(settings.error_time_s, np.float32),
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionState:
    """The filter's state of every drone at one time.

    Attributes:
        apparent_m: (drones, 3), mean apparent position, which is the position plus the correlated error, world, metres.
        velocity_m_s, acceleration_m_s2: (drones, 3), mean velocity and acceleration, world.
        error_m: (drones, 3), mean correlated error, world, metres.
        covariance: (drones, 12, 12), joint covariance of these four vectors in this order.
        noise_m2: (drones, 3, 3), covariance of the last measurement, white noise and correlated error together, limited
            in size. New correlated errors get a share of this covariance.
    """

    apparent_m: Float[Array, "*frames drones 3"]
    velocity_m_s: Float[Array, "*frames drones 3"]
    acceleration_m_s2: Float[Array, "*frames drones 3"]
    error_m: Float[Array, "*frames drones 3"]
    covariance: Float[Array, "*frames drones 12 12"]
    noise_m2: Float[Array, "*frames drones 3 3"]

    @property
    def position_m(self) -> Float[Array, "*frames drones 3"]:
        """(drones, 3), positions of the drones without the correlated error, world, metres."""
        return self.apparent_m - self.error_m

    @property
    def position_covariance_m2(self) -> Float[Array, "*frames drones 3 3"]:
        """(drones, 3, 3), covariance of `position_m`, m²."""
        apparent, error = self.covariance[..., :3, :3], self.covariance[..., 9:, 9:]
        both = self.covariance[..., :3, 9:]
        largest = apparent.trace(axis1=-2, axis2=-1) + error.trace(axis1=-2, axis2=-1)
        # This is a small difference of large numbers if the position is known well and the correlated error is not.
        return _above_rounding(apparent + error - (both + both.swapaxes(-1, -2)), largest)

    @property
    def mean(self) -> Float[Array, "*frames drones 12"]:
        """(drones, 12), apparent position, velocity, acceleration and error as one vector."""
        parts = (self.apparent_m, self.velocity_m_s, self.acceleration_m_s2, self.error_m)
        return jnp.concatenate([jnp.asarray(part) for part in parts], axis=-1)


def state_from_mean(
    mean: Float[Array, "*frames drones 12"],
    covariance: Float[Array, "*frames drones 12 12"],
    noise_m2: Float[Array, "*frames drones 3 3"],
) -> MotionState:
    """Make a state from a mean in the order of `MotionState.mean`, its covariance, and the last measurement's noise."""
    return MotionState(mean[..., :3], mean[..., 3:6], mean[..., 6:9], mean[..., 9:], covariance, noise_m2)


def init(
    position_m: Positions, velocity_m_s: Positions, position_covariance_m2: Covariances, params: MotionParams
) -> MotionState:
    """Make the initial state of drones from their first positions and velocities.

    The position is treated as a measurement: a share of its covariance belongs to the correlated error.

    Args:
        position_m: (drones, 3), world, metres.
        velocity_m_s: (drones, 3), world; its standard deviation is `params.velocity_std_m_s`.
        position_covariance_m2: (drones, 3, 3), m².
        params: parameters of the motion model.
    """
    covariance_m2 = _with_variance_floor(position_covariance_m2)
    correlated_weight = _correlated_weight(covariance_m2)
    error_m2 = params.error_share * correlated_weight * covariance_m2
    # The rest of the covariance is an error of the apparent position that is independent of the correlated error.
    rest_m2 = (1 - params.error_share * correlated_weight) * covariance_m2
    known = jnp.pad(rest_m2, ((0, 0), (0, 9), (0, 9))) + jnp.pad(error_m2, ((0, 0), (9, 0), (9, 0)))
    zero = jnp.zeros_like(params.error_share)
    spread = jnp.stack([zero, params.velocity_std_m_s, params.acceleration_std_m_s2, zero])
    return MotionState(
        apparent_m=position_m,
        velocity_m_s=velocity_m_s,
        acceleration_m_s2=jnp.zeros_like(position_m),
        error_m=jnp.zeros_like(position_m),
        covariance=known + jnp.diag(jnp.repeat(spread**2, 3)),
        noise_m2=correlated_weight * covariance_m2,
    )


def predict(state: MotionState, dt_s: Float[Array, ""], params: MotionParams) -> MotionState:
    """Predict the state `dt_s` seconds later: F x and F P Fᵀ + Q with F and Q in closed form; `dt_s` is at least 0."""
    mean = apply_transition(state.mean[..., None], dt_s, params)[..., 0]
    # F P Fᵀ = F (F P)ᵀ, because P is symmetric.
    spread = apply_transition(
        jnp.swapaxes(apply_transition(state.covariance, dt_s, params), 1, 2), dt_s, params
    )
    covariance = _symmetric(spread + process_noise(state.noise_m2, dt_s, params))
    return state_from_mean(mean, covariance, state.noise_m2)


def apply_transition(
    matrix: Float[Array, "drones 12 n"], dt_s: Float[Array, ""], params: MotionParams
) -> Float[Array, "drones 12 n"]:
    """Return F @ matrix: each column is a state in the order of `MotionState.mean`, taken `dt_s` seconds ahead."""
    apparent, velocity, acceleration, error = (matrix[:, 3 * k : 3 * k + 3] for k in range(4))
    decayed = -jnp.expm1(-dt_s / params.error_time_s) * error
    velocity_later = velocity + dt_s * acceleration
    apparent_later = apparent + dt_s * (velocity + dt_s / 2 * acceleration) - decayed
    return jnp.concatenate([apparent_later, velocity_later, acceleration, error - decayed], axis=1)


def process_noise(
    noise_m2: Covariances, dt_s: Float[Array, ""], params: MotionParams
) -> Float[Array, "drones 12 12"]:
    """(drones, 12, 12), process noise Q of `dt_s` seconds: white jerk, and the new part of the correlated error."""
    jerk = params.jerk_density_m2_s5[:, None, None] * jnp.kron(white_jerk_noise(dt_s), jnp.eye(3))
    new_error = -jnp.expm1(-2 * dt_s / params.error_time_s) * params.error_share * noise_m2
    # The correlated error is a part of the apparent position too.
    both = jnp.array([1.0, 0.0, 0.0, 1.0])
    return jnp.pad(jerk, ((0, 0), (0, 3), (0, 3))) + jnp.kron(jnp.outer(both, both), new_error)


def white_jerk_noise(dt_s: float | Float[Array, ""]) -> Float[Array, "3 3"]:
    """(3, 3), covariance of position, velocity and acceleration along one axis after `dt_s` of unit white jerk.

    The integral over s from 0 to dt of g gᵀ with g = (s² / 2, s, 1): Bar-Shalom et al. 2001, section 6.2.3. Its lower
    right (2, 2) block is the noise of an angle and its rate under unit white angular acceleration.
    """
    xp = np if isinstance(dt_s, float | np.ndarray) else jnp
    one, two, three, four, five = (dt_s**power / divisor for power, divisor in enumerate((1, 2, 6, 8, 20), 1))
    return xp.stack(
        [xp.stack([five, four, three]), xp.stack([four, 2 * three, two]), xp.stack([three, two, one])]
    )


def update(
    state: MotionState,
    measured_m: Positions,
    measured_covariance_m2: Covariances,
    was_measured: Bool[Array, "drones"],
    params: MotionParams,
) -> tuple[MotionState, Float[Array, "drones"]]:
    """Correct the state by measured positions; drones without a measurement keep their state.

    The covariance takes Joseph's form, (I - KH) P (I - KH)ᵀ + K R Kᵀ, which stays positive definite in float32.

    A measurement far from the prediction is more likely an outlier than a jump of the drone. A measurement beyond
    `GATE_999` therefore gets a larger covariance, with which its normalised innovation lies just at the gate: the
    farther the measurement, the smaller its weight. The filter still follows a drone that really jumped, within about
    a second and with overshoot. If a caller knows that the drone is elsewhere, `init` is the better choice.

    Args:
        state: the predicted state.
        measured_m: (drones, 3), measured positions, world, metres; any value, also NaN, where not measured.
        measured_covariance_m2: (drones, 3, 3), symmetric and positive definite where measured, m².
        was_measured: (drones,), True where a drone has a measurement.
        params: parameters of the motion model.

    Returns:
        The corrected state, and NIS (drones,): the squared innovation, normalised by its covariance without the gate.
        Its mean is 3 if the covariances are right. NaN where not measured.
    """
    noise_m2 = _with_variance_floor(measured_covariance_m2)
    white_m2 = (1 - params.error_share) * noise_m2
    innovation, whiten, nis, excess = _innovation(state, measured_m, white_m2)
    excess = excess[:, None, None]
    before = jnp.asarray(state.covariance)
    # The innovation's covariance S becomes excess * S, so R grows by (excess - 1) S.
    precision = _product(jnp.swapaxes(whiten, 1, 2), whiten) / excess
    white_m2 = white_m2 + (excess - 1) * (before[:, :3, :3] + white_m2)

    gain = _product(before[:, :, :3], precision)
    correction = (gain * innovation[:, None, :]).sum(axis=-1)
    # I - KH differs from the identity in its first three columns. Their top block is I - P S⁻¹ = R S⁻¹. The right-hand
    # form has no cancellation, even for a precise measurement of a vague prediction.
    columns = jnp.concatenate([_product(white_m2, precision), -gain[:, 3:]], axis=1)
    rows_done = before.at[:, :3].set(0.0) + _product(columns, before[:, :3])
    both_done = rows_done.at[:, :, :3].set(0.0) + _product(rows_done[:, :, :3], jnp.swapaxes(columns, 1, 2))
    after = _symmetric(both_done + _product(_product(gain, white_m2), jnp.swapaxes(gain, 1, 2)))
    # The other rows do cancel, for example in the second frame, which determines velocity and acceleration first.
    other_rows = jnp.repeat(jnp.array([0.0, 1.0, 1.0, 1.0]), 3)
    least = _ROUNDINGS * jnp.finfo(before.dtype).eps * jnp.diag(other_rows)
    after = after + least * before

    corrected = state_from_mean(state.mean + correction, after, _correlated_weight(noise_m2) * noise_m2)
    return select_drones(was_measured, corrected, state), jnp.where(was_measured, nis, jnp.nan)


def log_likelihood(
    state: MotionState, measured_m: Positions, measured_covariance_m2: Covariances, params: MotionParams
) -> Float[Array, "drones"]:
    """(drones,), logarithm of each measurement's probability density under the predicted state, density in m⁻³.

    The density is Gaussian up to the gate. Beyond the gate it has the larger covariance that `update` uses, so the
    penalty of an outlier grows only with the logarithm of its distance.
    """
    white_m2 = (1 - params.error_share) * _with_variance_floor(measured_covariance_m2)
    _, whiten, nis, excess = _innovation(state, measured_m, white_m2)
    log_root = jnp.log(jnp.diagonal(whiten, axis1=1, axis2=2)).sum(axis=-1)
    return log_root - (nis / excess + 3 * jnp.log(2 * jnp.pi * excess)) / 2


def limit_motion(
    state: MotionState,
    unseen: Bool[Array, "drones"],
    lost: Bool[Array, "drones"],
    *,
    dt_s: Float[Array, ""],
    bounds_m: Float[Array, "2 3"],
    max_speed_m_s: Float[Array, ""],
) -> MotionState:
    """Limit a state to what is possible: inside the room, not too fast; unseen drones fly straighter, lost drones rest.

    Args:
        state: the state after a frame.
        unseen: (drones,), True where the frame had no measurement; the acceleration decays there.
        lost: (drones,), True where the track is lost; velocity and acceleration are set to 0 there.
        dt_s: time since the previous frame, seconds.
        bounds_m: (2, 3), lower and upper corner of the room, world, metres.
        max_speed_m_s: largest speed of a drone, m/s.
    """
    at_rest = lost[:, None]
    kept_acceleration = jnp.where(unseen, jnp.exp(-dt_s / ACCELERATION_TIME_S), 1.0)[:, None]
    speed = jnp.linalg.norm(state.velocity_m_s, axis=-1, keepdims=True)
    velocity = state.velocity_m_s * jnp.minimum(1.0, max_speed_m_s / jnp.maximum(speed, 1e-9))
    return replace(
        state,
        apparent_m=jnp.clip(state.apparent_m, *bounds_m),
        velocity_m_s=jnp.where(at_rest, 0.0, velocity),
        acceleration_m_s2=jnp.where(at_rest, 0.0, kept_acceleration * state.acceleration_m_s2),
    )


def select_drones(which: Bool[Array, "drones"], first: MotionState, second: MotionState) -> MotionState:
    """Take each drone's state from `first` where `which` is True, and from `second` elsewhere."""
    return jax.tree.map(
        lambda one, other: jnp.where(which.reshape(-1, *[1] * (one.ndim - 1)), one, other), first, second
    )


def _innovation(
    state: MotionState, measured_m: Positions, white_m2: Covariances
) -> tuple[Positions, Covariances, Float[Array, "drones"], Float[Array, "drones"]]:
    """Innovation, the matrix that whitens it, NIS, and the ratio of NIS to the gate, which is at least 1."""
    innovation = jnp.asarray(measured_m - state.apparent_m)
    whiten = _whitening(state.covariance[:, :3, :3] + white_m2)
    nis = ((whiten * innovation[:, None, :]).sum(axis=-1) ** 2).sum(axis=-1)
    return innovation, whiten, nis, jnp.maximum(nis / GATE_999, 1.0)


def _with_variance_floor(covariance: Covariances) -> Covariances:
    """Raise the smallest variances of a covariance above the rounding error of its largest variance.

    If all cameras see a drone from one side, its position is known to millimetres across the view and to metres along
    it. In float32 such a matrix can have a negative eigenvalue, and later sums with it would become indefinite.
    """
    return _above_rounding(covariance, covariance.trace(axis1=-2, axis2=-1))


def _correlated_weight(covariance: Covariances) -> Float[Array, "drones 1 1"]:
    """(drones, 1, 1), factor up to 1 that limits the part of a covariance from which correlated errors are drawn.

    Without the limit, a measurement of almost no information would leave a correlated error of kilometres.
    """
    return jnp.minimum(1.0, _LARGEST_ERROR_M2 / covariance.trace(axis1=-2, axis2=-1))[:, None, None]


def _above_rounding(
    covariance: Float[Array, "*frames drones 3 3"], largest_m2: Float[Array, "*frames drones"]
) -> Float[Array, "*frames drones 3 3"]:
    """Add a few rounding units of `largest_m2` to the diagonal of a covariance."""
    least_m2 = _ROUNDINGS * jnp.finfo(covariance.dtype).eps * largest_m2
    return covariance + least_m2[..., None, None] * np.eye(3, dtype=covariance.dtype)


def _whitening(covariance: Covariances) -> Covariances:
    """(drones, 3, 3), the inverse W of the Cholesky factor: W C Wᵀ = I."""
    l_xx = jnp.sqrt(covariance[:, 0, 0])
    l_yx, l_zx = covariance[:, 1, 0] / l_xx, covariance[:, 2, 0] / l_xx
    l_yy = jnp.sqrt(covariance[:, 1, 1] - l_yx**2)
    l_zy = (covariance[:, 2, 1] - l_zx * l_yx) / l_yy
    l_zz = jnp.sqrt(covariance[:, 2, 2] - l_zx**2 - l_zy**2)
    w_yx = -l_yx / (l_xx * l_yy)
    w_zx = -(l_zx / l_xx + l_zy * w_yx) / l_zz
    w_zy = -l_zy / (l_yy * l_zz)
    zero = jnp.zeros_like(l_xx)
    rows = ((1 / l_xx, zero, zero), (w_yx, 1 / l_yy, zero), (w_zx, w_zy, 1 / l_zz))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=1)


def _product(
    left: Float[Array, "drones m 3"], right: Float[Array, "drones 3 n"]
) -> Float[Array, "drones m n"]:
    """Return left @ right as three outer products, because XLA fuses them with the surrounding operations."""
    outer = (left[:, :, k, None] * right[:, None, k, :] for k in range(3))
    return next(outer) + next(outer) + next(outer)


def _symmetric(matrix: Float[Array, "drones n n"]) -> Float[Array, "drones n n"]:
    return (matrix + jnp.swapaxes(matrix, 1, 2)) / 2
