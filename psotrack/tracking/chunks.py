"""Tracking of a whole recording, chunk by chunk.

The compiled tracker tracks a fixed number of drones. After each chunk of frames, the foreground that no track explains
is searched for new drones and for lost drones; the chunk is then tracked again with the new tracks. The sizes of the
drones are learned chunk by chunk.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack._typing import Array, Key, Positions
from psotrack.geometry import Camera, Rig
from psotrack.initiation import (
    InitialState,
    KnownDrones,
    PlannedStarts,
    find_candidates,
    find_false_tracks,
    find_lost_tracks,
    plan_starts,
    reidentify,
)
from psotrack.motion import motion_params
from psotrack.silhouettes import Silhouettes, moved_by
from psotrack.support import Report, no_progress, stored_jit
from psotrack.tracking import sizes, tracker
from psotrack.tracking.batch import BatchResult, Chunk, TrackedDrones, track_batch
from psotrack.tracking.devices import largest_share, num_used_devices, share_among_devices
from psotrack.tracking.parameters import TrackerSettings, tracker_params, tracker_program
from psotrack.tracking.sizes import SizeMeasurements, SizeState
from psotrack.trajectories import Arrival, DroneSizes, Status, Tracks, unknown_value

logger = logging.getLogger(__name__)

#: Number of frames of a chunk. Eight cameras of 1080p at a quarter of the size take 26 MB on the device.
CHUNK_FRAMES = 25

#: Records whose arrays have the axes (frames, drones, ...).
Frames = TypeVar("Frames", tracker.TrackerInfo, SizeMeasurements)


@dataclass(frozen=True)
class RunInputs:
    """Inputs of one run of the tracker.

    Attributes:
        initial: positions, velocities and sizes of the drones at frame 0; may have no drones.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        settings: the tracker's parts of the settings.
    """

    initial: InitialState
    bounds_m: Float[np.ndarray, "2 3"]
    settings: TrackerSettings


@dataclass(frozen=True)
class _History:
    """States of a run's drones in all frames so far, in NumPy.

    Attributes:
        position_m, velocity_m_s: (frames, drones, 3), metres and m/s; NaN where the drone has no track.
        tracked: (frames, drones), whether the drone was found, and not only predicted.
    """

    position_m: Float[np.ndarray, "frames drones 3"]
    velocity_m_s: Float[np.ndarray, "frames drones 3"]
    tracked: Bool[np.ndarray, "frames drones"]

    @classmethod
    def empty(cls, num_drones: int) -> _History:
        """The history before the first frame."""
        none_m = np.empty((0, num_drones, 3))
        return cls(none_m, none_m, np.empty((0, num_drones), bool))

    def joined(self, info: tracker.TrackerInfo) -> _History:
        """The history with the frames of one more chunk, which may have more drones."""
        more = [(0, 0), (0, info.status.shape[1] - self.tracked.shape[1])]
        position_m, velocity_m_s = (
            np.concatenate([np.pad(before, [*more, (0, 0)], constant_values=np.nan), after])
            for before, after in (
                (self.position_m, info.position_m),
                (self.velocity_m_s, info.velocity_m_s),
            )
        )
        tracked = np.concatenate([np.pad(self.tracked, more), np.asarray(info.status) == Status.TRACKED])
        return _History(position_m, velocity_m_s, tracked)


@dataclass
class _Run:
    """A run in progress: its inputs, and its results so far."""

    inputs: RunInputs
    program: tracker.Program
    drones: TrackedDrones
    history: _History
    infos: list[tracker.TrackerInfo] = field(default_factory=list)
    measured: list[SizeMeasurements] = field(default_factory=list)
    arrivals: list[Arrival] = field(default_factory=list)


@dataclass(frozen=True)
class _Setting:
    """Values that all runs on one device share.

    Attributes:
        rig: the cameras in float64.
        cameras: the same cameras in float32, in which the tracker computes.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        device: device that computes.
    """

    rig: Rig
    cameras: Camera
    reduction: int
    fps: float
    device: jax.Device


def track_silhouettes(
    rig: Rig,
    silhouettes: Silhouettes,
    runs: Sequence[RunInputs],
    *,
    fps: float,
    side_by_side: bool | None = None,
    report: Report = no_progress,
) -> list[tuple[Tracks, float]]:
    """Track the drones of one or more runs through all frames; the runs share all devices (`jax.devices()`).

    Args:
        rig: calibrated cameras.
        silhouettes: silhouettes of all cameras of the rig.
        runs: inputs of each run.
        fps: frames per second.
        side_by_side: whether a device computes its runs side by side, not one after the other; None is the choice for
            the device (see `track_batch`).
        report: shows the progress in frames; all runs go through the frames together.

    Returns:
        For each run its tracks, and its share of the time of compiling, seconds.
    """
    kinds = [_kind(tracker_program(run.settings, silhouettes.reduction), run.settings) for run in runs]
    capacity = {kind: largest_share(kinds, kind) for kind in set(kinds)}
    work = partial(_track_through_chunks, rig, silhouettes, fps, capacity, side_by_side)
    tracked = share_among_devices(runs, kinds, work, report)
    # All devices compile at the same time, so the time of compiling is counted once.
    return [(tracks, compile_s / num_used_devices(len(runs))) for tracks, compile_s in tracked]


def on_device(cameras: Camera) -> Camera:
    """The cameras in float32, in which the tracker computes."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float32), cameras)


