"""Smoothed tracks: every frame estimated from all measurements, before and after the frame.

A Rauch-Tung-Striebel smoother (`psotrack.geometry.estimation`) over the motion model of `kalman` with its correlated
errors, and an estimate of the jerk density from the measurements. All computations are in float64, unlike in the
tracker, because the backward pass inverts covariances and its time is not critical.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError
from psotrack.geometry.estimation import backward_step
from psotrack.support import as_written
from psotrack.support.array_types import Array
from psotrack.tracking.motion import kalman
from psotrack.tracking.motion.kalman import MotionParams, MotionState

#: Grid of log10 jerk densities, m²/s⁵: from a drone that hovers to one in violent manoeuvres. Over a step of it the log
#: likelihood is close to a parabola.
_JERK_DECADES = np.linspace(-4.0, 6.0, 31)

#: Standard deviation of the prior on log10 of the density, decades. The data of a few dozen frames outweigh the prior.
_JERK_PRIOR_DECADES = 1.0

#: The values of `Measurements` in a compiled program.
_Measured = tuple[Array, Array, Array, Array, Array]


@dataclass(frozen=True)
class Measurements:
    """Measured positions of drones. Each must come from its own frame alone.

    The output of a filter already contains the earlier frames, which would then count twice.

    Attributes:
        time_s: (frames,), increasing, seconds.
        position_m: (frames, drones, 3), measured positions, world, metres; any value, also NaN, where not measured.
        covariance_m2: (frames, drones, 3, 3), symmetric and positive definite where measured, m².
        was_measured: (frames, drones), True where a drone has a measurement.
        was_lost: (frames, drones), True where a drone is lost: its next measurement begins it anew, because what was
            before tells nothing of it; None where none is lost.
    """

    time_s: Float[np.ndarray, "frames"]
    position_m: Float[np.ndarray, "frames drones 3"]
    covariance_m2: Float[np.ndarray, "frames drones 3 3"]
    was_measured: Bool[np.ndarray, "frames drones"]
    was_lost: Bool[np.ndarray, "frames drones"] | None = None

    def __getitem__(self, frames: slice | Int[np.ndarray, "rows"]) -> Measurements:
        """The measurements in some frames."""
        lost = None if self.was_lost is None else self.was_lost[frames]
        place_m, spread_m2 = self.position_m[frames], self.covariance_m2[frames]
        return Measurements(self.time_s[frames], place_m, spread_m2, self.was_measured[frames], lost)

    @property
    def goes_on(self) -> Bool[np.ndarray, "frames drones"]:
        """(frames, drones), True where a drone was measured before and was not lost since."""
        row = np.arange(len(self.time_s))[:, None]
        lost = np.zeros_like(self.was_measured) if self.was_lost is None else self.was_lost
        measured, lost = (
            np.maximum.accumulate(np.where(happened, row, -1), axis=0)
            for happened in (self.was_measured, lost)
        )
        # What happened in the frame itself does not count.
        return np.concatenate([np.zeros_like(measured[:1], bool), (measured > lost)[:-1]])

    def check(self) -> None:
        """Check that a filter can use the measurements.

        Raises:
            InputError: a requirement is not met; the message names the first place and the value found there.
        """
        if not (np.diff(self.time_s) > 0).all() or not np.isfinite(self.time_s).all():
            raise InputError("time_s", expected="increasing times", found="repeats, steps back or no numbers")
        known = np.isfinite(self.position_m).all(axis=-1) & np.isfinite(self.covariance_m2).all(axis=(-2, -1))
        smallest_m2 = np.linalg.eigvalsh(np.where(known[..., None, None], self.covariance_m2, -np.eye(3)))
        wrong = self.was_measured & (smallest_m2[..., 0] <= 0)
        if wrong.any():
            row, drone = np.argwhere(wrong)[0]
            expected = "a position and a positive definite covariance where it was measured"
            found = f"{self.position_m[row, drone]} m, {self.covariance_m2[row, drone].tolist()} m2"
            raise InputError(f"measurements, row {row}, drone {drone}", expected=expected, found=found)


@dataclass(frozen=True)
class Smoothed:
    """Filtered or smoothed tracks, float64; NaN before a drone's first measurement, and where it is lost.

    Attributes:
        position_m, velocity_m_s, acceleration_m_s2: (frames, drones, 3), world.
        covariance_m2: (frames, drones, 3, 3), covariances of the positions, m².
    """

    position_m: Float[np.ndarray, "frames drones 3"]
    velocity_m_s: Float[np.ndarray, "frames drones 3"]
    acceleration_m_s2: Float[np.ndarray, "frames drones 3"]
    covariance_m2: Float[np.ndarray, "frames drones 3 3"]


def smooth(measured: Measurements, params: MotionParams) -> Smoothed:
    """Estimate every frame from all measurements, before and after the frame.

    A track begins at its first measurement with velocity 0 and the standard deviation of `params`. Gaps are bridged
    from both sides, except where the drone is lost, and after the last measurement the drone is predicted. Outliers
    get less weight, as in `kalman.update`, except for the first measurement, which has no prediction to compare with.

    Raises:
        InputError: as `Measurements.check` says.
    """
    return _estimated(_smoothed, measured, params)


def filter_measurements(measured: Measurements, params: MotionParams) -> Smoothed:
    """Estimate every frame from the measurements up to that frame: the Kalman filter without the backward pass.

    Errors and NaN are as in `smooth`.
    """
    return _estimated(_filter, measured, params)


def last_state(measured: Measurements, params: MotionParams) -> MotionState:
    """The filter's state after the last frame. A drone that was never measured has a state without meaning."""
    with as_written(float64=True):
        return jax.tree.map(np.asarray, _last_state(*_in_float64(measured, params)))


