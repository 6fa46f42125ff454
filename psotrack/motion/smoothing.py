"""Tracks after the fact: what the frames after say of the frames before.

A forward-backward smoother over the motion model of `motion`, errors that last included (H. E. Rauch, F. Tung, C. T.
Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965), and the strength of the jerk
from the measurements themselves. In float64, unlike the tracker: the backward pass inverts covariances, and nobody
waits for it in a frame.
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
from psotrack.motion import kalman
from psotrack.motion.kalman import MotionParams, MotionState

#: Decades of density (m2/s5) that are tried: from a drone that all but hangs in the air to one that is thrown about.
_JERK_DECADES = np.arange(-4.0, 7.0)

#: Then as many about the best, so far apart; over a fifth of a decade the likelihood is as good as a parabola.
_FINER = 0.2

#: How far the density may be off what one expected, in decades, as a standard deviation; some frames outweigh it.
_JERK_PRIOR_DECADES = 1.0


@dataclass(frozen=True)
class Smoothed:
    """Tracks after smoothing, float64. NaN before a drone's first measurement.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: (frames, drones, 3).
        covariance_m2: (frames, drones, 3, 3), of the positions.
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
    """The best estimate of every frame from all measurements, of the frames before and after it.

    What is measured must be what a frame says by itself: the output of a filter has its past in it already, and would
    count twice. A drone begins at its first measurement, at the velocity 0 to within `params`; gaps are bridged from
    both sides, and after the last measurement the drone is predicted. Outliers count less, as in `motion.update`, but
    for the first measurement, which there is nothing to compare with.

    Args:
        time_s: (frames,), increasing.
        measured_m: (frames, drones, 3), world; any value, NaN too, where not measured.
        measured_covariance_m2: (frames, drones, 3, 3), symmetric and positive definite where measured.
        was_measured: (frames, drones).

    Raises:
        InputError: times do not increase, or a measurement is no number or has no positive definite covariance.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    # A scope, not a switch: nothing outside of it computes differently.
    with jax.enable_x64(True):
        parts = _smoothed(*_double((time_s, measured_m, measured_covariance_m2, was_measured, params)))
    return _since_birth(parts, was_measured)


def forward(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    params: MotionParams,
) -> Smoothed:
    """What the frames up to each frame say of it: the filter alone.

    Args, errors and what is NaN are those of `smooth`.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    with jax.enable_x64(True):
        parts = _forward(*_double((time_s, measured_m, measured_covariance_m2, was_measured, params)))
    return _since_birth(parts, was_measured)


def _since_birth(parts: tuple[Array, ...], was_measured: Bool[np.ndarray, "frames drones"]) -> Smoothed:
    """The parts on the host, NaN before a drone's first measurement."""
    states = Smoothed(*(np.array(part) for part in parts))
    unborn = ~np.logical_or.accumulate(was_measured, axis=0)
    for value in vars(states).values():
        value[unborn] = np.nan
    return states


def jerk_density(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    params: MotionParams,
) -> Float[np.ndarray, "drones"]:
    """(drones,), the jerk density under which the measurements are the most plausible, m2/s5.

    The largest likelihood of all innovations (Bar-Shalom et al. 2001, section 11.4), first over decades, then finer
    about the best of them, then by a parabola; times a prior about `params.jerk_density_m2_s5`, which is what a drone
    with hardly any measurement gets. Outliers have long tails (`motion.log_likelihood`) and so do not pass for jerk.
    The covariances must be right: too small ones do pass for jerk.

    Args and errors are those of `smooth`.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    expected = np.log10(np.asarray(params.jerk_density_m2_s5, np.float64))
    drones = np.arange(was_measured.shape[1])
    with jax.enable_x64(True):
        inputs = _double((time_s, measured_m, measured_covariance_m2, was_measured, params))

        def scores(decades: Float[np.ndarray, "tried drones"]) -> Float[np.ndarray, "tried drones"]:
            plausible = np.asarray(_log_likelihoods(*inputs, jnp.asarray(10.0**decades)))
            return plausible - ((decades - expected) / _JERK_PRIOR_DECADES) ** 2 / 2

        decades = np.broadcast_to(_JERK_DECADES[:, None], (len(_JERK_DECADES), len(drones)))
        best = decades[scores(decades).argmax(axis=0), drones]
        around = _JERK_DECADES - _JERK_DECADES.mean()
        decades = best + _FINER * around[:, None]
        score = scores(decades)
    best = np.clip(score.argmax(axis=0), 1, len(decades) - 2)
    below, at, above = (score[best + shift, drones] for shift in (-1, 0, 1))
    # The prior at least bends the score downwards, so that there is a vertex; it is not sought beyond the grid.
    vertex = np.clip((above - below) / 2 / (2 * at - above - below), -1, 1)
    return 10.0 ** (decades[best, drones] + vertex * _FINER)


def check_measurements(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
) -> None:
    """Refuse what no filter can use.

    Args:
        time_s: (frames,), increasing.
        measured_m: (frames, drones, 3), numbers where measured.
        measured_covariance_m2: (frames, drones, 3, 3), symmetric and positive definite where measured.
        was_measured: (frames, drones).

    Raises:
        InputError: it is not so; the first place where, and what was found there.
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


def _double(tree: tuple) -> tuple:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float64), tree)


