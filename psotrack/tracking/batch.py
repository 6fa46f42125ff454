"""The drones that are followed, and how they are followed through a chunk of frames: in one run, or in many at once.

Runs whose drones are as many and whose program is the same are a batch axis: one compiled function, one copy of the
silhouettes. On a processor each run of a batch is computed after the other, as if it were alone, and to the same bits;
on an accelerator side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Int, UInt8

from psotrack._typing import Array
from psotrack.geometry import Camera
from psotrack.tracking import sizes, tracker
from psotrack.tracking.sizes import SizeMeasurements, SizeState
from psotrack.trajectories import Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackedDrones:
    """All that has the number of drones as a shape."""

    state: tracker.TrackerState
    params: tracker.TrackerParams
    sizes: SizeState

    def __len__(self) -> int:
        return self.params.size_m.shape[0]


#: A crew after a chunk, what is known of the chunk's frames, and the sizes that each of them shows by itself.
BatchResult = tuple[TrackedDrones, tracker.TrackerInfo, SizeMeasurements]

#: Of records of JAX arrays.
Leaves = list[Any]


def track_batch(
    crews: Sequence[TrackedDrones],
    arrivals: Sequence[tracker.TrackStarts],
    coverage: UInt8[Array, "frames cameras height width"],
    num_frames: int,
    cameras: Camera,
    program: tracker.Program,
    *,
    capacity: int,
    device: jax.Device,
) -> list[BatchResult]:
    """Follow the drones of some runs through a chunk, and learn their sizes.

    Args:
        crews: of one run or more, each of as many drones.
        arrivals: of each run (see `tracker.no_track_starts`).
        coverage: (frames, cameras, height, width) uint8; a chunk of silhouettes.
        num_frames: so many of its frames count; what fills the chunk teaches nothing.
        cameras: in float32.
        program: of all of the runs.
        capacity: of the compiled function: so many runs at most. To leave some of it empty costs next to nothing.
        device: that computes.

    Returns:
        One for each crew. The info has all frames of the chunk.
    """
    given = _filled(crews, capacity), _filled(arrivals, capacity), jnp.int32(len(crews))
    # What was put on a device and what just is there are not alike to JAX, which would compile for each.
    followed = _follow(*jax.device_put((*given, coverage, jnp.int32(num_frames), cameras), device), program)
    return followed[: len(crews)]


def _filled(some: Sequence[Any], size: int) -> tuple[Any, ...]:
    """The first stands in for those that are missing."""
    return (*some, *[some[0]] * (size - len(some)))


@partial(jax.jit, static_argnames="program")
def _follow(
    crews: tuple[TrackedDrones, ...],
    arrivals: tuple[tracker.TrackStarts, ...],
    count: Int[Array, ""],
    coverage: UInt8[Array, "frames cameras height width"],
    num_frames: Int[Array, ""],
    cameras: Camera,
    program: tracker.Program,
) -> list[BatchResult]:
    runs = list(zip(crews, arrivals, strict=True))
    structures: list[Any] = []

    # Leaves alone, because records of many runs at once would have axes that they do not declare.
    def one(leaves: Leaves) -> Leaves:
        crew, arrivals = jax.tree.unflatten(jax.tree.structure(runs[0]), leaves)
        leaves, structure = jax.tree.flatten(_one(crew, arrivals, coverage, num_frames, cameras, program))
        structures.append(structure)
        return leaves

    batch = [jnp.stack(leaves) for leaves in zip(*map(jax.tree.leaves, runs), strict=True)]
    side_by_side = jax.default_backend() != "cpu"
    followed = jax.vmap(one)(batch) if side_by_side else _in_turn(one, batch, count)
    return [jax.tree.unflatten(structures[0], [leaf[run] for leaf in followed]) for run in range(len(runs))]


def _one(
    crew: TrackedDrones,
    arrivals: tracker.TrackStarts,
    coverage: UInt8[Array, "frames cameras height width"],
    num_frames: Int[Array, ""],
    cameras: Camera,
    program: tracker.Program,
) -> BatchResult:
    state, info = tracker.track(crew.state, coverage, cameras, crew.params, program, arrivals)
    counts = (jnp.arange(coverage.shape[0]) < num_frames)[:, None]
    well_seen = (info.status == Status.TRACKED) & counts
    position_m = jnp.nan_to_num(info.position_m)
    floor_z_m = crew.params.bounds_m[0, 2]
    looks = sizes.measure_sizes(
        coverage, position_m, well_seen, crew.params.size_m, cameras, program.score, floor_z_m
    )
    learned = sizes.learn_sizes(crew.sizes, looks)
    return TrackedDrones(state, replace(crew.params, size_m=learned.size_m), learned), info, looks


def _in_turn(one: Callable[[Leaves], Leaves], batch: Leaves, count: Int[Array, ""]) -> Leaves:
    """The first `count` of a batch, one after the other; the others are left at 0.

    Nothing of the loop is mixed with what it repeats, and its length is not known to the compiler: the same
    instructions run for a batch of any size, so the same bits come out.
    """

    def at(number: Array) -> Leaves:
        alone = [jax.lax.dynamic_index_in_dim(leaf, number, keepdims=False) for leaf in batch]
        return jax.lax.optimization_barrier(one(jax.lax.optimization_barrier(alone)))

    def body(number: Array, done: Leaves) -> Leaves:
        return [
            jax.lax.dynamic_update_index_in_dim(everyone, new, number, 0)
            for everyone, new in zip(done, at(number), strict=True)
        ]

    shapes = jax.eval_shape(at, jnp.int32(0))
    nothing = [jnp.zeros((batch[0].shape[0], *leaf.shape), leaf.dtype) for leaf in shapes]
    return jax.lax.fori_loop(0, count, body, nothing)