def _kind(program: tracker.Program, settings: TrackerSettings) -> Hashable:
    """Static values for which a run's program is compiled, besides the number of drones; a batch has one kind."""
    return program, jax.tree.structure(settings.search)


def _track_through_chunks(  # noqa: PLR0913  # A share of runs is given like `track_silhouettes` itself.
    rig: Rig,
    silhouettes: Silhouettes,
    fps: float,
    capacity: dict[Hashable, int],
    side_by_side: bool | None,
    inputs: list[RunInputs],
    device: jax.Device,
    report: Report,
) -> list[tuple[Tracks, float]]:
    """Track some runs together through all chunks, on one device."""
    setting = _Setting(rig, on_device(rig.cameras), silhouettes.reduction, fps, device)
    batches = _Batches(setting, _blank_chunk(silhouettes), capacity, side_by_side)
    runs = [_begin(each, setting) for each in inputs]
    with report("track", silhouettes.num_frames) as advance:
        for first, chunk in _chunks(silhouettes):
            num_frames = int(chunk.num_frames)
            tracked = batches.track(runs, [None] * len(runs), chunk)
            planned = [
                _plan_new_tracks(chunk, info, run, setting)
                for run, (_, info, _) in zip(runs, tracked, strict=True)
            ]
            again = {number: starts for number, starts in enumerate(planned) if starts is not None}
            for number, starts in again.items():
                _add_tracks(runs[number], starts, first)
            tracked_again = batches.track([runs[number] for number in again], list(again.values()), chunk)
            for number, result in zip(again, tracked_again, strict=True):
                tracked[number] = result
            for run, (drones, info, measured) in zip(runs, tracked, strict=True):
                run.infos.append(info)
                run.measured.append(measured)
                run.history = run.history.joined(info)
                run.drones = _without_false_tracks(drones, run.history)
            advance(num_frames)
    return [(_tracks(run), batches.compile_s / len(runs)) for run in runs]


def _tracks(run: _Run) -> Tracks:
    """The results of all chunks of a run."""
    num_drones = len(run.drones)
    learned = jax.tree.map(np.asarray, run.drones.sizes)
    info, measured = _joined(run.infos, num_drones), _joined(run.measured, num_drones)
    return Tracks(
        **vars(info),
        measured_size_m=np.asarray(measured.size_m),
        sizes=DroneSizes(
            learned.size_m, np.asarray(_size_std_m(run.drones.sizes)), learned.num_frames, learned.fill
        ),
        arrivals=tuple(run.arrivals),
    )


