"""A block of frames through the compiled tracker, for one run or for several: the one driver of all that is tracked.

The slots have fixed capacities, so that a new number of drones compiles nothing. A CPU computes one run after the
other, in as many threads as it has processors, and each run gives the same bits as alone. An accelerator computes the
runs side by side; each operation then works on all runs at once, and rounding may differ from the run alone in the last
bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.foreground.silhouettes import Exposures
from psotrack.geometry import Camera, Rig
from psotrack.support import as_written, processors
from psotrack.support.array_types import Key
from psotrack.tracking.births import FrameBlobs
from psotrack.tracking.swarm import tracker
from psotrack.tracking.swarm.patches import make_pyramid
from psotrack.tracking.swarm.tracker import Frames, Program, Rows, Slots, TrackerParams, TrackStarts
from psotrack.trajectories import Status

#: Number of frames of a block of a recording. Eight cameras of 1080p at a quarter of the size take 40 MB on the device.
BLOCK_FRAMES = 25
#: Numbers of slots for which the tracker is compiled; multiples of the last one follow.
CAPACITIES = (2, 4, 8, 12, 16, 24, 32, 48, 64)


def on_device(cameras: Camera) -> Camera:
    """The cameras in float32, in which the tracker computes."""
    # Not `jnp.asarray`: it compiles a program for each new shape, here and elsewhere.
    return jax.device_put(
        jax.tree.map(lambda leaf: np.asarray(leaf, bool if leaf.dtype == bool else np.float32), cameras)
    )


@dataclass(frozen=True)
class Setting:
    """What all runs of a recording share.

    Attributes:
        rig: the cameras in float64.
        reduction: image pixels per silhouette pixel, along each side.
        borders: (cameras, 2), width and height of the silhouettes in cells.
        fps: instants per second.
    """

    rig: Rig
    reduction: int
    borders: Int[np.ndarray, "cameras 2"]
    fps: float

    @cached_property
    def cameras(self) -> Camera:
        """The cameras in float32, in which the tracker computes."""
        return on_device(self.rig.cameras)


@dataclass(frozen=True)
class Block:
    """Consecutive frames of a recording; the last block of a recording is filled up with empty frames.

    Attributes:
        instant: (frames,), the instants of the frames, without those that fill up.
        coverage: (frames, cameras, height, width), silhouettes of these frames, 0 to 255.
        frames: the frames on the device, with those that fill up.
        exposures: when these frames were exposed, in NumPy; None where all cameras' frames were exposed together.
        births: what runs without drones have found in this block (see `SwarmRun.search`).
    """

    instant: Int[np.ndarray, "frames"]
    coverage: UInt8[np.ndarray, "frames cameras height width"]
    frames: Frames
    exposures: Exposures | None
    _setting: Setting = field(repr=False)
    births: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.instant)

    @cached_property
    def blobs(self) -> FrameBlobs:
        """The blobs of the frames, found once for all runs."""
        return FrameBlobs.of(self.coverage, self._setting.reduction, self._setting.borders, self.exposures)


@as_written()
def make_block(
    setting: Setting,
    instant: Int[np.ndarray, "frames"],
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    exposures: Exposures | None,
    *,
    elapsed: int = 1,
    length: int | None = None,
) -> Block:
    """A block of frames.

    Args:
        setting: what all runs share.
        instant: (frames,), the instants of the frames.
        coverage: (frames, cameras, height, width), the silhouettes, 0 to 255.
        exposures: when the frames were exposed; None where all cameras' frames were exposed together.
        elapsed: instants between the frame before the block and its first frame.
        length: number of frames to which empty frames fill up the block; None for no such frames.
    """
    length, count = length or len(coverage), len(coverage)
    filled, exposed = coverage, exposures
    if length > count:
        filled = np.concatenate([coverage, np.zeros((length - count, *coverage.shape[1:]), np.uint8)])
        exposed = None if exposures is None else exposures.padded(length)
    since = np.ones(length, np.int32)
    since[0] = elapsed
    return Block(instant, coverage, Frames(make_pyramid(filled), since, exposed), exposures, setting)


@dataclass(frozen=True)
class Job:
    """One run in one block.

    Attributes:
        slots: the drones before the block.
        starts: tracks that start in the block.
        params: parameters of the tracker.
        program: static values of the tracker.
    """

    slots: Slots
    starts: TrackStarts
    params: TrackerParams
    program: Program

    @property
    def is_empty(self) -> bool:
        """Whether no drone is followed and none begins, so that there is nothing to compute."""
        return not (np.asarray(self.slots.present).any() or (np.asarray(self.starts.frame) >= 0).any())


class Engine:
    """Computes blocks of runs on the default device.

    Args:
        setting: what all runs share.
        side_by_side: whether runs are computed side by side, not one after the other; None: on accelerators only.
    """

    def __init__(self, setting: Setting, *, side_by_side: bool | None = None) -> None:
        self._cameras = setting.cameras
        self.side_by_side = jax.default_backend() != "cpu" if side_by_side is None else side_by_side
        self._threads = ThreadPoolExecutor(processors())
        self._compiled: set[tuple[Program, int]] = set()

    def track(self, jobs: Sequence[Job], block: Block) -> list[tuple[Slots, Rows]]:
        """The drones after the block, and the rows of its frames in NumPy, for each job."""
        groups: dict[Any, list[int]] = {}
        done: dict[int, tuple[Slots, Rows]] = {}
        for number, job in enumerate(jobs):
            if job.is_empty:
                done[number] = _without_drones(job, block)
                continue
            shape = job.program, len(job.slots), jax.tree.structure(job.params)
            groups.setdefault(shape, []).append(number)
        for numbers in groups.values():
            found = self._run([jobs[number] for number in numbers], block)
            done |= dict(zip(numbers, found, strict=True))
        return [
            (slots, jax.tree.map(lambda leaf: np.asarray(leaf)[: len(block)], rows))
            for slots, rows in (done[number] for number in range(len(jobs)))
        ]

    def compile(self, job: Job, block: Block) -> None:
        """Compile the program for a job, also of slots without drones."""
        self._run([job], block)

    def _run(self, jobs: Sequence[Job], block: Block) -> list[tuple[Slots, Rows]]:
        if self.side_by_side:
            leaves = [jax.tree.leaves((job.slots, job.starts, job.params)) for job in jobs]
            together = [jnp.stack(values) for values in zip(*leaves, strict=True)]
            structure = jax.tree.structure((jobs[0].slots, jobs[0].starts, jobs[0].params))
            found = _side_by_side(together, block.frames, self._cameras, structure, jobs[0].program)
            of_slots, of_rows = jax.block_until_ready(found)
            of_one = jax.tree.structure(jobs[0].slots)
            return [
                (
                    jax.tree.unflatten(of_one, [leaf[run] for leaf in of_slots]),
                    Rows(*(leaf[run] for leaf in of_rows)),
                )
                for run in range(len(jobs))
            ]

        @as_written()  # for the threads
        def one(job: Job) -> tuple[Slots, Rows]:
            arguments = job.slots, block.frames, job.starts, self._cameras, job.params
            return jax.block_until_ready(_one_run(*arguments, job.program))

        # The first run compiles a new program, which threads would do each for itself.
        new = (jobs[0].program, len(jobs[0].slots)) not in self._compiled
        self._compiled.add((jobs[0].program, len(jobs[0].slots)))
        first = [one(jobs[0])] if new or len(jobs) == 1 else []
        return [*first, *self._threads.map(one, jobs[len(first) :])]


_one_run = jax.jit(tracker.track, static_argnames="program")


def _without_drones(job: Job, block: Block) -> tuple[Slots, Rows]:
    """What the tracker gives for slots without drones: the first block of a recording compiles nothing for it."""
    num_frames, num_cameras = len(block.frames.elapsed), block.coverage.shape[1]

    def unknown(*shape: int) -> Float[np.ndarray, "..."]:
        return np.full((num_frames, len(job.slots), *shape), np.nan, np.float32)

    none = np.zeros((num_frames, len(job.slots)), np.int32)
    rows = Rows(
        position_m=unknown(3),
        velocity_m_s=unknown(3),
        covariance_m2=unknown(3, 3),
        measured_m=unknown(3),
        measured_covariance_m2=unknown(3, 3),
        fitness=unknown(),
        num_cameras=none,
        status=none + np.int32(Status.LOST),
        box_px=unknown(num_cameras, 4),
        middle_px=unknown(num_cameras, 2),
    )
    return replace(job.slots, key=_key_after(job.slots.key, num_frames)), rows


@partial(jax.jit, static_argnames="num_frames")
def _key_after(key: Key, num_frames: int) -> Key:
    """The tracker's random key after some frames."""
    return jax.lax.fori_loop(0, num_frames, lambda _, key: tracker.next_keys(key)[0], key)


