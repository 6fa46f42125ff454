"""Drones tracked through one chunk of frames: in one run, or in many runs at once.

Runs with the same number of drones and the same program form a batch: one compiled function, one copy of the
silhouettes. On a CPU the runs of a batch are computed one after the other, each as if it were alone and to the same
bits; on an accelerator side by side.
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
from psotrack.tracking.sizes import SizeMeasurements, SizeProgram, SizeState
from psotrack.trajectories import Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackedDrones:
    """Everything of a run whose arrays have an axis of drones.

    Attributes:
        state: of the tracker.
        params: of the tracker.
        sizes: the running estimate of the drones' sizes.
    """

    state: tracker.TrackerState
    params: tracker.TrackerParams
    sizes: SizeState

    def __len__(self) -> int:
        return self.params.size_m.shape[0]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chunk:
    """A chunk of silhouettes, and how many of its frames count.

    Attributes:
        coverage: (frames, cameras, height, width) uint8.
        num_frames: frames that count; the frames after them only fill the chunk.
    """

    coverage: UInt8[Array, "frames cameras height width"]
    num_frames: Int[Array, ""]


#: The drones after a chunk, the tracker's info, and the sizes that each frame shows by itself.
BatchResult = tuple[TrackedDrones, tracker.TrackerInfo, SizeMeasurements]

#: The leaves of a pytree of arrays.
Leaves = list[Any]


def track_batch(
    runs: Sequence[tuple[TrackedDrones, tracker.TrackStarts]],
    chunk: Chunk,
    cameras: Camera,
    program: tracker.Program,
    *,
    capacity: int,
    device: jax.Device,
) -> list[BatchResult]:
    """Track the drones of one or more runs through a chunk, and learn their sizes.

    Args:
        runs: of each run the drones, and the tracks that start in the chunk. All have the same number of drones.
        chunk: the silhouettes.
        cameras: with one leading axis, float32.
        program: of all runs.
        capacity: number of runs for which the function is compiled. Unused capacity costs next to nothing.
        device: computes.

    Returns:
        One result for each run. The info has all frames of the chunk.
    """
    # The first run fills the places of runs that are missing.
    filled = (*runs, *[runs[0]] * (capacity - len(runs)))
    # JAX compiles separately for arrays committed to a device and for uncommitted ones: all are committed.
    arguments = jax.device_put((filled, jnp.int32(len(runs)), chunk, cameras), device)
    return _track_batch(*arguments, program)[: len(runs)]


@partial(jax.jit, static_argnames="program")
def _track_batch(
    runs: tuple[tuple[TrackedDrones, tracker.TrackStarts], ...],
    count: Int[Array, ""],
    chunk: Chunk,
    cameras: Camera,
    program: tracker.Program,
) -> list[BatchResult]:
    structures: list[Any] = []

    # Leaves instead of records: the arrays of many runs have an axis that the records do not declare.
    def of_leaves(leaves: Leaves) -> Leaves:
        drones, starts = jax.tree.unflatten(jax.tree.structure(runs[0]), leaves)
        leaves, structure = jax.tree.flatten(_track_run(drones, starts, chunk, cameras, program))
        structures.append(structure)
        return leaves

    batch = [jnp.stack(leaves) for leaves in zip(*map(jax.tree.leaves, runs), strict=True)]
    side_by_side = jax.default_backend() != "cpu"
    tracked = jax.vmap(of_leaves)(batch) if side_by_side else _one_after_another(of_leaves, batch, count)
    return [jax.tree.unflatten(structures[0], [leaf[run] for leaf in tracked]) for run in range(len(runs))]


def _track_run(
    drones: TrackedDrones,
    starts: tracker.TrackStarts,
    chunk: Chunk,
    cameras: Camera,
    program: tracker.Program,
) -> BatchResult:
    """Track the drones of one run through a chunk, then learn their sizes from it."""
    coverage = chunk.coverage
    state, info = tracker.track(drones.state, coverage, cameras, drones.params, program, starts)
    counts = (jnp.arange(coverage.shape[0]) < chunk.num_frames)[:, None]
    well_seen = (info.status == Status.TRACKED) & counts
    position_m = jnp.nan_to_num(info.position_m)
    floor_z_m = drones.params.bounds_m[0, 2]
    measured = sizes.measure_sizes(
        coverage,
        position_m,
        well_seen,
        drones.params.size_m,
        cameras,
        SizeProgram(program.windows, program.score.ring, program.reduction),
        floor_z_m,
    )
    learned = sizes.learn_sizes(drones.sizes, measured)
    return TrackedDrones(state, replace(drones.params, size_m=learned.size_m), learned), info, measured


def _one_after_another(of_leaves: Callable[[Leaves], Leaves], batch: Leaves, count: Int[Array, ""]) -> Leaves:
    """The first `count` runs of a batch, one after the other; the results of the other runs are 0.

    Barriers keep the loop apart from the code that it repeats, and the compiler does not know the number of
    repetitions: the same instructions run for a batch of any size, so the same bits come out.
    """

    def at(number: Array) -> Leaves:
        alone = [jax.lax.dynamic_index_in_dim(leaf, number, keepdims=False) for leaf in batch]
        return jax.lax.optimization_barrier(of_leaves(jax.lax.optimization_barrier(alone)))

    def body(number: Array, done: Leaves) -> Leaves:
        return [
            jax.lax.dynamic_update_index_in_dim(of_all, new, number, 0)
            for of_all, new in zip(done, at(number), strict=True)
        ]

    shapes = jax.eval_shape(at, jnp.int32(0))
    empty = [jnp.zeros((batch[0].shape[0], *leaf.shape), leaf.dtype) for leaf in shapes]
    return jax.lax.fori_loop(0, count, body, empty)
