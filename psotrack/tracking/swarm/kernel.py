"""The swarm per drone as one kernel per frame, for GPUs (`swarm.search = "pso-kernel"`). Unproven: no GPU has run it.

XLA starts several kernels on a GPU for every iteration of the swarm. Here one kernel, in Pallas for Triton, computes
all iterations: a block of threads for each run and drone, in which a thread computes the score of one particle in one
camera. The drone's windows, 135 KB for eight cameras, are left to the processor's cache: Triton has no say over shared
memory.

The swarm, the boxes and the score are the functions of the other modules, which get references instead of arrays where
they read single elements. Triton knows only arrays whose sizes are powers of two. So particles, dimensions and cameras
are filled up: with particles that rest, and with cameras that do not see the drone. On a CPU, Pallas interprets the
kernel, which is slow and meant for tests.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas
from jax.experimental.pallas import triton
from jaxtyping import Float, Int

from psotrack.errors import SettingsError
from psotrack.geometry import Camera, boxes_at
from psotrack.settings import SwarmKind, SwarmSettings
from psotrack.support.array_types import Array, Key
from psotrack.tracking.swarm import optimiser
from psotrack.tracking.swarm.fitness import DroneFitness, Score, ScoreInputs, SoftIoU, weighted_fitness
from psotrack.tracking.swarm.optimiser import Objective
from psotrack.tracking.swarm.search import SearchRegion

#: Dimensions of a position, filled up to a power of two.
_DIMS = 4
#: Threads of a warp, and the largest number of warps of a block of threads.
_WARP, _MOST_WARPS = 32, 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KernelSwarm:
    """`ParticleSwarm` for one swarm per drone, as one kernel; the results differ in rounding only.

    Attributes:
        inertia, cognitive, social: coefficients w, c1 and c2.
        most_iterations: largest number of iterations with which the search is called; static.
    """

    inertia: Float[Array, ""]
    cognitive: Float[Array, ""]
    social: Float[Array, ""]
    most_iterations: int = field(metadata={"static": True})

    def __call__(
        self,
        key: Key,
        objective: Objective,
        first: Float[Array, "particles groups dims"],
        region: SearchRegion,
        num_iterations: Int[Array, ""],
    ) -> Float[Array, "groups dims"]:
        """See `Search`.

        Raises:
            SettingsError: the objective is not the soft score of each drone, or a lens is a fisheye.
        """
        if not isinstance(objective, DroneFitness):
            raise _refused("another objective")
        inputs = objective.inputs
        check_kernel("per-drone", inputs.score)
        if inputs.extents.cameras.fisheye is not None:
            raise _refused("a fisheye lens")

        def drawn(iteration: Array) -> Array:
            return jnp.stack(optimiser.random_factors(jax.random.fold_in(key, iteration), first.shape))

        factors = jax.vmap(drawn)(jnp.arange(self.most_iterations))
        coefficients = jnp.stack([self.inertia, self.cognitive, self.social])
        # Shapes of the records have no axis of drones inside of `vmap`, so that their leaves are passed.
        parts, structure = jax.tree.flatten(inputs, is_leaf=lambda part: isinstance(part, Camera))
        leaves, axes = zip(*(_along_drones(part, first.shape[1]) for part in parts), strict=True)
        bounds = jnp.stack([region.low, region.high, jnp.broadcast_to(region.max_step, region.low.shape)])
        search = jax.vmap(partial(_search, structure), in_axes=(1, 3, 1, None, None, axes))
        return search(first, factors, bounds, coefficients, num_iterations, leaves)


def kernel_swarm(settings: SwarmSettings) -> KernelSwarm:
    """The kernel with the coefficients and the number of iterations of the settings."""
    return KernelSwarm(
        inertia=jnp.float32(settings.inertia),
        cognitive=jnp.float32(settings.cognitive),
        social=jnp.float32(settings.social),
        most_iterations=settings.iterations,
    )


def check_kernel(kind: SwarmKind, score: Score) -> None:
    """Raise `SettingsError` unless the kernel can compute swarms of this kind with this score."""
    if kind != "per-drone":
        raise _refused(f"swarm.kind {kind}")
    if type(score) is not SoftIoU or score.whole_pixels:
        raise _refused("another score")


def _refused(found: str) -> SettingsError:
    expected = "swarm.kind per-drone, score.kind soft and no fisheye lens"
    return SettingsError("swarm.search pso-kernel", expected=expected, found=found)


def _along_drones(leaf: Any, drones: int) -> tuple[Any, int | None]:
    """A leaf of `ScoreInputs`, and its axis of drones; None for what the drones share."""
    if isinstance(leaf, Camera) or leaf.ndim == 1:
        return leaf, None
    if leaf.ndim == 2:
        return leaf, 0
    height1, windows, width1 = leaf.shape
    return leaf.reshape(height1, drones, windows // drones, width1), 1


def _search(
    structure: Any,
    first: Float[Array, "particles dims"],
    factors: Float[Array, "iterations 2 particles dims"],
    bounds: Float[Array, "3 dims"],
    coefficients: Float[Array, "3"],
    num_iterations: Int[Array, ""],
    leaves: Any,
) -> Float[Array, "dims"]:
    """Search for one drone; bounds are `low`, `high` and `max_step`, the leaves those of `ScoreInputs`."""
    particles, dims = first.shape
    inputs = _with_more_cameras(jax.tree.unflatten(structure, leaves))
    cameras, filled = inputs.patches.clear.shape[-1], pallas.next_power_of_2(particles)

    def with_more_dims(values: Array) -> Array:
        return jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, _DIMS - dims)])[..., None, :]

    # A particle that rests where another one began is never better than that one.
    resting = jnp.broadcast_to(first[-1], (filled - particles, dims))
    operands = (
        with_more_dims(jnp.concatenate([first, resting])),
        with_more_dims(jnp.pad(factors, [(0, 0), (0, 0), (0, filled - particles), (0, 0)])),
        with_more_dims(bounds),
        coefficients,
        num_iterations[None],
        inputs,
    )
    leaves, operands_structure = jax.tree.flatten(operands)
    call = partial(
        pallas.pallas_call,
        partial(_kernel, operands_structure, [leaf.shape for leaf in leaves], cameras),
        out_shape=jax.ShapeDtypeStruct((1, _DIMS), jnp.float32),
        compiler_params=triton.CompilerParams(num_warps=min(_MOST_WARPS, -(-filled * cameras // _WARP))),
    )
    full = [leaf for leaf in leaves if leaf.size]
    best = jax.lax.platform_dependent(*full, cpu=call(interpret=True), default=call())
    return best[0, :dims]


def _with_more_cameras(inputs: ScoreInputs) -> ScoreInputs:
    """The inputs of one drone with a power of two of cameras; those that are added have no weight."""
    seen, patches = inputs.extents, inputs.patches
    cameras = patches.clear.shape[-1]
    more = 0, pallas.next_power_of_2(cameras) - cameras

    def repeated(leaf: Array) -> Array:
        return jnp.pad(leaf, [more, *[(0, 0)] * (leaf.ndim - 1)], mode="edge")

    def of_cameras(record: Any, *others: str) -> dict[str, Any]:
        return {
            name: jax.tree.map(repeated, value) for name, value in vars(record).items() if name not in others
        }

    patches = replace(
        patches,
        tables=jnp.pad(patches.tables, [(0, 0), more, (0, 0)]),
        clear=jnp.pad(patches.clear, more),
        **of_cameras(patches, "tables", "clear", "reduction", "packed", "whole_cells"),
    )
    return replace(inputs, extents=replace(seen, **of_cameras(seen, "size_m")), patches=patches)


def _kernel(structure: Any, shapes: list[tuple[int, ...]], cameras: int, *references: Any) -> None:
    """The whole search for one drone; the last reference is that of the best position, (1, dims).

    The other references are those of the operands that are not empty: a kernel has no empty arrays.
    """
    *full, best = references
    given = iter(full)
    operands = [next(given) if 0 not in shape else np.empty(shape, np.float32) for shape in shapes]
    # The numbers of cameras are loaded once; what is indexed stays a reference.
    loaded = [operand[...] if operand.shape == (cameras,) else operand for operand in operands]
    first, factors, bounds, coefficients, num_iterations, inputs = jax.tree.unflatten(structure, loaded)
    inertia, cognitive, social = (coefficients[number] for number in range(3))
    params = optimiser.SwarmParams(
        inertia, cognitive, social, low=bounds[0], high=bounds[1], max_step=bounds[2, 0]
    )
    score, dim = inputs.score, jnp.arange(_DIMS)

    def objective(position: Float[Array, "particles 1 dims"]) -> Float[Array, "particles 1"]:
        x_m, y_m, z_m = (jnp.where(dim == axis, position, 0.0).sum(axis=-1) for axis in range(3))
        of_cameras, weight = score.box_scores(inputs, boxes_at(inputs.extents, x_m, y_m, z_m))
        return weighted_fitness(of_cameras, weight, score.min_cameras)[:, None]

    def factors_of(iteration: Array) -> optimiser.Factors:
        return factors[iteration, 0], factors[iteration, 1]

    final = optimiser.repeat(factors_of, objective, first[...], params, num_iterations[0])
    best[...] = final.gbest_position