@stored_jit
def _size_std_m(state: SizeState) -> Float[Array, "drones 3"]:
    return state.std_m


class _Batches:
    """Tracks runs in batches of equal shape, and compiles a program when a shape first occurs."""

    def __init__(
        self,
        setting: _Setting,
        blank: Chunk,
        capacity: dict[Hashable, int],
        side_by_side: bool | None,
    ) -> None:
        self.compile_s = 0.0
        self._setting = setting
        self._blank = blank
        self._capacity = capacity
        self._side_by_side = side_by_side
        self._compiled: set[Hashable] = set()

    def track(
        self,
        runs: Sequence[_Run],
        planned: Sequence[PlannedStarts | None],
        chunk: Chunk,
    ) -> list[BatchResult]:
        """Track a chunk; return for each run its drones after the chunk, and info and sizes of each frame in NumPy."""
        by_shape: dict[tuple[Hashable, int], list[int]] = {}
        for number, run in enumerate(runs):
            shape = (_kind(run.program, run.inputs.settings), len(run.drones))
            by_shape.setdefault(shape, []).append(number)
        results: dict[int, BatchResult] = {}
        for shape, numbers in by_shape.items():
            program, kind = runs[numbers[0]].program, shape[0]
            on_this_device = partial(
                track_batch,
                cameras=self._setting.cameras,
                program=program,
                capacity=self._capacity[kind],
                device=self._setting.device,
                side_by_side=self._side_by_side,
            )
            if shape not in self._compiled:
                began = time.perf_counter()
                # A blank chunk without iterations takes next to no time to track; the rest is the time of compiling.
                idle = _without_iterations(runs[numbers[0]].drones)
                starts = tracker.no_track_starts(len(idle))
                jax.block_until_ready(on_this_device([(idle, starts)], self._blank))
                self._compiled.add(shape)
                self.compile_s += time.perf_counter() - began
            batch = [
                (runs[number].drones, _track_starts(planned[number], len(runs[number].drones)))
                for number in numbers
            ]
            tracked = on_this_device(batch, chunk)
            for number, (drones, *frames) in zip(numbers, tracked, strict=True):
                info, measured = jax.tree.map(lambda leaf: np.asarray(leaf)[: chunk.num_frames], frames)
                results[number] = drones, info, measured
        return [results[number] for number in range(len(runs))]


def _without_iterations(drones: TrackedDrones) -> TrackedDrones:
    return replace(drones, params=replace(drones.params, num_iterations=jnp.int32(0)))


def _chunks(silhouettes: Silhouettes) -> Iterator[tuple[int, Chunk]]:
    """First frame of each chunk, and the chunk; empty frames fill up the last chunk.

    While a chunk is used, a thread reads the next one.
    """
    for first, coverage in _read_ahead(silhouettes):
        num_frames = len(coverage)
        exposures = silhouettes.exposures
        if exposures is not None:
            exposures = exposures[first : first + num_frames].padded(CHUNK_FRAMES)
        if num_frames < CHUNK_FRAMES:
            empty = np.zeros((CHUNK_FRAMES - num_frames, *coverage.shape[1:]), np.uint8)
            coverage = np.concatenate([coverage, empty])
        yield first, Chunk(coverage, np.array(num_frames, np.int32), exposures)


def _read_ahead(
    silhouettes: Silhouettes,
) -> Iterator[tuple[int, UInt8[np.ndarray, "frames cameras height width"]]]:
    ends = [*range(0, silhouettes.num_frames, CHUNK_FRAMES), silhouettes.num_frames]
    with ThreadPoolExecutor(1) as thread:
        reading = [thread.submit(silhouettes.read, *ends[:2])]
        for number, first in enumerate(ends[:-1]):
            coverage = reading.pop().result()
            if number + 2 < len(ends):
                reading.append(thread.submit(silhouettes.read, *ends[number + 1 : number + 3]))
            yield first, coverage


