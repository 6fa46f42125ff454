"""Tracking of one chunk of frames, for one run or for many runs at once.

Runs with the same number of drones and the same program form a batch: one compiled function, one copy of the
silhouettes. On a CPU the runs of a batch are computed one after the other, and each run gives the same bits as alone.
On an accelerator the runs are computed side by side; each operation then works on all runs at once, and rounding may
differ from the run alone in the last bits.
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
from psotrack.silhouettes import Exposures
from psotrack.support import stored_jit
from psotrack.tracking import sizes, tracker
from psotrack.tracking.devices import computes_side_by_side
from psotrack.tracking.sizes import SizeMeasurements, SizeProgram, SizeState
from psotrack.trajectories import Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackedDrones:
    """The records of a run whose arrays have an axis of drones.

    Attributes:
        state: state of the tracker.
        params: parameters of the tracker.
        sizes: running estimate of the drones' sizes.
    """

    state: tracker.TrackerState
    params: tracker.TrackerParams
    sizes: SizeState

    def __len__(self) -> int:
        return self.params.size_m.shape[0]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chunk:
    """A chunk of silhouettes; the last chunk of a recording is filled up with empty frames.

    Attributes:
        coverage: (frames, cameras, height, width) uint8, foreground of each cell, 0 to 255.
        num_frames: number of frames of the recording in this chunk; the empty frames come after these.
        exposures: when the frames were exposed, with an axis of frames; None where all cameras' frames were exposed
            together.
    """

    coverage: UInt8[Array, "frames cameras height width"]
    num_frames: Int[Array, ""]
    exposures: Exposures | None = None


#: The drones after a chunk, the tracker's info, and the sizes measured in each frame.
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
    side_by_side: bool | None = None,
) -> list[BatchResult]:
    """Track the drones of one or more runs through a chunk, and learn their sizes.

    Args:
        runs: drones of each run, and the tracks that start in the chunk. All runs have the same number of drones.
        chunk: the silhouettes.
        cameras: cameras with one leading axis, float32.
        program: static values of the tracker, the same for all runs.
        capacity: number of runs for which the function is compiled. Unused capacity costs next to nothing where runs
            are computed one after the other; side by side it is computed too.
        device: device that computes.
        side_by_side: whether the runs are computed side by side, not one after the other; None is the choice for the
            device (`computes_side_by_side`). Each choice is another program.

    Returns:
        One result for each run. The info has all frames of the chunk.
    """
    # The first run fills the unused places of the batch.
    filled = (*runs, *[runs[0]] * (capacity - len(runs)))
    # JAX compiles separately for arrays committed to a device and for uncommitted ones: all are committed.
    arguments = jax.device_put((filled, jnp.int32(len(runs)), chunk, cameras), device)
    if side_by_side is None:
        side_by_side = computes_side_by_side(device.platform)
    return _track_batch(*arguments, program, side_by_side)[: len(runs)]


@partial(stored_jit, static_argnames=("program", "side_by_side"))
def _track_batch(
    runs: tuple[tuple[TrackedDrones, tracker.TrackStarts], ...],
    count: Int[Array, ""],
    chunk: Chunk,
    cameras: Camera,
    program: tracker.Program,
    side_by_side: bool,
) -> list[BatchResult]:
    structures: list[Any] = []

    # Leaves instead of records: arrays of many runs have an axis of runs, which the records do not declare.
    def track_leaves(leaves: Leaves) -> Leaves:
        drones, starts = jax.tree.unflatten(jax.tree.structure(runs[0]), leaves)
        leaves, structure = jax.tree.flatten(_track_run(drones, starts, chunk, cameras, program))
        structures.append(structure)
        return leaves

    batch = [jnp.stack(leaves) for leaves in zip(*map(jax.tree.leaves, runs), strict=True)]
    tracked = (
        jax.vmap(track_leaves)(batch) if side_by_side else _one_after_another(track_leaves, batch, count)
    )
    return [jax.tree.unflatten(structures[0], [leaf[run] for leaf in tracked]) for run in range(len(runs))]


def _track_run(
    drones: TrackedDrones,
    starts: tracker.TrackStarts,
    chunk: Chunk,
    cameras: Camera,
    program: tracker.Program,
) -> BatchResult:
    """Track the drones of one run through a chunk, then learn their sizes from the chunk."""
    coverage = chunk.coverage
    state, info = tracker.track(
        drones.state, coverage, cameras, drones.params, program, starts, chunk.exposures
    )
    counts = (jnp.arange(coverage.shape[0]) < chunk.num_frames)[:, None]
    well_seen = (info.status == Status.TRACKED) & counts
    position_m = jnp.where(well_seen[..., None], info.position_m, jnp.nan)
    floor_z_m = drones.params.bounds_m[0, 2]
    measured = sizes.measure_sizes(
        coverage,
        position_m,
        drones.params.size_m,
        cameras,
        SizeProgram(program.windows, program.score.ring, program.reduction),
        floor_z_m,
        None if chunk.exposures is None else (jnp.nan_to_num(info.velocity_m_s), chunk.exposures),
    )
    learned = sizes.learn_sizes(drones.sizes, measured)
    return TrackedDrones(state, replace(drones.params, size_m=learned.size_m), learned), info, measured


def _one_after_another(
    track_leaves: Callable[[Leaves], Leaves], batch: Leaves, count: Int[Array, ""]
) -> Leaves:
    """The first `count` runs of a batch, one after the other; the results of the other runs are 0.

    Barriers keep the compiler from merging the loop with the code that the loop repeats, and the compiler does not know
    the number of repetitions. So the same instructions run for a batch of any size, and the result has the same bits.
    """

    def at(number: Array) -> Leaves:
        alone = [jax.lax.dynamic_index_in_dim(leaf, number, keepdims=False) for leaf in batch]
        return jax.lax.optimization_barrier(track_leaves(jax.lax.optimization_barrier(alone)))

    def body(number: Array, done: Leaves) -> Leaves:
        return [
            jax.lax.dynamic_update_index_in_dim(all_runs, new, number, 0)
            for all_runs, new in zip(done, at(number), strict=True)
        ]

    shapes = jax.eval_shape(at, jnp.int32(0))
    empty = [jnp.zeros((batch[0].shape[0], *leaf.shape), leaf.dtype) for leaf in shapes]
    return jax.lax.fori_loop(0, count, body, empty)
