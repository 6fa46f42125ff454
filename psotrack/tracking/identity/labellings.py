"""The two labellings of two drones that met: labels kept, or exchanged, each with motion states of its own.

Near tracks may swap their drones between two frames, so the labelling is the hidden state of a Markov chain. Each step
computes the probability of every pair of labellings before and after the frame. States with the same labelling after
the frame are merged into one state of equal mean and covariance: the generalised pseudo-Bayesian filter of second
order, Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section
11.6.5. The probabilities of earlier labellings given later frames follow from the same weights in backward order: C.-J.
Kim, Dynamic linear models with Markov-switching, Journal of Econometrics 60, 1994, equation 2.24.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.support.array_types import Array
from psotrack.tracking.motion import MotionParams, MotionState, kalman

#: Smallest log probability of a labelling, so that an improbable labelling can recover, and no number is infinite.
LEAST_LOG = -300.0

#: Number of each drone and of its track, under each labelling.
_DRONE, _TRACK = np.array([[0, 1], [0, 1]]), np.array([[0, 1], [1, 0]])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Labellings:
    """Both labellings after a frame.

    Attributes:
        log_probability: (2,), log probability given all frames so far: labels kept, labels exchanged.
        before: (2, 2), probability of each labelling (row) before the frame, given the labelling (column) after the
            frame and all frames so far.
        state: motion states: the two drones if labels are kept, then the two drones if they are exchanged.
    """

    log_probability: Float[Array, "2"]
    before: Float[Array, "2 2"]
    state: MotionState


def begin(state: MotionState) -> Labellings:
    """Labels that are certain, from the motion states of the two drones."""
    both = jax.tree.map(lambda value: np.concatenate([value, value]), state)
    return Labellings(np.array([0.0, LEAST_LOG]), np.eye(2), both)


def log_change(swap_odds: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames 2 2"]:
    """(frames, before, after), log probability of a change of labelling, from the odds of a swap in each frame."""
    odds = np.maximum(swap_odds, np.exp(LEAST_LOG))[:, None, None]
    return np.log(np.where(np.eye(2), 1.0, odds) / (1 + odds))


@jax.jit
def step(
    last: Labellings,
    dt_s: Float[Array, ""],
    position_m: Float[Array, "2 3"],
    covariance_m2: Float[Array, "2 3 3"],
    was_measured: Bool[Array, "2"],
    log_prior: Float[Array, "2 2"],
    params: MotionParams,
) -> Labellings:
    """Update both labellings with one frame.

    Args:
        last: the labellings after the previous frame.
        dt_s: time since the previous frame, seconds.
        position_m: (2, 3), measured positions of the two tracks; any value where not measured.
        covariance_m2: (2, 3, 3), their covariances; any value where not measured.
        was_measured: (2,), whether the track was measured.
        log_prior: (2, 2), logarithm of the probability of each labelling (column) in this frame, given the labelling
            (row) before, apart from positions.
        params: motion parameters of the two drones.
    """
    density = jnp.tile(params.jerk_density_m2_s5, 2)
    predicted = kalman.predict(last.state, dt_s, replace(params, jerk_density_m2_s5=density))
    # Each drone under each labelling before the frame, with the measurement of each of the two tracks.
    predicted = jax.tree.map(lambda value: jnp.repeat(value, 2, axis=0), predicted)
    positions_m, covariances_m2, measured = (
        jnp.concatenate([value] * 4) for value in (position_m, covariance_m2, was_measured)
    )
    plausible = kalman.log_likelihood(predicted, positions_m, covariances_m2, params)
    updated, _ = kalman.update(predicted, positions_m, covariances_m2, measured, params)

    def selected(value: Array) -> Array:
        """(before, after, drones, ...), with the track that each labelling after the frame gives the drone."""
        return value.reshape(2, 2, 2, *value.shape[1:])[:, _DRONE, _TRACK]

    fit = selected(jnp.where(measured, plausible, 0.0)).sum(axis=-1)
    joint = last.log_probability[:, None] + log_prior + fit
    log_probability = jax.scipy.special.logsumexp(joint, axis=0)
    before = jnp.exp(joint - log_probability)
    log_probability -= jax.scipy.special.logsumexp(log_probability)
    state = _merged(before, jax.tree.map(selected, updated))
    return Labellings(jnp.maximum(log_probability, LEAST_LOG), before, state)


def _merged(weight: Float[Array, "before after"], state: MotionState) -> MotionState:
    """Merge states (before, after, drones) with weights (before, after) into states (after x drones)."""

    def mean_of(value: Array) -> Array:
        return jnp.einsum("ba,bad...->ad...", weight, value)

    mean = mean_of(state.mean)
    apart = state.mean - mean
    spread = mean_of(state.covariance + apart[..., :, None] * apart[..., None, :])
    merged = kalman.state_from_mean(mean, spread, mean_of(state.noise_m2))
    return jax.tree.map(lambda value: value.reshape(-1, *value.shape[2:]), merged)


def best_path(
    before: Float[np.ndarray, "frames 2 2"], cost_frames: float, *, at_the_end: bool
) -> Int[np.ndarray, "frames"]:
    """(frames,), 1 where exchanged labels make the largest expected number of frames right, less the cost of changes.

    Labels are kept before the first frame. Dynamic programming (A. J. Viterbi, 1967).

    Args:
        before: `Labellings.before` of each frame.
        cost_frames: cost of a change, frames.
        at_the_end: whether labels are exchanged in the last frame.
    """
    # Probabilities of both labellings given all frames and the last frame's labelling.
    probability = [np.eye(2)[int(at_the_end)]]
    for origins in before[:0:-1]:
        probability.append(origins @ probability[-1])
    value, came_from = np.array([0.0, -np.inf]), []
    for right in reversed(probability):
        options = value[:, None] - cost_frames * (1 - np.eye(2))
        came_from.append(options.argmax(axis=0))
        value = options.max(axis=0) + right
    path = [int(at_the_end)]
    for origins in came_from[:0:-1]:
        path.append(origins[path[-1]])
    return np.array(path[::-1])