def _filtered(
    time_s: Array, measured_m: Array, covariance_m2: Array, was_measured: Array, params: MotionParams
) -> tuple[MotionState, MotionState, Array]:
    """Forward pass: predicted and corrected states, and log likelihoods (frames, drones), 0 where none is defined.

    A state is that of the drone's first measurement until there is one.
    """

    def begun(measured: Array, spread: Array) -> MotionState:
        return kalman.init(measured, jnp.zeros_like(measured), spread, params)

    def step(carry: tuple, frame: tuple) -> tuple[tuple, tuple]:
        state, born = carry
        dt_s, measured, spread, there = frame
        predicted = kalman.predict(state, dt_s, params)
        corrected, _ = kalman.update(predicted, measured, spread, there, params)
        plausible = kalman.log_likelihood(predicted, measured, spread, params)
        state = kalman.chosen(born, corrected, begun(measured, spread))
        return (state, born | there), (predicted, state, jnp.where(born & there, plausible, 0.0))

    # What is not measured is never used, but is carried along until a drone is born: it must be a number.
    measured_m = jnp.where(was_measured[..., None], measured_m, 0.0)
    covariance_m2 = jnp.where(was_measured[..., None, None], covariance_m2, jnp.eye(3))
    dt_s = jnp.diff(time_s, prepend=time_s[:1])
    carry = (begun(measured_m[0], covariance_m2[0]), jnp.zeros(was_measured.shape[1], bool))
    _, (predicted, states, plausible) = jax.lax.scan(
        step, carry, (dt_s, measured_m, covariance_m2, was_measured)
    )
    return predicted, states, plausible


@jax.jit
def _forward(
    time_s: Array, measured_m: Array, covariance_m2: Array, was_measured: Array, params: MotionParams
) -> tuple[Array, Array, Array, Array]:
    """Forward pass: positions, velocities, accelerations and covariances of the positions, of all frames."""
    return _seen_of(_filtered(time_s, measured_m, covariance_m2, was_measured, params)[1])


def _seen_of(states: MotionState) -> tuple[Array, Array, Array, Array]:
    return states.position_m, states.velocity_m_s, states.acceleration_m_s2, states.position_covariance_m2


@jax.jit
def _smoothed(
    time_s: Array, measured_m: Array, covariance_m2: Array, was_measured: Array, params: MotionParams
) -> tuple[Array, Array, Array, Array]:
    """Backward pass: positions, velocities, accelerations and covariances of the positions, of all frames."""
    predicted, filtered, _ = _filtered(time_s, measured_m, covariance_m2, was_measured, params)

    def step(later: tuple[Array, Array], frame: tuple) -> tuple[tuple[Array, Array], MotionState]:
        now, ahead, dt_s = frame
        F = kalman.transported(jnp.broadcast_to(jnp.eye(12), now.covariance.shape), dt_s, params)
        gain = _gain(F @ now.covariance, ahead.covariance)
        mean = now.mean + (gain @ (later[0] - ahead.mean)[..., None])[..., 0]
        # P + G (P_later - P_ahead) G^T would be a difference, and negative after many frames. This is a sum.
        kept = jnp.eye(12) - gain @ F
        added = kalman.process_noise(now.noise_m2, dt_s, params) + later[1]
        spread = kept @ now.covariance @ _transpose(kept) + gain @ added @ _transpose(gain)
        spread = (spread + _transpose(spread)) / 2
        return (mean, spread), kalman.state_of(mean, spread, now.noise_m2)

    now, end = (jax.tree.map(itemgetter(rows), filtered) for rows in (slice(-1), -1))
    ahead = jax.tree.map(itemgetter(slice(1, None)), predicted)
    _, earlier = jax.lax.scan(step, (end.mean, end.covariance), (now, ahead, jnp.diff(time_s)), reverse=True)
    states = jax.tree.map(lambda part, last: jnp.concatenate([part, last[None]]), earlier, end)
    return _seen_of(states)


def _gain(moved: Array, ahead: Array) -> Array:
    """(drones, 12, 12), P F^T P_ahead^-1 of `moved`, F P, and `ahead`, P_ahead.

    In units of the standard deviations, so that metres and m/s2 count alike. What has no variance, as the error that
    lasts where errors are white, is known, takes part in nothing, and is not corrected: a 1 in its place on the
    diagonal says so.
    """
    variance = jnp.diagonal(ahead, axis1=-2, axis2=-1)
    known = variance == 0
    unit = jnp.sqrt(jnp.where(known, 1.0, variance))[..., None]
    correlation = ahead / (unit * _transpose(unit)) + jnp.where(known[..., None], jnp.eye(12), 0.0)
    return _transpose(jnp.linalg.solve(correlation, moved / unit) / unit)


def _transpose(matrix: Array) -> Array:
    return jnp.swapaxes(matrix, -1, -2)


@jax.jit
def _log_likelihoods(
    time_s: Array,
    measured_m: Array,
    covariance_m2: Array,
    was_measured: Array,
    params: MotionParams,
    tried: Array,
) -> Array:
    """(tried, drones), of all measurements under each jerk density of `tried`, (tried, drones)."""

    def total(density: Array) -> Array:
        varied = replace(params, jerk_density_m2_s5=density)
        return _filtered(time_s, measured_m, covariance_m2, was_measured, varied)[2].sum(axis=0)

    return jax.vmap(total)(tried)
