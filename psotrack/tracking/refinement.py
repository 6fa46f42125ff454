"""Gradient ascent on the swarm's answer: the last millimetres, which a swarm takes many iterations for.

A swarm finds the right hill among several and needs no gradient; on the hill it converges by chance. Adam (Kingma & Ba
2015, by way of optax) climbs it in a few steps, each of the price of two or three particles, but only the hill it
stands on.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float, Int

from psotrack._typing import Array, Positions

#: First step along each axis, in metres; Adam keeps to it while the gradient keeps its sign.
STEP_M = 0.002
#: Short memories: a climb has ten steps, not thousands.
_MOMENTUM, _SCALING = 0.8, 0.95


def climb(
    objective: Callable[[Positions], Float[Array, "drones"]],
    position_m: Positions,
    num_steps: Int[Array, ""] | int,
    low_m: Positions,
    high_m: Positions,
) -> Positions:
    """The best positions on the way uphill, the start included: no drone's fitness gets worse.

    Args:
        objective: fitness (drones,) of positions (drones, 3), maximised; each drone's depends on its own position
            only. Where it is NaN the drone stays where it was best.
        position_m: (drones, 3), start.
        num_steps: may be traced; 0 returns the start.
        low_m, high_m: (drones, 3), bounds.
    """
    adam = optax.adam(STEP_M, b1=_MOMENTUM, b2=_SCALING)

    def total(position: Positions) -> tuple[Array, Array]:
        fitness = objective(position)
        return -jnp.nan_to_num(fitness).sum(), fitness

    def better(position: Array, fitness: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        improved = fitness > best[1]
        return jnp.where(improved[:, None], position, best[0]), jnp.where(improved, fitness, best[1])

    def body(_: Array, carry: tuple) -> tuple:
        position, memory, best = carry
        (_, fitness), gradient = jax.value_and_grad(total, has_aux=True)(position)
        best = better(position, fitness, best)
        # optax raises float32 decays to an int32 count of steps, which strict promotion of types would refuse.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = adam.update(gradient, memory)
        position = jnp.clip(optax.apply_updates(position, change), low_m, high_m)
        return position, memory, best

    undefined = jnp.full(position_m.shape[0], -jnp.inf, position_m.dtype)
    carry = (position_m, adam.init(position_m), (position_m, undefined))
    position, _, best = jax.lax.fori_loop(0, num_steps, body, carry)
    # The last step has not been judged yet.
    return better(position, objective(position), best)[0]
