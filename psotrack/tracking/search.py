"""The search in one frame: from first positions to the position of largest objective.

`Search` is the interface; `particle_swarm` makes the search of this package. Another search is any object with the same
`__call__`: given to `psotrack.track(..., search=...)`, or by name as an entry point of the group `psotrack.searches`,
which maps `SwarmSettings` to a search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from psotrack._typing import Array, Key
from psotrack.settings import SwarmSettings
from psotrack.tracking import swarm
from psotrack.tracking.swarm import Objective


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchRegion:
    """Where to search.

    Attributes:
        low, high: (groups, dims), bounds of the positions.
        max_step: (dims,), a drone's largest distance in one frame, per dimension: the largest sensible step.
    """

    low: Float[Array, "groups dims"]
    high: Float[Array, "groups dims"]
    max_step: Float[Array, "dims"]


@runtime_checkable
class Search(Protocol):
    """Finds the positions of largest objective, for several groups that are independent of one another.

    A search is a JAX pytree and is called inside of a compiled function: its arrays may change without a new
    compilation, everything else is compiled in. `jax.tree_util.register_static` makes a frozen dataclass of plain
    settings such a pytree.
    """

    def __call__(
        self,
        key: Key,
        objective: Objective,
        first: Float[Array, "particles groups dims"],
        region: SearchRegion,
        num_iterations: Int[Array, ""],
    ) -> Float[Array, "groups dims"]:
        """The best position of each group.

        Args:
            key: for random numbers; consumed.
            objective: maps positions (particles, groups, dims) to values (particles, groups), which are maximised. NaN
                is worse than every number.
            first: (particles, groups, dims), the first positions to evaluate.
            region: bounds and step size.
            num_iterations: number of evaluations of all particles; the first positions may be one more.
        """
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ParticleSwarm:
    """Particle swarm optimisation (see `psotrack.tracking.swarm`).

    Attributes:
        inertia, cognitive, social: coefficients w, c1 and c2.
    """

    inertia: Float[Array, ""]
    cognitive: Float[Array, ""]
    social: Float[Array, ""]

    def __call__(
        self,
        key: Key,
        objective: Objective,
        first: Float[Array, "particles groups dims"],
        region: SearchRegion,
        num_iterations: Int[Array, ""],
    ) -> Float[Array, "groups dims"]:
        """See `Search`."""
        params = swarm.SwarmParams(
            inertia=self.inertia,
            cognitive=self.cognitive,
            social=self.social,
            max_step=region.max_step,
            low=region.low,
            high=region.high,
        )
        return swarm.run(key, objective, first, params, num_iterations).gbest_position


def particle_swarm(settings: SwarmSettings) -> ParticleSwarm:
    """The particle swarm with the coefficients of the settings."""
    return ParticleSwarm(
        inertia=jnp.float32(settings.inertia),
        cognitive=jnp.float32(settings.cognitive),
        social=jnp.float32(settings.social),
    )
