"""Which track is which drone: all answers side by side, each with motion states of its own.

A labelling says which track each drone of a group is. Tracks of drones that are near one another may exchange drones
between two frames, so the labelling is the hidden state of a Markov chain, and every step weighs every labelling
before with every one after it. States that end in the same labelling are merged into one of equal mean and covariance:
the generalised pseudo-Bayesian filter of second order, Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 11.6.5. What the frames after say of a labelling before comes
from the same weights, read backwards: C.-J. Kim, Dynamic linear models with Markov-switching, Journal of Econometrics
60, 1994, equation 2.24.
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

#: No labelling is less probable than exp of this: what is nearly excluded can still come back, and nothing is infinite.
LEAST_LOG = -300.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bank:
    """What is known of a group of drones under each of its labellings.

    Attributes:
        log_probability: (labellings,), of each, given all frames so far.
        state: of the drones, with a leading axis of labellings.
    """

    log_probability: Float[Array, "labellings"]
    state: MotionState


@cache
def labellings(num_drones: int) -> Int[np.ndarray, "labellings drones"]:
    """(labellings, drones), the track of each drone, all permutations; the first is 0, 1, 2, ..."""
    return np.array(list(permutations(range(num_drones))))


@cache
def exchanges(num_drones: int) -> Int[np.ndarray, "labellings labellings"]:
    """(labellings, labellings), how many exchanges of two tracks at least lead from one to the other."""
    all_of = labellings(num_drones)
    between = np.argsort(all_of, axis=1)[:, all_of]
    cycles = np.zeros(between.shape[:2], np.int64)
    # A drone that is the least of its cycle counts the cycle; what k drones can do, they do within k moves.
    reached = least = np.broadcast_to(np.arange(num_drones), between.shape)
    for _ in range(num_drones):
        reached = np.take_along_axis(between, reached, axis=-1)
        least = np.minimum(least, reached)
    cycles = (least == np.arange(num_drones)).sum(axis=-1)
    return num_drones - cycles


@cache
def confusions(num_drones: int) -> Bool[np.ndarray, "labellings labellings pairs"]:
    """(reported, true, pairs): whether, of two drones, the track that is reported as the one is in truth the other."""
    all_of = labellings(num_drones)
    # The drone that a labelling has on the track that another reports for each drone.
    found = np.argsort(all_of, axis=1)[:, all_of].swapaxes(0, 1)
    pairs = list(combinations(range(num_drones), 2))
    wrong = [(found[..., one] == other) | (found[..., other] == one) for one, other in pairs]
    return np.stack(wrong, axis=-1) if wrong else np.zeros((*found.shape[:2], 0), bool)


def change_log_probability(
    active: Bool[np.ndarray, "drones drones"], rate: float
) -> Float[np.ndarray, "labellings labellings"]:
    """(labellings, labellings), log probability that a labelling becomes another within a frame.

    Args:
        active: (drones, drones), symmetric: tracks that may exchange drones.
        rate: expected exchanges of any such two; the chance of several within a frame is left to several frames.
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


@jax.jit
def step(
    bank: Bank,
    dt_s: Float[Array, ""],
    measured_m: Positions,
    measured_covariance_m2: Covariances,
    was_measured: Bool[Array, "drones"],
    log_change: Float[Array, "labellings labellings"],
    log_likeness: Float[Array, "drones drones"],
    params: MotionParams,
) -> tuple[Bank, Float[Array, "labellings labellings"]]:
    """One frame: every labelling before with every one after it, weighed, and merged by the latter.

    Args:
        measured_m: (tracks, 3), numbers everywhere; likewise covariance (tracks, 3, 3) and was_measured (tracks,).
        log_change: (before, after), from `change_log_probability`.
        log_likeness: (drones, tracks), log likelihood of what else is seen of a track, if it is that drone.
        params: of the group's drones.

    Returns:
        The bank after the frame, and (before, after): the probability of each labelling before, given the one after
        and all frames so far.
    """
    num, drones = bank.state.apparent_m.shape[:2]
    # What is measured of every track, for every drone under every labelling.
    measured, spread, there = (
        jnp.tile(value, (num * drones, *[1] * (value.ndim - 1)))
        for value in (measured_m, measured_covariance_m2, was_measured)
    )
    density = jnp.asarray(params.jerk_density_m2_s5)
    flat = jax.tree.map(lambda value: value.reshape(-1, *value.shape[2:]), bank.state)
    predicted = kalman.predict(flat, dt_s, replace(params, jerk_density_m2_s5=jnp.tile(density, num)))
    predicted = jax.tree.map(lambda value: jnp.repeat(value, drones, axis=0), predicted)
    plausible = jnp.where(there, kalman.log_likelihood(predicted, measured, spread, params), 0.0)
    updated, _ = kalman.update(predicted, measured, spread, there, params)

    # Which of these a labelling after makes of one before.
    each = (slice(None), jnp.arange(drones), jnp.asarray(labellings(drones)))

    def taken(value: Array) -> Array:
        """(before, after, drones, ...), of (before x drones x tracks, ...)."""
        return value.reshape(num, drones, drones, *value.shape[1:])[each]

    fit = (taken(plausible) + jnp.asarray(log_likeness)[each[1:]]).sum(axis=-1)
    joint = bank.log_probability[:, None] + log_change + fit
    log_probability = jax.scipy.special.logsumexp(joint, axis=0)
    before = jnp.exp(joint - log_probability)
    state = _merged(before, jax.tree.map(taken, updated))
    log_probability = log_probability - jax.scipy.special.logsumexp(log_probability)
    return Bank(jnp.maximum(log_probability, LEAST_LOG), state), before


