"""Smoothed tracks: every frame estimated from all measurements, before and after the frame.

A Rauch-Tung-Striebel smoother (`psotrack.estimation`) over the motion model of `kalman` with its lasting errors, and
an estimate of the jerk density from the measurements. All computations are in float64, unlike in the tracker, because
the backward pass inverts covariances and its time is not critical.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack._typing import Array
from psotrack.errors import InputError
from psotrack.estimation import backward_step
from psotrack.motion import kalman
from psotrack.motion.kalman import MotionParams, MotionState
from psotrack.support import stored_jit

#: Grid of log10 jerk densities, m²/s⁵: from a drone that hovers to one in violent manoeuvres.
_JERK_DECADES = np.arange(-4.0, 7.0)

#: Step of the second, finer grid, decades. Over this step the log likelihood is close to a parabola.
_FINER_STEP = 0.2

#: Standard deviation of the prior on log10 of the density, decades. The data of a few dozen frames outweigh the prior.
_JERK_PRIOR_DECADES = 1.0


@dataclass(frozen=True)
class Smoothed:
    """Filtered or smoothed tracks, float64; NaN before a drone's first measurement.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: (frames, drones, 3), world.
        covariance_m2: (frames, drones, 3, 3), covariances of the positions, m².
    """

    position_m: Float[np.ndarray, "frames drones 3"]
    velocity_m_s: Float[np.ndarray, "frames drones 3"]
    acceleration_m_s2: Float[np.ndarray, "frames drones 3"]
    covariance_m2: Float[np.ndarray, "frames drones 3 3"]


def smooth(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    params: MotionParams,
) -> Smoothed:
    """Estimate every frame from all measurements, before and after the frame.

    Each measurement must come from its own frame alone. The output of a filter already contains the earlier frames,
    which would then count twice. A track begins at its first measurement with velocity 0 and the standard deviation of
    `params`. Gaps are bridged from both sides, and after the last measurement the drone is predicted. Outliers get less
    weight, as in `kalman.update`, except for the first measurement, which has no prediction to compare with.

    Args:
        time_s: (frames,), increasing, seconds.
        measured_m: (frames, drones, 3), measured positions, world, metres; any value, also NaN, where not measured.
        measured_covariance_m2: (frames, drones, 3, 3), symmetric and positive definite where measured, m².
        was_measured: (frames, drones), True where a drone has a measurement.
        params: parameters of the motion model.

    Raises:
        InputError: times do not increase, or a measurement is not finite, or its covariance not positive definite.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    # The context manager limits float64 to this call.
    with jax.enable_x64(True):
        parts = _smoothed(*_to_float64((time_s, measured_m, measured_covariance_m2, was_measured, params)))
    return _mask_before_first(parts, was_measured)


def filter_measurements(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    params: MotionParams,
) -> Smoothed:
    """Estimate every frame from the measurements up to that frame: the Kalman filter without the backward pass.

    Arguments, errors and NaN are as in `smooth`.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    with jax.enable_x64(True):
        parts = _filter(*_to_float64((time_s, measured_m, measured_covariance_m2, was_measured, params)))
    return _mask_before_first(parts, was_measured)


def _mask_before_first(parts: tuple[Array, ...], was_measured: Bool[np.ndarray, "frames drones"]) -> Smoothed:
    """Move the results to the host, and set NaN before each drone's first measurement."""
    states = Smoothed(*(np.array(part) for part in parts))
    not_begun = ~np.logical_or.accumulate(was_measured, axis=0)
    for value in vars(states).values():
        value[not_begun] = np.nan
    return states


