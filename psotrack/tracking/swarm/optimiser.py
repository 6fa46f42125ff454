"""Particle swarm optimisation of any objective (Kennedy & Eberhart 1995; inertia: Shi & Eberhart 1998).

The swarm holds particles as (particles, groups, dims). Its objective maps them to (particles, groups): groups share
nothing but the call, so one group of 3 x drones is a joint swarm over all drones, and one group of 3 per drone is a
swarm for each drone. Fitness is maximised. An undefined fitness (NaN) never becomes a best.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from psotrack.support.array_types import Array, Key

#: Maps positions (particles, groups, dims) to fitness (particles, groups).
Objective = Callable[[Float[Array, "particles groups dims"]], Float[Array, "particles groups"]]
#: The random factors r1 and r2 of one iteration.
Factors = tuple[Float[Array, "particles groups dims"], Float[Array, "particles groups dims"]]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SwarmParams:
    """Knobs of the swarm; all may differ between calls without a new compilation.

    Attributes:
        inertia: w, the share of its velocity that a particle keeps.
        cognitive: c1, the pull towards the particle's own best.
        social: c2, the pull towards the group's best.
        max_step: (dims,), largest velocity per iteration and dimension, in units of the position.
        low, high: (groups, dims), bounds of the search.
    """

    inertia: Float[Array, ""]
    cognitive: Float[Array, ""]
    social: Float[Array, ""]
    max_step: Float[Array, "dims"]
    low: Float[Array, "groups dims"]
    high: Float[Array, "groups dims"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SwarmState:
    """What the next iteration needs.

    The particles are evaluated next at `position`. `pbest` is the best position so far of each particle, and `gbest`
    that of each group. Before any defined fitness, the fitness of a best is -inf.
    """

    position: Float[Array, "particles groups dims"]
    velocity: Float[Array, "particles groups dims"]
    pbest_position: Float[Array, "particles groups dims"]
    pbest_fitness: Float[Array, "particles groups"]
    gbest_position: Float[Array, "groups dims"]
    gbest_fitness: Float[Array, "groups"]


def init(position: Float[Array, "particles groups dims"], params: SwarmParams) -> SwarmState:
    """A swarm at rest at the given positions, clipped to the bounds and not evaluated yet."""
    position = jnp.clip(position, params.low, params.high)
    undefined = jnp.full(position.shape[:2], -jnp.inf, position.dtype)
    return SwarmState(
        position=position,
        velocity=jnp.zeros_like(position),
        pbest_position=position,
        pbest_fitness=undefined,
        gbest_position=jnp.zeros_like(params.low),
        gbest_fitness=jnp.full(params.low.shape[:1], -jnp.inf, position.dtype),
    )


def evaluate(objective: Objective, state: SwarmState) -> SwarmState:
    """Personal and global bests after the particles were evaluated where they are.

    Comparisons with NaN are false, so an undefined fitness is never best.
    """
    fitness = objective(state.position)
    better = fitness > state.pbest_fitness
    pbest_position = jnp.where(better[..., None], state.position, state.pbest_position)
    pbest_fitness = jnp.where(better, fitness, state.pbest_fitness)
    leader = jnp.argmax(pbest_fitness, axis=0)
    # Sums over the particles that choose one, because a kernel cannot take elements of an array.
    leads = jax.lax.broadcasted_iota(jnp.int32, fitness.shape, 0) == leader
    return replace(
        state,
        pbest_position=pbest_position,
        pbest_fitness=pbest_fitness,
        gbest_position=jnp.where(leads[..., None], pbest_position, 0.0).sum(axis=0),
        gbest_fitness=pbest_fitness.max(axis=0),
    )


def move(key: Key, state: SwarmState, params: SwarmParams) -> SwarmState:
    """Where the particles go next. The key is consumed.

    v <- w v + c1 r1 (pbest - x) + c2 r2 (gbest - x), r1 and r2 uniform in [0, 1) for every dimension, then clamped to
    `max_step`; x <- x + v. A particle that would leave the bounds stops at them, so that it can turn round at once.
    """
    return _moved(random_factors(key, state.position.shape), state, params)


def _moved(factors: Factors, state: SwarmState, params: SwarmParams) -> SwarmState:
    r1, r2 = factors
    velocity = (
        params.inertia * state.velocity
        + params.cognitive * r1 * (state.pbest_position - state.position)
        + params.social * r2 * (state.gbest_position - state.position)
    )
    velocity = jnp.clip(velocity, -params.max_step, params.max_step)
    wanted = state.position + velocity
    position = jnp.clip(wanted, params.low, params.high)
    return replace(state, position=position, velocity=jnp.where(position == wanted, velocity, 0.0))


def step(key: Key, objective: Objective, state: SwarmState, params: SwarmParams) -> SwarmState:
    """One iteration: evaluate, then move. The key is consumed.

    In this order the loop hands finished positions from one iteration to the next. If the move came first, XLA on a CPU
    would compute the move, random numbers included, again in each of the loops into which it splits the objective.
    """
    return _step(random_factors(key, state.position.shape), objective, state, params)


def _step(factors: Factors, objective: Objective, state: SwarmState, params: SwarmParams) -> SwarmState:
    return _moved(factors, evaluate(objective, state), params)


def run(
    key: Key,
    objective: Objective,
    position: Float[Array, "particles groups dims"],
    params: SwarmParams,
    num_iterations: Int[Array, ""] | int,
) -> SwarmState:
    """`num_iterations` times `step` from the given positions, and a last `evaluate`.

    The key is consumed; the number of iterations may be traced.
    """

    def factors(iteration: Array) -> Factors:
        return random_factors(jax.random.fold_in(key, iteration), position.shape)

    return repeat(factors, objective, position, params, num_iterations)


def repeat(
    factors: Callable[[Array], Factors],
    objective: Objective,
    position: Float[Array, "particles groups dims"],
    params: SwarmParams,
    num_iterations: Int[Array, ""] | int,
) -> SwarmState:
    """`run` with the random factors of each iteration, from 0; a kernel, too, can compute it."""

    def body(iteration: Array, state: SwarmState) -> SwarmState:
        return _step(factors(iteration), objective, state, params)

    return evaluate(objective, jax.lax.fori_loop(0, num_iterations, body, init(position, params)))


def random_factors(key: Key, shape: tuple[int, ...]) -> Factors:
    """Two independent uniform numbers in [0, 1) for every element: the halves of one word, in steps of 2^-16.

    JAX's own generator would take a tenth of the swarm's time, so it only makes the key. The words are a hash of the
    key and the element's number: the finaliser of MurmurHash3 (Appleby 2011, public domain), once for each half of the
    key.
    """
    first, last = jax.random.key_data(key)[..., 0], jax.random.key_data(key)[..., -1]
    number = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape)
    words = _mixed(_mixed(number * jnp.uint32(0x9E3779B9) + first) ^ last)

    def uniform(half: jax.Array) -> jax.Array:
        # The detour through int32 is faster: CPUs convert int32 to float32 in one instruction, but not uint32.
        return half.astype(jnp.int32).astype(jnp.float32) * 2.0**-16

    return uniform(words >> 16), uniform(words & 0xFFFF)


def _mixed(word: jax.Array) -> jax.Array:
    word = (word ^ (word >> 16)) * jnp.uint32(0x85EBCA6B)
    word = (word ^ (word >> 13)) * jnp.uint32(0xC2B2AE35)
    return word ^ (word >> 16)
