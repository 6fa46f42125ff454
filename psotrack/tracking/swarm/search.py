"""The search in one frame: from first positions to the position of largest objective.

`Search` is the interface; `particle_swarm` makes the search of this package, `kernel.kernel_swarm` the same for a GPU.
Another search is any object with the same `__call__`: given to `psotrack.track(..., search=...)`, or by name as a
plugin (see `psotrack.support.plugins`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from psotrack.settings import SwarmSettings
from psotrack.support.array_types import Array, Key
from psotrack.tracking.swarm import optimiser
from psotrack.tracking.swarm.optimiser import Objective


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchRegion:
    """Bounds and step size of a search, float32, metres.

    Attributes:
        low, high: (groups, dims), bounds of the positions: the part of the room that a drone can have reached.
        max_step: (dims,), a drone's largest distance in one frame, per dimension: the largest sensible step.
    """

    low: Float[Array, "groups dims"]
    high: Float[Array, "groups dims"]
    max_step: Float[Array, "dims"]


@runtime_checkable
class Search(Protocol):
    """Finds the positions of largest objective, for several groups that are independent of one another.

    The tracker calls the search once per frame, inside a compiled function (`jax.jit`, in a scan over the frames, and
    under `jax.vmap` where an accelerator computes several runs at once). So the search must be a pure function of its
    arguments, written with JAX operations; loops over iterations use `jax.lax.fori_loop`, because the number of
    iterations is traced. Shapes (particles, groups, dims) are static.

    The search itself is a JAX pytree: its arrays may change without a new compilation, everything else is compiled in.
    `jax.tree_util.register_static` makes a frozen, hashable dataclass of plain settings such a pytree.

    With `swarm.kind = "per-drone"` each drone is a group with 3 dims: x, y, z in metres. With "joint" there is a single
    group with 3 x drones dims: x, y, z of the first drone, then of the second drone, and so on.
    """

    def __call__(
        self,
        key: Key,
        objective: Objective,
        first: Float[Array, "particles groups dims"],
        region: SearchRegion,
        num_iterations: Int[Array, ""],
    ) -> Float[Array, "groups dims"]:
        """Find the best position of each group: (groups, dims), metres, float32 and finite.

        Args:
            key: a JAX random key (`jax.random.key`); consumed.
            objective: maps positions (particles, groups, dims) to values (particles, groups) in [0, 1], which are
                maximised. The number of particles is fixed. A value is NaN where too few cameras see the drone; NaN is
                worse than every number, and all values of a group may be NaN.
            first: (particles, groups, dims), the first positions to evaluate, metres; some may lie outside the bounds.
                Position 0 is the tracker's prediction, position 1 the drone's last position, and the other positions
                are drawn about the prediction with the standard deviation `swarm.spread_m`, which is multiplied by the
                number of frames since the drone was last found. So a search that begins here is warm-started.
            region: bounds and step size.
            num_iterations: scalar int32, traced: number of evaluations of all particles besides the evaluation of the
                first positions. A search calls the objective `num_iterations + 1` times.
        """
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ParticleSwarm:
    """Particle swarm optimisation (see `psotrack.tracking.swarm.optimiser`).

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
        params = optimiser.SwarmParams(**vars(self), **vars(region))
        return optimiser.run(key, objective, first, params, num_iterations).gbest_position


def particle_swarm(settings: SwarmSettings) -> ParticleSwarm:
    """The particle swarm with the coefficients of the settings."""
    coefficients = (settings.inertia, settings.cognitive, settings.social)
    return ParticleSwarm(*map(jnp.float32, coefficients))