def estimate_jerk_density(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    params: MotionParams,
) -> Float[np.ndarray, "drones"]:
    """(drones,), jerk density of the highest posterior probability given the measurements, m²/s⁵.

    The likelihood is that of all innovations (Bar-Shalom et al. 2001, section 11.4). The search tries decades, then a
    finer grid around the best decade, then the vertex of a parabola. The prior is centred on
    `params.jerk_density_m2_s5`, so a drone with few measurements keeps that value. Outliers do not raise the density,
    because `kalman.log_likelihood` has long tails. Measurement covariances that are too small do raise the density.

    Arguments and errors are as in `smooth`.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    expected = np.log10(np.asarray(params.jerk_density_m2_s5, np.float64))
    drones = np.arange(was_measured.shape[1])
    with jax.enable_x64(True):
        inputs = _to_float64((time_s, measured_m, measured_covariance_m2, was_measured, params))

        def scores(decades: Float[np.ndarray, "tried drones"]) -> Float[np.ndarray, "tried drones"]:
            log_likelihood = np.asarray(_log_likelihoods(*inputs, jnp.asarray(10.0**decades)))
            return log_likelihood - ((decades - expected) / _JERK_PRIOR_DECADES) ** 2 / 2

        decades = np.broadcast_to(_JERK_DECADES[:, None], (len(_JERK_DECADES), len(drones)))
        best = decades[scores(decades).argmax(axis=0), drones]
        around = _JERK_DECADES - _JERK_DECADES.mean()
        decades = best + _FINER_STEP * around[:, None]
        score = scores(decades)
    best = np.clip(score.argmax(axis=0), 1, len(decades) - 2)
    below, at, above = (score[best + shift, drones] for shift in (-1, 0, 1))
    # The prior makes the score concave, so a vertex exists. The search stays within one grid step.
    vertex = np.clip((above - below) / 2 / (2 * at - above - below), -1, 1)
    return 10.0 ** (decades[best, drones] + vertex * _FINER_STEP)


def check_measurements(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
) -> None:
    """Check that a filter can use the measurements.

    Args:
        time_s: (frames,), increasing, seconds.
        measured_m: (frames, drones, 3), finite where measured.
        measured_covariance_m2: (frames, drones, 3, 3), symmetric and positive definite where measured.
        was_measured: (frames, drones), True where a drone has a measurement.

    Raises:
        InputError: a requirement is not met; the message names the first place and the value found there.
    """
    if not (np.diff(time_s) > 0).all() or not np.isfinite(time_s).all():
        raise InputError("time_s", expected="increasing times", found="repeats, steps back or no numbers")
    for name, value in (("measured_m", measured_m), ("measured_covariance_m2", measured_covariance_m2)):
        wrong = was_measured & ~np.isfinite(value).all(axis=tuple(range(2, value.ndim)))
        if wrong.any():
            row, drone = np.argwhere(wrong)[0]
            where = f"{name}, row {row}, drone {drone}"
            raise InputError(where, expected="numbers where it was measured", found=f"{value[row, drone]}")
    smallest_m2 = np.linalg.eigvalsh(
        np.where(was_measured[..., None, None], measured_covariance_m2, np.eye(3))
    )[..., 0]
    if not (smallest_m2 > 0).all():
        row, drone = np.unravel_index(smallest_m2.argmin(), smallest_m2.shape)
        raise InputError(
            f"measured_covariance_m2, row {row}, drone {drone}",
            expected="a positive definite covariance",
            found=f"one whose least eigenvalue is {smallest_m2.min():.3g} m2",
        )


def _to_float64(tree: tuple) -> tuple:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float64), tree)


def _filtered(
    time_s: Array, measured_m: Array, covariance_m2: Array, was_measured: Array, params: MotionParams
) -> tuple[MotionState, MotionState, Array]:
    """Run the filter: predicted states, corrected states, and log likelihoods (frames, drones).

    Before a drone's first measurement its state has no meaning; the log likelihood is 0 up to that measurement.
    """

    def initial(measured: Array, covariance: Array) -> MotionState:
        return kalman.init(measured, jnp.zeros_like(measured), covariance, params)

    def step(carry: tuple, frame: tuple) -> tuple[tuple, tuple]:
        state, has_begun = carry
        dt_s, measured, covariance, is_measured = frame
        predicted = kalman.predict(state, dt_s, params)
        corrected, _ = kalman.update(predicted, measured, covariance, is_measured, params)
        log_density = kalman.log_likelihood(predicted, measured, covariance, params)
        state = kalman.select_drones(has_begun, corrected, initial(measured, covariance))
        log_density = jnp.where(has_begun & is_measured, log_density, 0.0)
        return (state, has_begun | is_measured), (predicted, state, log_density)

    # The scan carries these values along before a drone's first measurement, so they must be finite.
    measured_m = jnp.where(was_measured[..., None], measured_m, 0.0)
    covariance_m2 = jnp.where(was_measured[..., None, None], covariance_m2, jnp.eye(3))
    dt_s = jnp.diff(time_s, prepend=time_s[:1])
    carry = (initial(measured_m[0], covariance_m2[0]), jnp.zeros(was_measured.shape[1], bool))
    _, (predicted, states, log_densities) = jax.lax.scan(
        step, carry, (dt_s, measured_m, covariance_m2, was_measured)
    )
    return predicted, states, log_densities


@stored_jit
def _filter(
    time_s: Array, measured_m: Array, covariance_m2: Array, was_measured: Array, params: MotionParams
) -> tuple[Array, Array, Array, Array]:
    """Filtered positions, velocities, accelerations, and covariances of the positions, of all frames."""
    return _without_error(_filtered(time_s, measured_m, covariance_m2, was_measured, params)[1])


def _without_error(states: MotionState) -> tuple[Array, Array, Array, Array]:
    """Positions, velocities, accelerations, and covariances of the positions, without the lasting error."""
    return states.position_m, states.velocity_m_s, states.acceleration_m_s2, states.position_covariance_m2


@stored_jit
def _smoothed(
    time_s: Array, measured_m: Array, covariance_m2: Array, was_measured: Array, params: MotionParams
) -> tuple[Array, Array, Array, Array]:
    """Smoothed positions, velocities, accelerations, and covariances of the positions, of all frames."""
    predicted, filtered, _ = _filtered(time_s, measured_m, covariance_m2, was_measured, params)

    def step(later: tuple[Array, Array], frame: tuple) -> tuple[tuple[Array, Array], MotionState]:
        state, next_predicted, dt_s = frame
        change, covariance = backward_step(
            state.covariance,
            kalman.apply_transition(jnp.broadcast_to(jnp.eye(12), state.covariance.shape), dt_s, params),
            kalman.process_noise(state.noise_m2, dt_s, params),
            next_predicted.covariance,
            later[1],
            (later[0] - next_predicted.mean)[..., None],
        )
        mean = state.mean + change[..., 0]
        return (mean, covariance), kalman.state_from_mean(mean, covariance, state.noise_m2)

    earlier, last = (jax.tree.map(itemgetter(rows), filtered) for rows in (slice(-1), -1))
    next_predicted = jax.tree.map(itemgetter(slice(1, None)), predicted)
    _, smoothed = jax.lax.scan(
        step, (last.mean, last.covariance), (earlier, next_predicted, jnp.diff(time_s)), reverse=True
    )
    states = jax.tree.map(lambda part, end: jnp.concatenate([part, end[None]]), smoothed, last)
    return _without_error(states)


@stored_jit
def _log_likelihoods(
    time_s: Array,
    measured_m: Array,
    covariance_m2: Array,
    was_measured: Array,
    params: MotionParams,
    densities: Array,
) -> Array:
    """(tried, drones), log likelihood of all measurements under each jerk density of `densities`, (tried, drones)."""

    def total(density: Array) -> Array:
        varied = replace(params, jerk_density_m2_s5=density)
        return _filtered(time_s, measured_m, covariance_m2, was_measured, varied)[2].sum(axis=0)

    return jax.vmap(total)(densities)
