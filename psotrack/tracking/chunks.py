"""Chunk after chunk through a recording: the tracker, what it leaves unexplained, and how large the drones are.

The compiled tracker follows a fixed number of drones. Between its chunks of frames there is time to look at what it did
not explain: drones that come (the chunk is then tracked again, with them) and drones that were lost and are back. And
the drones' sizes are learned.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack._typing import Array
from psotrack.geometry import Camera, CameraRig
from psotrack.initiation import (
    InitialState,
    PlannedStarts,
    find_candidates,
    find_false_tracks,
    find_lost_tracks,
    plan_starts,
    reidentify,
)
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.support import Advance, Report, no_progress
from psotrack.tracking import sizes, tracker
from psotrack.tracking.batch import BatchResult, TrackedDrones, track_batch
from psotrack.tracking.inputs import motion_params, tracker_inputs, tracker_program
from psotrack.tracking.sizes import SizeMeasurements, SizeState
from psotrack.trajectories import Status

logger = logging.getLogger(__name__)

#: Frames that are on the device at once. Eight 1080p cameras at a quarter of the size are 26 MB.
CHUNK_FRAMES = 25

#: Records whose arrays have the axes (frames, drones, ...).
Frames = TypeVar("Frames", tracker.TrackerInfo, SizeMeasurements)


@dataclass(frozen=True)
class Arrival:
    """A drone that came after the start: frame of the video, which drone, and whether it had been lost before."""

    frame: int
    drone: int
    again: bool


@dataclass(frozen=True)
class Tracked:
    """What tracking yields, by tracks; before anyone asked which track is which drone.

    Attributes:
        info: NumPy arrays with axes (frames, drones, ...).
        sizes: what was learned of the drones' sizes.
        looks: the sizes that each frame shows by itself, NumPy arrays with axes (frames, drones, ...).
        arrivals: drones that came after the start, or came back.
        compile_s: seconds that compiling took.
    """

    info: tracker.TrackerInfo
    sizes: SizeState
    looks: SizeMeasurements
    arrivals: tuple[Arrival, ...]
    compile_s: float


@dataclass
class _Run:
    """A run on its way: what it was told, and what it has found out so far."""

    settings: TrackSettings
    bounds_m: Float[np.ndarray, "2 3"]
    program: tracker.Program
    crew: TrackedDrones
    infos: list[tracker.TrackerInfo] = field(default_factory=list)
    looks: list[SizeMeasurements] = field(default_factory=list)
    arrivals: list[Arrival] = field(default_factory=list)


@dataclass(frozen=True)
class _Place:
    """Where tracking takes place: what runs that go on together share."""

    rig: CameraRig
    cameras: Camera
    reduction: int
    fps: float
    device: jax.Device


def track_silhouettes(
    rig: CameraRig,
    silhouettes: Silhouettes,
    starts: Sequence[InitialState],
    settings: Sequence[TrackSettings],
    *,
    fps: float,
    bounds_m: Sequence[Float[np.ndarray, "2 3"]],
    report: Report = no_progress,
) -> list[Tracked]:
    """Track all frames, once for each of the settings; all devices share the runs.

    Those of equal shape on a device are one batch (see `crew`). A thread for each device: while one of them computes,
    the search for newcomers of another one has the processor.

    Args:
        rig: of the cameras.
        silhouettes: of all of them.
        starts: of each run; may be empty.
        settings: of each run.
        fps: frames per second.
        bounds_m: of each run, (2, 3): lowest and highest corner of the room.
        report: told of the frames, in which all runs go on together.
    """
    asked = list(zip(starts, settings, bounds_m, strict=True))
    programs = [tracker_program(silhouettes.reduction, each) for each in settings]
    devices = jax.devices()[: len(asked)]
    # Alike ones in turn, so that of each program every device has as many, or one more.
    alike = sorted(range(len(asked)), key=lambda number: programs.index(programs[number]))
    shares = [alike[first :: len(devices)] for first in range(len(devices))]
    capacity = {program: -(-count // len(devices)) for program, count in Counter(programs).items()}

    def track_share(share: list[int], device: jax.Device, report: Report) -> list[Tracked]:
        with jax.default_device(device):
            place = _Place(rig, on_device(rig.cameras), silhouettes.reduction, fps, device)
            runs = [_begun(*asked[number], place) for number in share]
            return _tracked(runs, capacity, silhouettes, place, report)

    stopped = threading.Event()

    @contextlib.contextmanager
    def until_stopped(description: str, total: int) -> Iterator[Advance]:
        def advance(steps: int) -> None:
            if stopped.is_set():
                raise RuntimeError("another share of the runs has failed")

        yield advance

    with ThreadPoolExecutor(len(devices)) as threads:
        # The first is ours: it tells how far they are, and whoever interrupts us is heard.
        others = [
            threads.submit(track_share, *of, until_stopped)
            for of in zip(shares[1:], devices[1:], strict=True)
        ]
        try:
            done = [track_share(shares[0], devices[0], report), *[other.result() for other in others]]
        except BaseException:
            stopped.set()
            raise
    by_run = dict(
        pair for share, of in zip(shares, done, strict=True) for pair in zip(share, of, strict=True)
    )
    # Devices compile at the same time.
    return [
        replace(by_run[number], compile_s=by_run[number].compile_s / len(devices))
        for number in range(len(asked))
    ]


def _tracked(
    runs: list[_Run],
    capacity: Mapping[tracker.Program, int],
    silhouettes: Silhouettes,
    place: _Place,
    report: Report,
) -> list[Tracked]:
    """What some runs yield, which go on together, on one device."""
    batches = _Batches(place, (CHUNK_FRAMES, len(place.rig), *silhouettes.shape), capacity)
    with report("track", silhouettes.num_frames) as advance:
        for first, chunk, frames in _chunks(silhouettes):
            followed = batches.follow(runs, [None] * len(runs), chunk, frames)
            coming = [
                _coming(chunk[:frames], [*run.infos, info], run, place)
                for run, (_, info, _) in zip(runs, followed, strict=True)
            ]
            again = {number: come for number, come in enumerate(coming) if come is not None}
            for number, come in again.items():
                _welcome(runs[number], come, first)
            once_more = batches.follow(
                [runs[number] for number in again], list(again.values()), chunk, frames
            )
            for number, result in zip(again, once_more, strict=True):
                followed[number] = result
            for run, (crew, info, looks) in zip(runs, followed, strict=True):
                run.infos.append(info)
                run.looks.append(looks)
                run.crew = _without_holes(crew, run.infos)
            advance(frames)
    return [
        Tracked(
            info=_joined(run.infos, len(run.crew)),
            sizes=jax.tree.map(np.asarray, run.crew.sizes),
            looks=_joined(run.looks, len(run.crew)),
            arrivals=tuple(run.arrivals),
            compile_s=batches.compile_s / len(runs),
        )
        for run in runs
    ]


class _Batches:
    """Follows runs, those of equal shape together; compiles for a shape when it is first seen."""

    def __init__(
        self,
        place: _Place,
        chunk_shape: tuple[int, int, int, int],
        capacity: Mapping[tracker.Program, int],
    ) -> None:
        self.compile_s = 0.0
        self._place = place
        self._blank = np.zeros(chunk_shape, np.uint8)
        self._capacity = capacity
        self._compiled: set[tuple[tracker.Program, int]] = set()

    def follow(
        self, runs: Sequence[_Run], coming: Sequence[PlannedStarts | None], chunk: np.ndarray, frames: int
    ) -> list[BatchResult]:
        """Each run's crew after a chunk, and what is known of its frames, as NumPy arrays."""
        shapes: dict[tuple[tracker.Program, int], list[int]] = {}
        for number, run in enumerate(runs):
            shapes.setdefault((run.program, len(run.crew)), []).append(number)
        followed: dict[int, BatchResult] = {}
        for shape, numbers in shapes.items():
            crews = [runs[number].crew for number in numbers]
            begin = [_begin(coming[number], shape[1]) for number in numbers]
            if shape not in self._compiled:
                self._compile(shape, crews[0])
            results = self._follow(crews, begin, chunk, frames, shape[0])
            followed |= dict(zip(numbers, results, strict=True))
        return [followed[number] for number in range(len(runs))]

    def _follow(
        self,
        crews: list[TrackedDrones],
        begin: list[tracker.TrackStarts],
        chunk: np.ndarray,
        frames: int,
        program: tracker.Program,
    ) -> list[BatchResult]:
        results = track_batch(
            crews,
            begin,
            chunk,
            frames,
            self._place.cameras,
            program,
            capacity=self._capacity[program],
            device=self._place.device,
        )
        return [
            (crew, *jax.tree.map(lambda leaf: np.asarray(leaf)[:frames], (info, looks)))
            for crew, info, looks in results
        ]

    def _compile(self, shape: tuple[tracker.Program, int], crew: TrackedDrones) -> None:
        # Without iterations a chunk takes no time but the compiler's, which is how compiling is told from tracking.
        began = time.perf_counter()
        idle = replace(crew.params, num_iterations=jnp.int32(0), num_refinements=jnp.int32(0))
        nobody = tracker.no_track_starts(shape[1])
        self._follow([replace(crew, params=idle)], [nobody], self._blank, len(self._blank), shape[0])
        self._compiled.add(shape)
        self.compile_s += time.perf_counter() - began