def _merged(weight: Float[Array, "before after"], state: MotionState) -> MotionState:
    """States (before, after, drones), each weighed by (before, after), as one for each labelling after."""

    def mean_of(value: Array) -> Array:
        return jnp.einsum("ba,bad...->ad...", weight, value)

    mean = mean_of(state.mean)
    apart = state.mean - mean
    spread = mean_of(state.covariance + apart[..., :, None] * apart[..., None, :])
    return kalman.state_from_mean(mean, spread, mean_of(state.noise_m2))


@jax.jit
def begin(
    measured_m: Float[Array, "frames 3"],
    measured_covariance_m2: Float[Array, "frames 3 3"],
    dt_s: Float[Array, "frames"],
    counts: Bool[Array, "frames"],
    params: MotionParams,
) -> Bank:
    """A bank of one drone and one labelling, from what was measured of it.

    Args:
        dt_s: (frames,), seconds to the next frame; after the last one, to when the bank is wanted.
        counts: (frames,), which measurements there are; the first is the start, and must be a number in any case.
        params: of this one drone.
    """
    start = kalman.init(measured_m[:1], jnp.zeros_like(measured_m[:1]), measured_covariance_m2[:1], params)

    def one(state: MotionState, frame: tuple) -> tuple[MotionState, None]:
        measured, spread, dt_s, there = frame
        state, _ = kalman.update(state, measured[None], spread[None], there[None], params)
        return kalman.predict(state, dt_s, params), None

    counts = jnp.asarray(counts).at[0].set(False)
    state, _ = jax.lax.scan(one, start, (measured_m, measured_covariance_m2, dt_s, counts))
    return Bank(jnp.zeros(1, measured_m.dtype), jax.tree.map(lambda value: value[None], state))


def joined(first: Bank, second: Bank) -> Bank:
    """The bank of two groups that become one: every labelling of the one with every one of the other."""
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
    """(labellings,), which of those of first + second drones keep the two apart, and (labellings, 2), what each sees.

    What mixes the two counts as the first labelling of either, for want of any other.
    """
    all_of = labellings(first + second)
    kept = np.asarray((all_of[:, :first] < first).all(axis=1))
    index = np.zeros((len(all_of), 2), np.int64)
    for side, part in enumerate((all_of[:, :first], all_of[:, first:] - first)):
        same = (part[:, None] == labellings((first, second)[side])).all(axis=-1)
        index[kept, side] = same[kept].argmax(axis=1)
    return kept, index


def smoothed(
    before: Float[np.ndarray, "frames labellings labellings"], last: int
) -> Float[np.ndarray, "frames labellings"]:
    """(frames, labellings), the probabilities of a labelling in every frame if the last frame's is `last`.

    Args:
        before: of every frame, as `step` returns it.
    """
    probability = np.zeros(before.shape[:2])
    probability[-1, last] = 1.0
    for frame in range(len(before) - 1, 0, -1):
        probability[frame - 1] = before[frame] @ probability[frame]
    return probability


def path(
    probability: Float[np.ndarray, "frames labellings"],
    cost: Float[np.ndarray, "labellings labellings"],
) -> Int[np.ndarray, "frames"]:
    """(frames,), labellings from 0 before the first frame on that make the most frames right, less what changes cost.

    Dynamic programming (A. J. Viterbi, 1967).
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
