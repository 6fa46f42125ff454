"""Particle swarm optimisation of any objective (Kennedy & Eberhart 1995; inertia: Shi & Eberhart 1998).

The swarm holds particles as (particles, groups, dims). Its objective maps them to (particles, groups): groups share
nothing but the call, so one group of 3 x drones is a joint swarm over all drones, and one group of 3 per drone is a
swarm for each of them. Fitness is maximised. An undefined fitness (NaN) never becomes a best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from psotrack._typing import Array, Key

#: Maps positions (particles, groups, dims) to fitness (particles, groups).
Objective = Callable[[Float[Array, "particles groups dims"]], Float[Array, "particles groups"]]


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
    """What the next iteration needs. Bests that were never defined have fitness -inf."""

    position: Float[Array, "particles groups dims"]
    velocity: Float[Array, "particles groups dims"]
    pbest_position: Float[Array, "particles groups dims"]
    pbest_fitness: Float[Array, "particles groups"]
    gbest_position: Float[Array, "groups dims"]
    gbest_fitness: Float[Array, "groups"]


def init(
    objective: Objective, position: Float[Array, "particles groups dims"], params: SwarmParams
) -> SwarmState:
    """A swarm at rest at the given positions, clipped to the bounds and evaluated once."""
    position = jnp.clip(position, params.low, params.high)
    undefined = jnp.full(position.shape[:2], -jnp.inf, position.dtype)
    state = SwarmState(
        position=position,
        velocity=jnp.zeros_like(position),
        pbest_position=position,
        pbest_fitness=undefined,
        gbest_position=position[0],
        gbest_fitness=undefined[0],
    )
    return _remember_bests(state, objective(position))


def step(key: Key, objective: Objective, state: SwarmState, params: SwarmParams) -> SwarmState:
    """One iteration. The key is consumed.

    v <- w v + c1 r1 (pbest - x) + c2 r2 (gbest - x), r1 and r2 uniform in [0, 1) for every dimension, then clamped to
    `max_step`; x <- x + v. A particle that would leave the bounds stops at them, so that it can turn round at once.
    """
    r1, r2 = jax.random.uniform(key, (2, *state.position.shape), state.position.dtype)
    velocity = (
        params.inertia * state.velocity
        + params.cognitive * r1 * (state.pbest_position - state.position)
        + params.social * r2 * (state.gbest_position - state.position)
    )
    velocity = jnp.clip(velocity, -params.max_step, params.max_step)
    wanted = state.position + velocity
    position = jnp.clip(wanted, params.low, params.high)
    velocity = jnp.where(position == wanted, velocity, 0.0)
    moved = SwarmState(
        position=position,
        velocity=velocity,
        pbest_position=state.pbest_position,
        pbest_fitness=state.pbest_fitness,
        gbest_position=state.gbest_position,
        gbest_fitness=state.gbest_fitness,
    )
    return _remember_bests(moved, objective(position))


def run(
    key: Key,
    objective: Objective,
    position: Float[Array, "particles groups dims"],
    params: SwarmParams,
    num_iterations: Int[Array, ""] | int,
) -> SwarmState:
    """`init` and `num_iterations` times `step`. The key is consumed; the number of iterations may be traced."""

    def body(iteration: Array, state: SwarmState) -> SwarmState:
        return step(jax.random.fold_in(key, iteration), objective, state, params)

    return jax.lax.fori_loop(0, num_iterations, body, init(objective, position, params))


def _remember_bests(state: SwarmState, fitness: Float[Array, "particles groups"]) -> SwarmState:
    """Personal and global bests after an evaluation; comparisons with NaN are false, so NaN is never best."""
    better = fitness > state.pbest_fitness
    pbest_position = jnp.where(better[..., None], state.position, state.pbest_position)
    pbest_fitness = jnp.where(better, fitness, state.pbest_fitness)
    leader = jnp.argmax(pbest_fitness, axis=0)
    groups = jnp.arange(leader.shape[0])
    return SwarmState(
        position=state.position,
        velocity=state.velocity,
        pbest_position=pbest_position,
        pbest_fitness=pbest_fitness,
        gbest_position=pbest_position[leader, groups],
        gbest_fitness=pbest_fitness[leader, groups],
    )