def on_device(cameras: Camera) -> Camera:
    """The cameras in float32: what the tracker computes in."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cameras)


def _chunks(silhouettes: Silhouettes) -> Iterator[tuple[int, np.ndarray, int]]:
    """First frame; a chunk, the last one filled up with empty frames; and the number of frames that count."""
    for first in range(0, silhouettes.num_frames, CHUNK_FRAMES):
        chunk = silhouettes.read(first, min(first + CHUNK_FRAMES, silhouettes.num_frames))
        frames = len(chunk)
        if frames < CHUNK_FRAMES:
            chunk = np.concatenate([chunk, np.zeros((CHUNK_FRAMES - frames, *chunk.shape[1:]), np.uint8)])
        yield first, chunk, frames


def _begun(
    start: InitialState, settings: TrackSettings, bounds_m: Float[np.ndarray, "2 3"], place: _Place
) -> _Run:
    program, params = tracker_inputs(place.reduction, start, settings, fps=place.fps, bounds_m=bounds_m)
    position, velocity = (jnp.asarray(value, jnp.float32) for value in (start.position_m, start.velocity_m_s))
    state = tracker.init(jax.random.key(settings.seed), position, velocity, params)
    crew = TrackedDrones(state, params, _sizes(params.size_m, settings, program))
    return _Run(settings, bounds_m, program, crew)


def _sizes(size_m: Array, settings: TrackSettings, program: tracker.Program) -> SizeState:
    pinned = not settings.learn_sizes or settings.drone_size_m is not None
    return sizes.init(size_m, jnp.full(size_m.shape, pinned), program.score)


def _begin(coming: PlannedStarts | None, num_drones: int) -> tracker.TrackStarts:
    """The same for the tracker."""
    if coming is None:
        return tracker.no_track_starts(num_drones)
    return tracker.TrackStarts(
        frame=jnp.asarray(coming.begin_frame, jnp.int32),
        position_m=jnp.asarray(coming.begin_position_m, jnp.float32),
        velocity_m_s=jnp.asarray(coming.begin_velocity_m_s, jnp.float32),
    )


def _coming(
    chunk: np.ndarray, infos: list[tracker.TrackerInfo], run: _Run, place: _Place
) -> PlannedStarts | None:
    """Drones that come, or come back, in the last of the chunks that were tracked; None if there are none."""
    settings, crew, fps, frames = run.settings, run.crew, place.fps, len(chunk)
    size_m = np.asarray(crew.params.size_m, np.float64)
    whole = _joined(infos, len(crew))
    lost = find_lost_tracks(
        np.asarray(whole.position_m, np.float64),
        np.asarray(whole.velocity_m_s, np.float64),
        np.asarray(whole.status) == Status.TRACKED,
        size_m,
        chunk_frames=frames,
        fps=fps,
    )
    births = None if settings.drones is None else max(settings.drones - len(crew), 0)
    if births == 0 and not len(lost.drone):
        # Whatever is there is nobody; with noisy silhouettes to look at it takes long.
        return None
    found = find_candidates(
        place.rig.cameras,
        chunk,
        np.asarray(infos[-1].position_m, np.float64),
        _explains(infos),
        size_m,
        reduction=place.reduction,
        fps=fps,
        bounds_m=run.bounds_m,
        max_speed_m_s=settings.max_speed_m_s,
    )
    who = reidentify(
        found,
        lost,
        fps=fps,
        bounds_m=run.bounds_m,
        max_speed_m_s=settings.max_speed_m_s,
        max_births=births,
    )
    coming = plan_starts(found, who, lost, len(crew))
    return coming if (coming.begin_frame >= 0).any() else None


def _without_holes(crew: TrackedDrones, infos: list[tracker.TrackerInfo]) -> TrackedDrones:
    """The crew without the tracks that turned out to be of no drone: they are sought no more."""
    whole = _joined(infos, len(crew))
    none = find_false_tracks(
        np.asarray(whole.position_m, np.float64),
        np.asarray(whole.status) == Status.TRACKED,
        np.asarray(crew.params.size_m, np.float64),
    )
    return replace(crew, state=replace(crew.state, present=crew.state.present & ~jnp.asarray(none)))


def _explains(infos: list[tracker.TrackerInfo]) -> Bool[np.ndarray, "frames drones"]:
    """Where in the last chunk a drone is known well enough to explain foreground, as it is to claim some."""
    tracked = _joined(infos[-2:], infos[-1].status.shape[1]).status == Status.TRACKED
    frames, recent = len(tracked), np.array(tracked)
    for shift in range(1, tracker.MAX_CLAIMING_FRAMES + 1):
        recent[shift:] |= tracked[: frames - shift]
    return recent[frames - len(infos[-1].status) :]


def _welcome(run: _Run, coming: PlannedStarts, first_frame: int) -> None:
    """Make room in the crew for those that are born, absent yet; and tell people of all that come."""
    num_known, settings, born = len(run.crew), run.settings, coming.born_size_m
    if len(born):
        if settings.drone_size_m is not None:
            born = np.broadcast_to(np.array(settings.drone_size_m), born.shape)
        crew = run.crew
        size_m = jnp.concatenate([crew.params.size_m, jnp.asarray(born, jnp.float32)])
        params = replace(crew.params, size_m=size_m, motion=motion_params(settings, len(size_m)))
        added = _sizes(size_m[num_known:], settings, run.program)
        run.crew = TrackedDrones(
            tracker.with_added_tracks(crew.state, params), params, sizes.with_added_drones(crew.sizes, added)
        )
    run.arrivals += _named(coming, first_frame, num_known)


def _joined(parts: list[Frames], num_drones: int) -> Frames:
    """All frames of the parts; of drones that a part does not know nothing is known."""

    def filled(value: np.ndarray, name: str) -> np.ndarray:
        missing = [(0, 0), (0, num_drones - value.shape[1]), *[(0, 0)] * (value.ndim - 2)]
        unknown = np.nan if value.dtype.kind == "f" else Status.LOST if name == "status" else 0
        return np.pad(value, missing, constant_values=unknown)

    return type(parts[0])(
        **{
            each.name: np.concatenate([filled(getattr(part, each.name), each.name) for part in parts])
            for each in fields(parts[0])
        }
    )


def _named(coming: PlannedStarts, first_frame: int, num_known: int) -> list[Arrival]:
    """What to tell people of those that come."""
    arrivals = []
    for drone in np.flatnonzero(coming.begin_frame >= 0).tolist():
        arrival = Arrival(first_frame + int(coming.begin_frame[drone]), drone, again=drone < num_known)
        logger.info("frame %d: drone %d %s", arrival.frame, drone, "is back" if arrival.again else "is new")
        arrivals.append(arrival)
    return arrivals
