"""Labellings: all assignments of a group's drones to tracks, each with its own motion states and probability.

Near tracks may swap their drones between two frames, so the labelling is the hidden state of a Markov chain. Each step
computes the probability of every pair of labellings before and after the frame. States with the same labelling after
the frame are merged into one state of equal mean and covariance: the generalised pseudo-Bayesian filter of second
order, Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section
11.6.5. The probabilities of earlier labellings given later frames follow from the same weights in backward order: C.-J.
Kim, Dynamic linear models with Markov-switching, Journal of Econometrics 60, 1994, equation 2.24.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, permutations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack._typing import Array, Positions
from psotrack.motion import Covariances, MotionParams, MotionState, kalman
from psotrack.support import stored_jit

#: Smallest log probability of a labelling, so that an improbable labelling can recover, and no number is infinite.
LEAST_LOG = -300.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bank:
    """Probabilities and motion states of a group's drones under each labelling.

    Attributes:
        log_probability: (labellings,), log probability given all frames so far.
        state: motion states of the drones, with a leading axis of labellings.
    """

    log_probability: Float[Array, "labellings"]
    state: MotionState


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameMeasurements:
    """Measurements of a group's tracks in one frame.

    Attributes:
        position_m: (tracks, 3), measured positions; any finite value where not measured.
        covariance_m2: (tracks, 3, 3), their covariances; any finite value where not measured.
        was_measured: (tracks,), whether the track was measured.
    """

    position_m: Positions
    covariance_m2: Covariances
    was_measured: Bool[Array, "tracks"]


@cache
def labellings(num_drones: int) -> Int[np.ndarray, "labellings drones"]:
    """(labellings, drones), track of each drone in every labelling: all permutations, the first is 0, 1, 2, ..."""
    return np.array(list(permutations(range(num_drones))))


@cache
def exchanges(num_drones: int) -> Int[np.ndarray, "labellings labellings"]:
    """(labellings, labellings), smallest number of swaps of two tracks that lead from one labelling to the other."""
    all_of = labellings(num_drones)
    between = np.argsort(all_of, axis=1)[:, all_of]
    cycles = np.zeros(between.shape[:2], np.int64)
    # A cycle is counted at its smallest drone; k moves reach every drone of a cycle of at most k drones.
    reached = least = np.broadcast_to(np.arange(num_drones), between.shape)
    for _ in range(num_drones):
        reached = np.take_along_axis(between, reached, axis=-1)
        least = np.minimum(least, reached)
    cycles = (least == np.arange(num_drones)).sum(axis=-1)
    return num_drones - cycles


@cache
def confusions(num_drones: int) -> Bool[np.ndarray, "labellings labellings pairs"]:
    """(reported, true, pairs), whether the track reported as one drone of a pair is in truth the other drone."""
    all_of = labellings(num_drones)
    # found[reported, true, drone]: the true drone of the track that is reported for the drone.
    found = np.argsort(all_of, axis=1)[:, all_of].swapaxes(0, 1)
    pairs = list(combinations(range(num_drones), 2))
    wrong = [(found[..., one] == other) | (found[..., other] == one) for one, other in pairs]
    return np.stack(wrong, axis=-1) if wrong else np.zeros((*found.shape[:2], 0), bool)


def change_log_probability(
    active: Bool[np.ndarray, "drones drones"], rate: float
) -> Float[np.ndarray, "labellings labellings"]:
    """(labellings, labellings), log probability that a labelling changes to another within a frame.

    Args:
        active: (drones, drones), symmetric, whether two tracks may swap their drones.
        rate: expected number of swaps of two such tracks in a frame. Two or more swaps within a frame are ignored.
    """
    num_drones = len(active)
    all_of = labellings(num_drones)
    expected = np.eye(len(all_of))
    for one, other in np.argwhere(np.triu(active, 1)):
        swap = np.arange(num_drones)
        swap[[one, other]] = other, one
        target = (swap[all_of][:, None] == all_of).all(axis=-1)
        expected += rate * target
    expected /= expected.sum(axis=1, keepdims=True)
    return np.log(np.maximum(expected, np.exp(LEAST_LOG)))


@stored_jit
def step(
    bank: Bank,
    dt_s: Float[Array, ""],
    frame: FrameMeasurements,
    log_change: Float[Array, "labellings labellings"],
    log_likeness: Float[Array, "drones drones"],
    params: MotionParams,
) -> tuple[Bank, Float[Array, "labellings labellings"]]:
    """Update a bank with one frame.

    Args:
        bank: the bank before the frame.
        dt_s: time since the previous frame, seconds.
        frame: measurements of the tracks.
        log_change: (before, after), from `change_log_probability`.
        log_likeness: (drones, tracks), log likelihood of the track's size if the track is the drone.
        params: motion parameters of the group's drones.

    Returns:
        The bank after the frame, and (before, after): the probability of each labelling before the frame, given the
        labelling after the frame and all frames so far.
    """
    num, drones = bank.state.apparent_m.shape[:2]
    # The measurements of every track, repeated for every drone in every labelling.
    measured, spread, measured_now = (
        jnp.tile(value, (num * drones, *[1] * (value.ndim - 1)))
        for value in (frame.position_m, frame.covariance_m2, frame.was_measured)
    )
    density = jnp.asarray(params.jerk_density_m2_s5)
    flat = jax.tree.map(lambda value: value.reshape(-1, *value.shape[2:]), bank.state)
    predicted = kalman.predict(flat, dt_s, replace(params, jerk_density_m2_s5=jnp.tile(density, num)))
    predicted = jax.tree.map(lambda value: jnp.repeat(value, drones, axis=0), predicted)
    plausible = jnp.where(measured_now, kalman.log_likelihood(predicted, measured, spread, params), 0.0)
    updated, _ = kalman.update(predicted, measured, spread, measured_now, params)

    # For each labelling after the frame, the drone-track pairs that it selects.
    each = (slice(None), jnp.arange(drones), jnp.asarray(labellings(drones)))

    def select(value: Array) -> Array:
        """(before, after, drones, ...), of (before x drones x tracks, ...)."""
        return value.reshape(num, drones, drones, *value.shape[1:])[each]

    fit = (select(plausible) + jnp.asarray(log_likeness)[each[1:]]).sum(axis=-1)
    joint = bank.log_probability[:, None] + log_change + fit
    log_probability = jax.scipy.special.logsumexp(joint, axis=0)
    before = jnp.exp(joint - log_probability)
    state = _merge(before, jax.tree.map(select, updated))
    log_probability = log_probability - jax.scipy.special.logsumexp(log_probability)
    return Bank(jnp.maximum(log_probability, LEAST_LOG), state), before


def _merge(weight: Float[Array, "before after"], state: MotionState) -> MotionState:
    """Merge states (before, after, drones) with weights (before, after) into states (after, drones)."""

    def mean_of(value: Array) -> Array:
        return jnp.einsum("ba,bad...->ad...", weight, value)

    mean = mean_of(state.mean)
    apart = state.mean - mean
    spread = mean_of(state.covariance + apart[..., :, None] * apart[..., None, :])
    return kalman.state_from_mean(mean, spread, mean_of(state.noise_m2))


@stored_jit
def begin(
    measured_m: Float[Array, "frames 3"],
    measured_covariance_m2: Float[Array, "frames 3 3"],
    dt_s: Float[Array, "frames"],
    counts: Bool[Array, "frames"],
    params: MotionParams,
) -> Bank:
    """Make a bank of one drone, which has one labelling, from the drone's measurements.

    Args:
        measured_m: (frames, 3), measured positions.
        measured_covariance_m2: (frames, 3, 3), their covariances.
        dt_s: (frames,), seconds to the next frame; the last value is the time from the last frame to the bank's time.
        counts: (frames,), whether the measurement is used. The first measurement, always finite, is the initial state.
        params: motion parameters of the drone.
    """
    start = kalman.init(measured_m[:1], jnp.zeros_like(measured_m[:1]), measured_covariance_m2[:1], params)

    def add_frame(state: MotionState, frame: tuple) -> tuple[MotionState, None]:
        measured, spread, dt_s, used = frame
        state, _ = kalman.update(state, measured[None], spread[None], used[None], params)
        return kalman.predict(state, dt_s, params), None

    counts = jnp.asarray(counts).at[0].set(False)
    state, _ = jax.lax.scan(add_frame, start, (measured_m, measured_covariance_m2, dt_s, counts))
    return Bank(jnp.zeros(1, measured_m.dtype), jax.tree.map(lambda value: value[None], state))


def join(first: Bank, second: Bank) -> Bank:
    """Join the banks of two groups: each labelling of one group is combined with each of the other."""
    kept, index = embedding(*(part.state.apparent_m.shape[1] for part in (first, second)))
    one, other = (
        jax.tree.map(lambda value, pick=pick: np.asarray(value)[pick], part)
        for part, pick in zip((first, second), index.T, strict=True)
    )
    return Bank(
        np.where(kept, one.log_probability + other.log_probability, LEAST_LOG),
        jax.tree.map(lambda *values: np.concatenate(values, axis=1), one.state, other.state),
    )


@cache
def embedding(first: int, second: int) -> tuple[Bool[np.ndarray, "all"], Int[np.ndarray, "all 2"]]:
    """Labellings of a joined group that do not mix the two groups, and their labellings in the two groups.

    Returns:
        (labellings,), whether a labelling of `first` + `second` drones does not mix the groups; and (labellings, 2),
        its labelling in each of the groups, 0 for a labelling that mixes them.
    """
    all_of = labellings(first + second)
    kept = np.asarray((all_of[:, :first] < first).all(axis=1))
    index = np.zeros((len(all_of), 2), np.int64)
    for side, part in enumerate((all_of[:, :first], all_of[:, first:] - first)):
        same = (part[:, None] == labellings((first, second)[side])).all(axis=-1)
        index[kept, side] = same[kept].argmax(axis=1)
    return kept, index


def smooth_labels(
    before: Float[np.ndarray, "frames labellings labellings"], last: int
) -> Float[np.ndarray, "frames labellings"]:
    """(frames, labellings), probability of each labelling in every frame, given the last frame's labelling.

    Args:
        before: one array per frame, as `step` returns it.
        last: labelling of the last frame.
    """
    probability = np.zeros(before.shape[:2])
    probability[-1, last] = 1.0
    for frame in range(len(before) - 1, 0, -1):
        probability[frame - 1] = before[frame] @ probability[frame]
    return probability


def best_path(
    probability: Float[np.ndarray, "frames labellings"],
    cost: Float[np.ndarray, "labellings labellings"],
) -> Int[np.ndarray, "frames"]:
    """(frames,), labellings with the largest expected number of right frames minus the cost of changes.

    The labelling before the first frame is 0. Dynamic programming (A. J. Viterbi, 1967).

    Args:
        probability: (frames, labellings), probability of each labelling in every frame.
        cost: (labellings, labellings), cost of a change of the labelling, frames.
    """
    value = -cost[0]
    came_from = np.zeros(probability.shape, np.int64)
    for frame, right in enumerate(probability):
        if frame:
            options = value[:, None] - cost
            came_from[frame] = options.argmax(axis=0)
            value = options.max(axis=0)
        value = value + right
    found = np.empty(len(probability), np.int64)
    found[-1] = probability[-1].argmax()
    for frame in range(len(found) - 1, 0, -1):
        found[frame - 1] = came_from[frame][found[frame]]
    return found
