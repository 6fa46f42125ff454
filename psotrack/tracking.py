"""Chunk after chunk through a recording: the tracker, what it leaves unexplained, and how large the drones are.

The compiled tracker follows a fixed number of drones. Between its chunks of frames there is time to look at what it did
not explain: drones that come (the chunk is then tracked again, with them) and drones that were lost and are back. And
the drones' sizes are learned.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack import sizes, tracker
from psotrack._typing import Array
from psotrack.cameras import Camera, CameraRig
from psotrack.fitness import PAPER_SCORE, ScoreSettings
from psotrack.initialisation import Start
from psotrack.lifecycle import Arrivals, arrivals_of, lost_drones, recognised
from psotrack.motion import MotionParams
from psotrack.newcomers import newcomers
from psotrack.progress import Report, silent
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.sizes import Looks, SizeState
from psotrack.trajectories import Status

logger = logging.getLogger(__name__)

#: Frames that are on the device at once. Eight 1080p cameras at a quarter of the size are 26 MB.
CHUNK_FRAMES = 25

#: Records whose arrays have the axes (frames, drones, ...).
Frames = TypeVar("Frames", tracker.TrackerInfo, Looks)


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
    looks: Looks
    arrivals: tuple[Arrival, ...]
    compile_s: float


@dataclass(frozen=True)
class _Crew:
    """The drones that are followed: all that has their number as a shape."""

    state: tracker.TrackerState
    params: tracker.TrackerParams
    sizes: SizeState

    def __len__(self) -> int:
        return self.params.size_m.shape[0]


@dataclass(frozen=True)
class _Place:
    """Where tracking takes place, and how: what does not change on the way."""

    rig: CameraRig
    cameras: Camera
    program: tracker.Program
    settings: TrackSettings
    bounds_m: Float[np.ndarray, "2 3"]
    fps: float
    chunk_shape: tuple[int, int, int, int]


def track_silhouettes(
    rig: CameraRig,
    silhouettes: Silhouettes,
    start: Start,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    report: Report = silent,
) -> Tracked:
    """Track all frames from a start, which may be empty."""
    program, params = tracker_inputs(silhouettes.reduction, start, settings, fps=fps, bounds_m=bounds_m)
    shape = (CHUNK_FRAMES, len(rig), *silhouettes.shape)
    place = _Place(rig, on_device(rig.cameras), program, settings, bounds_m, fps, shape)
    crew = _first_crew(start, params, place)
    compile_s = _compile(crew, place)
    infos: list[tracker.TrackerInfo] = []
    looks: list[Looks] = []
    arrivals: list[Arrival] = []
    with report("track", silhouettes.num_frames) as advance:
        for first, chunk, frames in _chunks(silhouettes):
            after, info = _track(crew, chunk, frames, place, None)
            coming = _coming(chunk[:frames], [*infos, info], crew, place)
            if coming is not None:
                crew = _with_room_for(coming, crew, place)
                compile_s += _compile(crew, place) if len(coming.born_size_m) else 0.0
                after, info = _track(crew, chunk, frames, place, coming)
                arrivals += _named(coming, first, len(crew) - len(coming.born_size_m))
            infos.append(info)
            learned, look = _learned(crew, chunk, info, place)
            looks.append(look)
            crew = _Crew(after, replace(crew.params, size_m=learned.size_m), learned)
            advance(frames)
    return Tracked(
        info=_joined(infos, len(crew)),
        sizes=jax.tree.map(np.asarray, crew.sizes),
        looks=_joined(looks, len(crew)),
        arrivals=tuple(arrivals),
        compile_s=compile_s,
    )


def tracker_inputs(
    reduction: int, start: Start, settings: TrackSettings, *, fps: float, bounds_m: Float[np.ndarray, "2 3"]
) -> tuple[tracker.Program, tracker.TrackerParams]:
    """What the tracker compiles, and the numbers that it is called with, from what people set."""
    soft = settings.score == "soft"
    score = ScoreSettings(windows=settings.windows) if soft else PAPER_SCORE
    program = tracker.Program(
        num_particles=settings.particles,
        joint=settings.swarm == "joint",
        claims=settings.claims and soft,
        refined=settings.refinements > 0,
        vertex=settings.vertex and soft,
        score=replace(score, reduction=reduction),
    )
    params = tracker.TrackerParams(
        num_iterations=jnp.int32(settings.iterations),
        num_refinements=jnp.int32(settings.refinements),
        size_m=jnp.asarray(start.size_m, jnp.float32),
        bounds_m=jnp.asarray(bounds_m, jnp.float32),
        dt_s=jnp.float32(1 / fps),
        max_speed_m_s=jnp.float32(settings.max_speed_m_s),
        spread_m=jnp.float32(settings.spread_m),
        inertia=jnp.float32(settings.inertia),
        cognitive=jnp.float32(settings.cognitive),
        social=jnp.float32(settings.social),
        motion=motion_params(settings, len(start.size_m)),
        min_fitness=jnp.float32(settings.min_fitness),
        min_cameras=jnp.int32(settings.min_cameras),
        max_coasting_frames=jnp.int32(round(settings.max_coasting_s * fps)),
    )
    return program, params


def motion_params(settings: TrackSettings, num_drones: int) -> MotionParams:
    """How drones move, and how their measured positions err."""
    return MotionParams(
        jerk_density_m2_s5=jnp.full(num_drones, settings.jerk_density_m2_s5, jnp.float32),
        velocity_std_m_s=jnp.float32(settings.velocity_std_m_s),
        acceleration_std_m_s2=jnp.float32(settings.acceleration_std_m_s2),
        error_share=jnp.float32(settings.error_share),
        error_time_s=jnp.float32(settings.error_time_s),
    )


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


def _first_crew(start: Start, params: tracker.TrackerParams, place: _Place) -> _Crew:
    position, velocity = (jnp.asarray(value, jnp.float32) for value in (start.position_m, start.velocity_m_s))
    state = tracker.init(jax.random.key(place.settings.seed), position, velocity, params)
    return _Crew(state, params, _sizes(params.size_m, place))


def _sizes(size_m: Array, place: _Place) -> SizeState:
    pinned = not place.settings.learn_sizes or place.settings.drone_size_m is not None
    return sizes.init(size_m, jnp.full(size_m.shape, pinned), place.program.score)


def _compile(crew: _Crew, place: _Place) -> float:
    """Have the tracker compiled for so many drones; returns the seconds that it took."""
    # Without iterations a chunk takes no time but the compiler's, which is how compiling is told from tracking.
    began = time.perf_counter()
    idle = replace(crew.params, num_iterations=jnp.int32(0), num_refinements=jnp.int32(0))
    blank = np.zeros(place.chunk_shape, np.uint8)
    _learned(crew, blank, _track(replace(crew, params=idle), blank, len(blank), place, None)[1], place)
    return time.perf_counter() - began


def _track(
    crew: _Crew, chunk: np.ndarray, frames: int, place: _Place, coming: Arrivals | None
) -> tuple[tracker.TrackerState, tracker.TrackerInfo]:
    """The state after a chunk, and what is known of its frames, as NumPy arrays."""
    begin = None
    if coming is not None:
        begin = tracker.Arrivals(
            frame=jnp.asarray(coming.begin_frame, jnp.int32),
            position_m=jnp.asarray(coming.begin_position_m, jnp.float32),
            velocity_m_s=jnp.asarray(coming.begin_velocity_m_s, jnp.float32),
        )
    after, info = tracker.track(crew.state, chunk, place.cameras, crew.params, place.program, begin)
    return after, jax.tree.map(lambda value: np.asarray(value)[:frames], info)


def _coming(
    chunk: np.ndarray, infos: list[tracker.TrackerInfo], crew: _Crew, place: _Place
) -> Arrivals | None:
    """Drones that come, or come back, in the last of the chunks that were tracked; None if there are none."""
    settings, fps, frames = place.settings, place.fps, len(chunk)
    size_m = np.asarray(crew.params.size_m, np.float64)
    found = newcomers(
        place.rig.cameras,
        chunk,
        np.asarray(infos[-1].position_m, np.float64),
        _explains(infos),
        size_m,
        reduction=place.program.score.reduction,
        fps=fps,
        bounds_m=place.bounds_m,
        max_speed_m_s=settings.max_speed_m_s,
    )
    if not found:
        return None
    whole = _joined(infos, len(crew))
    lost = lost_drones(
        np.asarray(whole.position_m, np.float64),
        np.asarray(whole.velocity_m_s, np.float64),
        np.asarray(whole.status) == Status.TRACKED,
        size_m,
        chunk_frames=frames,
        fps=fps,
    )
    births = None if settings.drones is None else max(settings.drones - len(crew), 0)
    who = recognised(
        found,
        lost,
        fps=fps,
        bounds_m=place.bounds_m,
        max_speed_m_s=settings.max_speed_m_s,
        max_births=births,
    )
    coming = arrivals_of(found, who, lost, len(crew))
    return coming if (coming.begin_frame >= 0).any() else None


def _explains(infos: list[tracker.TrackerInfo]) -> Bool[np.ndarray, "frames drones"]:
    """Where in the last chunk a drone is known well enough to explain foreground, as it is to claim some."""
    tracked = _joined(infos[-2:], infos[-1].status.shape[1]).status == Status.TRACKED
    frames, recent = len(tracked), np.array(tracked)
    for shift in range(1, tracker.MAX_CLAIMING_FRAMES + 1):
        recent[shift:] |= tracked[: frames - shift]
    return recent[frames - len(infos[-1].status) :]


def _with_room_for(coming: Arrivals, crew: _Crew, place: _Place) -> _Crew:
    """The crew with those that are born in it, absent yet."""
    born = coming.born_size_m
    if not len(born):
        return crew
    settings = place.settings
    if settings.drone_size_m is not None:
        born = np.broadcast_to(np.array(settings.drone_size_m), born.shape)
    size_m = jnp.concatenate([crew.params.size_m, jnp.asarray(born, jnp.float32)])
    params = replace(crew.params, size_m=size_m, motion=motion_params(settings, len(size_m)))
    added = _sizes(size_m[len(crew) :], place)
    return _Crew(tracker.enlarged(crew.state, params), params, sizes.enlarged(crew.sizes, added))


def _learned(
    crew: _Crew, chunk: np.ndarray, info: tracker.TrackerInfo, place: _Place
) -> tuple[SizeState, Looks]:
    """The sizes with a chunk in them, and what each of its frames shows by itself."""
    frames = len(info.status)
    well_seen = np.zeros((len(chunk), len(crew)), bool)
    well_seen[:frames] = info.status == Status.TRACKED
    position_m = np.zeros((*well_seen.shape, 3), np.float32)
    position_m[:frames] = np.nan_to_num(info.position_m)
    looks = sizes.look(chunk, position_m, well_seen, crew.params.size_m, place.cameras, place.program.score)
    learned = sizes.learn(crew.sizes, looks)
    return learned, jax.tree.map(lambda value: np.asarray(value)[:frames], looks)


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


def _named(coming: Arrivals, first_frame: int, num_known: int) -> list[Arrival]:
    """What to tell people of those that come."""
    arrivals = []
    for drone in np.flatnonzero(coming.begin_frame >= 0).tolist():
        arrival = Arrival(first_frame + int(coming.begin_frame[drone]), drone, again=drone < num_known)
        logger.info("frame %d: drone %d %s", arrival.frame, drone, "is back" if arrival.again else "is new")
        arrivals.append(arrival)
    return arrivals