def _estimated(program: Callable, measured: Measurements, params: MotionParams) -> Smoothed:
    """What a compiled program estimates from measurements, on the host."""
    measured.check()
    with as_written(float64=True):
        states = Smoothed(*map(np.array, program(*_in_float64(measured, params))))
    for value in vars(states).values():
        value[~(measured.was_measured | measured.goes_on)] = np.nan
    return states


def estimate_jerk_density(measured: Measurements, params: MotionParams) -> Float[np.ndarray, "drones"]:
    """(drones,), jerk density of the highest posterior probability given the measurements, m²/s⁵.

    The likelihood is that of all innovations (Bar-Shalom et al. 2001, section 11.4). The search tries a grid, then the
    vertex of a parabola. The prior is centred on `params.jerk_density_m2_s5`, so a drone with few measurements keeps
    that value. Outliers do not raise the density, because `kalman.log_likelihood` has long tails. Measurement
    covariances that are too small do raise the density.

    Raises:
        InputError: as `Measurements.check` says.
    """
    measured.check()
    expected = np.log10(np.asarray(params.jerk_density_m2_s5, np.float64))
    drones = np.arange(len(expected))

    decades = np.tile(_JERK_DECADES[:, None], len(drones))
    with as_written(float64=True):
        found = np.asarray(_log_likelihoods(*_in_float64(measured, params), 10.0**decades))
    score = found - ((decades - expected) / _JERK_PRIOR_DECADES) ** 2 / 2
    best = np.clip(score.argmax(axis=0), 1, len(decades) - 2)
    below, at, above = (score[best + shift, drones] for shift in (-1, 0, 1))
    # The prior makes the score concave, so a vertex exists. The search stays within one grid step.
    vertex = np.clip((above - below) / 2 / (2 * at - above - below), -1, 1)
    return 10.0 ** (_JERK_DECADES[best] + vertex * (_JERK_DECADES[1] - _JERK_DECADES[0]))


def _in_float64(measured: Measurements, params: MotionParams) -> tuple[_Measured, MotionParams]:
    """Arguments of the compiled programs."""
    values = (
        measured.time_s,
        measured.position_m,
        measured.covariance_m2,
        measured.was_measured,
        measured.goes_on,
    )
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float64), (values, params)
    )