@partial(jax.jit, static_argnames=("structure", "program"))
def _side_by_side(
    leaves: list[Any], frames: Frames, cameras: Camera, structure: Any, program: Program
) -> tuple[list[Any], list[Any]]:
    """The leaves of the slots and rows of all runs: the arrays have an axis of runs, which the records do not have."""

    def one(leaves: list[Any]) -> tuple[list[Any], list[Any]]:
        slots, starts, params = jax.tree.unflatten(structure, leaves)
        slots, rows = tracker.track(slots, frames, starts, cameras, params, program)
        return jax.tree.leaves(slots), jax.tree.leaves(rows)

    return jax.vmap(one)(leaves)


def capacity(num_drones: int) -> int:
    """The smallest number of slots that holds some drones."""
    more = -(-num_drones // CAPACITIES[-1]) * CAPACITIES[-1]
    return next((each for each in CAPACITIES if each >= num_drones), more)


def grown(slots: Slots, more: Slots) -> Slots:
    """The slots, and after them the last ones of some others, so that there are as many as of these."""
    before = len(slots)
    if before == len(more):
        return slots
    key = slots.key

    def joined(first: Any, last: Any) -> Any:
        # In NumPy, because each operation of JAX would be a program of its own.
        if not first.ndim or first.dtype == key.dtype:
            return first
        return jax.device_put(np.concatenate([np.asarray(first), np.asarray(last)[before:]]))

    return replace(jax.tree.map(joined, slots, more), key=key)