def _blank_chunk(silhouettes: Silhouettes) -> Chunk:
    """A chunk of the silhouettes' shape without foreground."""
    shape = (CHUNK_FRAMES, len(silhouettes.cameras), *silhouettes.shape)
    exposures = silhouettes.exposures
    if exposures is not None:
        exposures = exposures[:0].padded(CHUNK_FRAMES)
    return Chunk(np.zeros(shape, np.uint8), np.array(CHUNK_FRAMES, np.int32), exposures)


def _begin(inputs: RunInputs, setting: _Setting) -> _Run:
    """Prepare a run for the first frame."""
    initial, settings = inputs.initial, inputs.settings
    program = tracker_program(settings, setting.reduction)
    params = tracker_params(settings, initial.size_m, fps=setting.fps, bounds_m=inputs.bounds_m)
    drones = _first_drones(
        jax.random.key(settings.seed),
        np.asarray(initial.position_m, np.float32),
        np.asarray(initial.velocity_m_s, np.float32),
        params,
        is_pinned=_is_pinned(settings),
        num_windows=len(program.windows),
    )
    return _Run(inputs, program, drones, _History.empty(len(drones)))


@partial(stored_jit, static_argnames=("is_pinned", "num_windows"))
def _first_drones(
    key: Key,
    position_m: Positions,
    velocity_m_s: Positions,
    params: tracker.TrackerParams,
    *,
    is_pinned: bool,
    num_windows: int,
) -> TrackedDrones:
    """The drones before the first frame; one program, because each operation alone would be a program of its own."""
    state = tracker.init(key, position_m, velocity_m_s, params)
    return TrackedDrones(state, params, _initial_sizes(params.size_m, is_pinned, num_windows))


def _initial_sizes(size_m: Array, is_pinned: bool, num_windows: int) -> SizeState:
    return sizes.init(size_m, jnp.full(size_m.shape, is_pinned), num_windows)


def _is_pinned(settings: TrackerSettings) -> bool:
    """Whether the sizes stay as they are."""
    return not settings.drones.learn_sizes or settings.drones.size_m is not None


def _track_starts(planned: PlannedStarts | None, num_drones: int) -> tracker.TrackStarts:
    """Planned starts as the tracker's arrays."""
    if planned is None:
        return tracker.no_track_starts(num_drones)
    return tracker.TrackStarts(
        frame=jnp.asarray(planned.begin_frame, jnp.int32),
        position_m=jnp.asarray(planned.begin_position_m, jnp.float32),
        velocity_m_s=jnp.asarray(planned.begin_velocity_m_s, jnp.float32),
    )


def _plan_new_tracks(
    chunk: Chunk, info: tracker.TrackerInfo, run: _Run, setting: _Setting
) -> PlannedStarts | None:
    """Plan the tracks that start, or start again, in the chunk that was just tracked; None if no track starts."""
    settings, drones, fps = run.inputs.settings, run.drones, setting.fps
    coverage = np.asarray(chunk.coverage)[: chunk.num_frames]
    size_m = np.asarray(drones.params.size_m, np.float64)
    whole = run.history.joined(info)
    lost = find_lost_tracks(
        whole.position_m,
        whole.velocity_m_s,
        whole.tracked,
        size_m,
        chunk_frames=len(coverage),
        fps=fps,
    )
    count = settings.drones.count
    max_births = None if count is None else max(count - len(drones), 0)
    if max_births == 0 and not len(lost.drone):
        # No birth is allowed and no drone is lost, so the search would find nothing. It is slow on noisy silhouettes.
        return None
    candidates = find_candidates(
        setting.rig.cameras,
        coverage,
        replace(
            _known_drones(chunk, info, whole, size_m), min_viewpoints=settings.status.min_cameras_to_begin
        ),
        reduction=setting.reduction,
        fps=fps,
        bounds_m=run.inputs.bounds_m,
        max_speed_m_s=settings.motion.speed_limit_m_s,
    )
    assignment = reidentify(
        candidates,
        lost,
        fps=fps,
        bounds_m=run.inputs.bounds_m,
        max_speed_m_s=settings.motion.speed_limit_m_s,
        max_births=max_births,
    )
    planned = plan_starts(candidates, assignment, lost, len(drones))
    return planned if (planned.begin_frame >= 0).any() else None