def _filtered(measured: _Measured, params: MotionParams) -> tuple[MotionState, MotionState, Array]:
    """Run the filter: predicted states, corrected states, and log likelihoods (frames, drones).

    Before a drone's measurements its state has no meaning; the log likelihood of the first of them is 0.
    """

    def initial(position: Array, covariance: Array) -> MotionState:
        return kalman.init(position, jnp.zeros_like(position), covariance, params)

    def step(state: MotionState, frame: tuple) -> tuple[MotionState, tuple]:
        dt_s, position, covariance, is_measured, goes_on = frame
        predicted = kalman.predict(state, dt_s, params)
        corrected, _ = kalman.update(predicted, position, covariance, is_measured, params)
        log_density = kalman.log_likelihood(predicted, position, covariance, params)
        state = kalman.select_drones(goes_on, corrected, initial(position, covariance))
        log_density = jnp.where(goes_on & is_measured, log_density, 0.0)
        return state, (predicted, state, log_density)

    # The scan carries these values along before a drone's first measurement, so they must be finite.
    time_s, position_m, covariance_m2, was_measured, goes_on = measured
    position_m = jnp.where(was_measured[..., None], position_m, 0.0)
    covariance_m2 = jnp.where(was_measured[..., None, None], covariance_m2, jnp.eye(3))
    first = initial(position_m[0], covariance_m2[0])
    dt_s = jnp.diff(time_s, prepend=time_s[:1])
    return jax.lax.scan(step, first, (dt_s, position_m, covariance_m2, was_measured, goes_on))[1]


def _without_error(states: MotionState) -> tuple[Array, ...]:
    """The values of `Smoothed`: states without the correlated error."""
    return states.position_m, states.velocity_m_s, states.acceleration_m_s2, states.position_covariance_m2


@jax.jit
def _filter(measured: _Measured, params: MotionParams) -> tuple[Array, ...]:
    """Filtered states of all frames."""
    return _without_error(_filtered(measured, params)[1])


@jax.jit
def _last_state(measured: _Measured, params: MotionParams) -> MotionState:
    return jax.tree.map(itemgetter(-1), _filtered(measured, params)[1])


@jax.jit
def _smoothed(measured: _Measured, params: MotionParams) -> tuple[Array, ...]:
    """Smoothed states of all frames."""
    predicted, filtered, _ = _filtered(measured, params)

    def step(later: tuple[Array, Array], frame: tuple) -> tuple[tuple[Array, Array], MotionState]:
        state, next_predicted, dt_s, goes_on = frame
        change, covariance = backward_step(
            state.covariance,
            kalman.apply_transition(jnp.broadcast_to(jnp.eye(12), state.covariance.shape), dt_s, params),
            kalman.process_noise(state.noise_m2, dt_s, params),
            next_predicted.covariance,
            later[1],
            (later[0] - next_predicted.mean)[..., None],
        )
        # Nothing comes back from a frame in which the drone begins anew, or is lost.
        mean = state.mean + jnp.where(goes_on[:, None], change[..., 0], 0.0)
        covariance = jnp.where(goes_on[:, None, None], covariance, state.covariance)
        return (mean, covariance), kalman.state_from_mean(mean, covariance, state.noise_m2)

    earlier, last = (jax.tree.map(itemgetter(rows), filtered) for rows in (slice(-1), -1))
    next_predicted = jax.tree.map(itemgetter(slice(1, None)), predicted)
    _, smoothed = jax.lax.scan(
        step,
        (last.mean, last.covariance),
        (earlier, next_predicted, jnp.diff(measured[0]), measured[4][1:]),
        reverse=True,
    )
    return _without_error(jax.tree.map(lambda part, end: jnp.concatenate([part, end[None]]), smoothed, last))


@jax.jit
def _log_likelihoods(measured: _Measured, params: MotionParams, densities: Array) -> Array:
    """(tried, drones), log likelihood of all measurements under each jerk density of `densities`, (tried, drones)."""

    def total(density: Array) -> Array:
        varied = replace(params, jerk_density_m2_s5=density)
        return _filtered(measured, varied)[2].sum(axis=0)

    return jax.vmap(total)(densities)