def _known_drones(
    chunk: Chunk, info: tracker.TrackerInfo, whole: _History, size_m: Float[np.ndarray, "drones 3"]
) -> KnownDrones:
    """The drones that were tracked in the chunk, where the cameras' frames show them."""
    position_m = np.asarray(info.position_m, np.float64)
    known = KnownDrones(position_m, _known_well(whole.tracked, len(position_m)), size_m)
    if chunk.exposures is None:
        return known
    exposures = chunk.exposures[: len(position_m)]
    moved_m = moved_by(exposures, np.asarray(info.velocity_m_s, np.float64))
    return replace(known, moved_m=moved_m, is_there=np.asarray(exposures.is_there))


def _without_false_tracks(drones: TrackedDrones, history: _History) -> TrackedDrones:
    """Mark the tracks that turned out to follow no drone as absent from the next chunk on."""
    size_m = np.asarray(drones.params.size_m, np.float64)
    is_false = find_false_tracks(history.position_m, history.tracked, size_m)
    if not is_false.any():
        return drones
    present = drones.state.present & ~jnp.asarray(is_false)
    return replace(drones, state=replace(drones.state, present=present))


def _known_well(
    tracked: Bool[np.ndarray, "all drones"], num_frames: int
) -> Bool[np.ndarray, "frames drones"]:
    """Whether a drone's position is known well enough to explain foreground, for each of the last frames.

    The limit is the tracker's limit for occlusion: at most `MAX_OCCLUDING_FRAMES` since the drone was found.
    """
    tracked = tracked[max(len(tracked) - num_frames - tracker.MAX_OCCLUDING_FRAMES, 0) :]
    recent = tracked.copy()
    for shift in range(1, tracker.MAX_OCCLUDING_FRAMES + 1):
        recent[shift:] |= tracked[:-shift]
    return recent[len(tracked) - num_frames :]


def _add_tracks(run: _Run, planned: PlannedStarts, first_frame: int) -> None:
    """Add the new drones, which are absent until their first frame; record and log all starts."""
    num_known, settings, born_m = len(run.drones), run.inputs.settings, planned.born_size_m
    if len(born_m):
        if settings.drones.size_m is not None:
            born_m = np.broadcast_to(np.array(settings.drones.size_m), born_m.shape)
        drones = run.drones
        size_m = jnp.concatenate([drones.params.size_m, jnp.asarray(born_m, jnp.float32)])
        params = replace(drones.params, size_m=size_m, motion=motion_params(settings.motion, len(size_m)))
        added = _initial_sizes(size_m[num_known:], _is_pinned(settings), len(run.program.windows))
        run.drones = TrackedDrones(
            tracker.with_added_tracks(drones.state, params),
            params,
            sizes.with_added_drones(drones.sizes, added),
        )
    for drone in np.flatnonzero(planned.begin_frame >= 0).tolist():
        arrival = Arrival(first_frame + int(planned.begin_frame[drone]), drone, again=drone < num_known)
        logger.info("frame %d: drone %d %s", arrival.frame, drone, "is back" if arrival.again else "is new")
        run.arrivals.append(arrival)


def _joined(parts: list[Frames], num_drones: int) -> Frames:
    """Join the frames of all parts; values of drones that a part does not have are unknown."""

    def filled(value: np.ndarray, name: str) -> np.ndarray:
        missing = [(0, 0), (0, num_drones - value.shape[1]), *[(0, 0)] * (value.ndim - 2)]
        return np.pad(value, missing, constant_values=unknown_value(name, value.dtype))

    return type(parts[0])(
        **{
            each.name: np.concatenate([filled(getattr(part, each.name), each.name) for part in parts])
            for each in fields(parts[0])
        }
    )
