"""The tracker: where swarm and fitness meet, frame after frame.

Each frame is searched from where the motion model expects the drones (a warm start): particles around the
prediction, bounded by what a drone can reach and by the room, in windows of the silhouettes that are cut there. A few
gradient steps finish what the swarm began. What is found, with its covariance, corrects the motion model (a Kalman
filter); where nothing is found the drone coasts on its prediction, less and less certain, and after a while is lost.

`step` does one frame, `track` is a scan of it over a chunk of frames. A live source calls `step`, so online and
offline are the same code, and the state crosses chunk borders. Tracks may start in any frame (`TrackStarts`): until
then their drones are absent, and the number of drones, which is a shape, need not change while they start.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt8

from psotrack._typing import Array, Coverage, Key, Positions
from psotrack.geometry import Camera, make_extents
from psotrack.motion import MotionParams, MotionState, kalman
from psotrack.tracking import swarm
from psotrack.tracking.fitness import ScoreInputs, ScoreSettings, drone_fitness, filled, joint_fitness
from psotrack.tracking.patches import cut
from psotrack.tracking.refinement import climb
from psotrack.tracking.vertex import find_vertex
from psotrack.trajectories import Status

#: Share of a drone's box that must be foreground for its camera to count as seeing it.
MIN_FILLED = 0.1
#: Particles start about the prediction; windows reach that many of their standard deviations beyond the ring.
REACH_SIGMAS = 3.0
#: A drone that was not found for more frames is not expected anywhere well enough to claim foreground.
MAX_CLAIMING_FRAMES = 4
#: Dispersion before a frame has told any, and the number of frames that it is averaged over.
DISPERSION, DISPERSION_FRAMES = 1e-3, 25
#: Cameras do not disagree about what they have in common: a size that does not fit, a clock, a rotor that none sees.
#: The variance of the measured positions is that many times what the cameras' disagreement says.
COMMON = 2.0
#: Ellipsoids whose middles are nearer than so much of their size, along every axis, are of one drone.
MIN_APART = 0.5
#: To be found again a lost drone needs that many times the fitness: about its last place there may be anything.
REGAIN = 3.0


@dataclass(frozen=True)
class Program:
    """What is compiled in: a change of any of these compiles anew.

    Attributes:
        num_particles: of every swarm.
        joint: one swarm over all drones (the paper's) instead of one per drone.
        claims: whether foreground that another drone is expected to cover says nothing about a drone.
        refined: whether there are gradient steps after the swarm at all.
        vertex: whether a drone is where the score's paraboloid has its vertex, not just its best position tried.
        score: how positions are scored.
    """

    num_particles: int = 100
    joint: bool = False
    claims: bool = True
    refined: bool = False
    vertex: bool = True
    score: ScoreSettings = field(default_factory=ScoreSettings)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerParams:
    """Knobs; all may differ between calls without a new compilation.

    Attributes:
        num_iterations: of the swarm, per frame.
        num_refinements: gradient steps after it.
        size_m: (drones, 3), full lengths of each drone's extent.
        bounds_m: (2, 3), lowest and highest corner of the room.
        dt_s: seconds between frames.
        max_speed_m_s: of a drone; bounds the search and the velocity.
        spread_m: standard deviation of the particles about the prediction.
        inertia, cognitive, social: of the swarm.
        motion: how drones move.
        min_fitness: below it a drone was not found.
        min_cameras: fewer than these, and a drone was not found.
        max_coasting_frames: after so many frames without being found a drone is lost.
    """

    num_iterations: Int[Array, ""]
    num_refinements: Int[Array, ""]
    size_m: Positions
    bounds_m: Float[Array, "2 3"]
    dt_s: Float[Array, ""]
    max_speed_m_s: Float[Array, ""]
    spread_m: Float[Array, ""]
    inertia: Float[Array, ""]
    cognitive: Float[Array, ""]
    social: Float[Array, ""]
    motion: MotionParams
    min_fitness: Float[Array, ""]
    min_cameras: Int[Array, ""]
    max_coasting_frames: Int[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerState:
    """What the next frame needs.

    Attributes:
        key: consumed and replaced by every frame.
        motion: position, velocity and acceleration after the last frame.
        present: (drones,), whether the drone has arrived yet.
        missed: (drones,), frames since the drone was last found.
        dispersion: (drones,), how much the cameras disagree, averaged over time (see `uncertainty`).
    """

    key: Key
    motion: MotionState
    present: Bool[Array, "drones"]
    missed: Int[Array, "drones"]
    dispersion: Float[Array, "drones"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackStarts:
    """Drones that begin, or begin anew, within a chunk.

    Attributes:
        frame: (drones,), the frame of the chunk, from 0; negative for all others.
        position_m, velocity_m_s: (drones, 3), in that frame.
    """

    frame: Int[Array, "drones"]
    position_m: Positions
    velocity_m_s: Positions


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerInfo:
    """What people look at, per frame; status holds values of `Status`. Of absent drones nothing is known: NaN.

    Measured is what the frame says by itself, whether or not it was believed; all else has the past in it.
    """

    position_m: Float[Array, "*frames drones 3"]
    velocity_m_s: Float[Array, "*frames drones 3"]
    covariance_m2: Float[Array, "*frames drones 3 3"]
    measured_m: Float[Array, "*frames drones 3"]
    measured_covariance_m2: Float[Array, "*frames drones 3 3"]
    fitness: Float[Array, "*frames drones"]
    num_cameras: Int[Array, "*frames drones"]
    status: Int[Array, "*frames drones"]


def init(key: Key, position_m: Positions, velocity_m_s: Positions, params: TrackerParams) -> TrackerState:
    """State before the first frame, for drones that will be at `position_m` in it. The key is consumed."""
    drones = position_m.shape[0]
    return TrackerState(
        key=key,
        motion=_begun(position_m, velocity_m_s, params),
        present=jnp.ones(drones, bool),
        missed=jnp.zeros(drones, jnp.int32),
        dispersion=jnp.full(drones, DISPERSION, jnp.float32),
    )


def with_added_tracks(state: TrackerState, params: TrackerParams) -> TrackerState:
    """The state with as many drones as `params` has sizes for; those added at the end are absent."""
    more = params.size_m.shape[0] - state.missed.shape[0]
    middle = jnp.broadcast_to(params.bounds_m.mean(axis=0), (more, 3))
    added = init(state.key, middle, jnp.zeros((more, 3)), params)

    def both(first: Array, last: Array) -> Array:
        return jnp.concatenate([first, last])

    return TrackerState(
        key=state.key,
        motion=jax.tree.map(both, state.motion, added.motion),
        present=both(state.present, jnp.zeros(more, bool)),
        missed=both(state.missed, added.missed),
        dispersion=both(state.dispersion, added.dispersion),
    )


def no_track_starts(num_drones: int) -> TrackStarts:
    """Nobody arrives."""
    zero = jnp.zeros((num_drones, 3))
    return TrackStarts(jnp.full(num_drones, -1, jnp.int32), zero, zero)


def step(
    state: TrackerState, coverage: Coverage, cameras: Camera, params: TrackerParams, program: Program
) -> tuple[TrackerState, TrackerInfo]:
    """One frame: predict, search, correct.

    Args:
        coverage: (cameras, height, width), silhouettes of the frame, 0..255, reduced.
    """
    key_next, key_spread, key_swarm = jax.random.split(state.key, 3)
    low, high = _reachable(state, params)
    was_lost = state.missed > params.max_coasting_frames
    predicted = kalman.predict(state.motion, params.dt_s, params.motion)
    # Nobody knows where to a lost drone goes, nor how uncertain that is.
    predicted = kalman.select_drones(was_lost | ~state.present, state.motion, predicted)
    expected = jnp.clip(predicted.apparent_m, low, high)
    view = _view(state, coverage, cameras, expected, params, program)
    found = _search(key_spread, key_swarm, view, expected, state, params, program, (low, high))
    if program.refined:
        found = climb(
            lambda position: drone_fitness(view, position), found, params.num_refinements, low, high
        )
    sharp = find_vertex(view, found, params.size_m)
    found = jnp.clip(sharp.position_m, low, high) if program.vertex else found
    fitness, num_cameras = _evidence(view, found, params)
    enough = params.min_fitness * jnp.where(was_lost, REGAIN, 1.0)
    # Farther off there may be another drone: who it is takes more than a frame to tell (see `lifecycle`).
    near = jnp.linalg.norm(found - state.motion.apparent_m, axis=-1) < params.size_m.max(axis=-1)
    was_found = state.present & (fitness >= enough) & (num_cameras >= params.min_cameras)
    was_found &= near | ~was_lost
    dispersion = _averaged(state.dispersion, sharp.dispersion, was_found)
    covariance = COMMON * dispersion[:, None, None] * sharp.inverse_curvature_m2

    plausible = kalman.log_likelihood(predicted, found, covariance, params.motion)
    was_found &= ~_yields(found, was_found, -plausible, params.size_m)
    corrected, _ = kalman.update(predicted, found, covariance, was_found, params.motion)
    anew = kalman.init(found, jnp.zeros_like(found), covariance, params.motion)
    corrected = kalman.select_drones(was_found & was_lost, anew, corrected)
    missed = jnp.where(was_found, 0, state.missed + 1)
    lost = missed > params.max_coasting_frames
    after = kalman.limit_motion(
        corrected,
        missed > 0,
        lost,
        dt_s=params.dt_s,
        bounds_m=params.bounds_m,
        max_speed_m_s=params.max_speed_m_s,
    )
    status = jnp.where(was_found, Status.TRACKED, jnp.where(lost, Status.LOST, Status.COASTING))
    info = TrackerInfo(
        position_m=after.position_m,
        velocity_m_s=after.velocity_m_s,
        covariance_m2=after.position_covariance_m2,
        measured_m=found,
        measured_covariance_m2=covariance,
        fitness=jnp.nan_to_num(fitness),
        num_cameras=num_cameras,
        status=status.astype(jnp.int32),
    )
    return TrackerState(key_next, after, state.present, missed, dispersion), _of_those_present(
        info, state.present
    )


def track(
    state: TrackerState,
    coverage: UInt8[Array, "frames cameras height width"],
    cameras: Camera,
    params: TrackerParams,
    program: Program,
    arrivals: TrackStarts | None = None,
) -> tuple[TrackerState, TrackerInfo]:
    """`step` over a chunk of frames, one compiled scan.

    Args:
        coverage: (frames, cameras, height, width) uint8; a chunk of silhouettes.
        arrivals: drones that begin in this chunk; None is nobody, and compiles nothing else.

    Returns:
        The state after the last frame, and the info of every frame along a leading axis.
    """
    arrivals = no_track_starts(state.missed.shape[0]) if arrivals is None else arrivals
    return _track(state, coverage, cameras, params, program, arrivals)


@partial(jax.jit, static_argnames="program")
def _track(
    state: TrackerState,
    coverage: UInt8[Array, "frames cameras height width"],
    cameras: Camera,
    params: TrackerParams,
    program: Program,
    arrivals: TrackStarts,
) -> tuple[TrackerState, TrackerInfo]:
    def one(carry: TrackerState, frame: Any) -> tuple[TrackerState, TrackerInfo]:
        number, silhouettes = frame
        return step(
            with_started_tracks(carry, arrivals, number, params), silhouettes, cameras, params, program
        )

    return jax.lax.scan(one, state, (jnp.arange(coverage.shape[0]), coverage))


def with_started_tracks(
    state: TrackerState, arrivals: TrackStarts, frame: Int[Array, ""], params: TrackerParams
) -> TrackerState:
    """The state before a frame, with the drones that arrive in it."""
    begins = arrivals.frame == frame
    begun = _begun(arrivals.position_m, arrivals.velocity_m_s, params)
    return replace(
        state,
        motion=kalman.select_drones(begins, begun, state.motion),
        present=state.present | begins,
        missed=jnp.where(begins, 0, state.missed),
        dispersion=jnp.where(begins, DISPERSION, state.dispersion),
    )


def _begun(position_m: Positions, velocity_m_s: Positions, params: TrackerParams) -> MotionState:
    """Drones that will be at these positions in the next frame."""
    # One step back, so that the first prediction is the given position.
    before = position_m - velocity_m_s * params.dt_s
    covariance = jnp.broadcast_to(jnp.square(params.spread_m) * jnp.eye(3), (position_m.shape[0], 3, 3))
    return kalman.init(before, velocity_m_s, covariance, params.motion)


def _of_those_present(info: TrackerInfo, present: Bool[Array, "drones"]) -> TrackerInfo:
    """The info with NaN for what nobody knows of absent drones."""

    def known(value: Array) -> Array:
        if not jnp.issubdtype(value.dtype, jnp.floating):
            return value
        return jnp.where(present.reshape(-1, *[1] * (value.ndim - 1)), value, jnp.nan)

    known_info = jax.tree.map(known, info)
    return replace(known_info, status=jnp.where(present, info.status, Status.LOST))


def _view(
    state: TrackerState,
    coverage: Coverage,
    cameras: Camera,
    expected: Positions,
    params: TrackerParams,
    program: Program,
) -> ScoreInputs:
    """What the score reads: windows about where drones are expected."""
    seen = make_extents(cameras, params.size_m)
    patches = cut(
        coverage,
        seen,
        expected,
        reach_m=REACH_SIGMAS * params.spread_m * _frames_since_found(state, params)[:, 0],
        claiming=_claiming(state, expected, params) if program.claims else None,
        floor_z_m=params.bounds_m[0, 2],
        reduction=program.score.reduction,
        ring=program.score.ring,
    )
    return ScoreInputs(seen, patches, program.score)


def _reachable(state: TrackerState, params: TrackerParams) -> tuple[Positions, Positions]:
    """Bounds of the search for each drone: where it can have got to since it was last found, within the room."""
    reach = params.max_speed_m_s * params.dt_s * _frames_since_found(state, params)
    low, high = params.bounds_m
    position = state.motion.apparent_m
    return jnp.clip(position - reach, low, high), jnp.clip(position + reach, low, high)


def _frames_since_found(state: TrackerState, params: TrackerParams) -> Float[Array, "drones 1"]:
    """From 1; no more than until a drone is lost, or it would be sought ever farther away with as few particles."""
    missed = jnp.minimum(state.missed, params.max_coasting_frames)
    return 1.0 + missed[:, None].astype(jnp.float32)


def _search(
    key_spread: Key,
    key_swarm: Key,
    view: ScoreInputs,
    predicted: Positions,
    state: TrackerState,
    params: TrackerParams,
    program: Program,
    bounds: tuple[Positions, Positions],
) -> Positions:
    """The best positions that the swarm finds about the prediction."""
    particles, drones = program.num_particles, predicted.shape[0]
    spread = params.spread_m * _frames_since_found(state, params)
    start = predicted + spread * jax.random.normal(key_spread, (particles, drones, 3))
    # The prediction and the last position are particles too: a drone that flies on, or stands, is found at once.
    start = jnp.asarray(start).at[0].set(predicted).at[1].set(state.motion.apparent_m)

    groups = (1, 3 * drones) if program.joint else (drones, 3)

    def objective(position: Array) -> Array:
        position = position.reshape(particles, drones, 3)
        return joint_fitness(view, position)[:, None] if program.joint else drone_fitness(view, position)

    swarm_params = swarm.SwarmParams(
        inertia=params.inertia,
        cognitive=params.cognitive,
        social=params.social,
        max_step=jnp.broadcast_to(params.max_speed_m_s * params.dt_s, groups[1:]),
        low=bounds[0].reshape(groups),
        high=bounds[1].reshape(groups),
    )
    final = swarm.run(
        key_swarm, objective, start.reshape(particles, *groups), swarm_params, params.num_iterations
    )
    return final.gbest_position.reshape(drones, 3)


def _evidence(
    view: ScoreInputs, position_m: Positions, params: TrackerParams
) -> tuple[Float[Array, "drones"], Int[Array, "drones"]]:
    """Fitness of each drone where it was found, and the number of cameras that have foreground there."""
    num_cameras = (filled(view, position_m) >= MIN_FILLED).sum(axis=-1)
    return drone_fitness(view, position_m), num_cameras


def _claiming(state: TrackerState, expected: Positions, params: TrackerParams) -> Bool[Array, "drones"]:
    """Which drones are expected somewhere well enough to claim foreground there."""
    known = state.present & (state.missed <= MAX_CLAIMING_FRAMES)
    return known & ~_yields(expected, known, state.missed, params.size_m)


def _yields(
    position_m: Positions,
    there: Bool[Array, "drones"],
    doubt: Array,
    size_m: Positions,
) -> Bool[Array, "drones"]:
    """Which drones cannot be where they seem to be, because a drone of less doubt is there: no drone is ever two.

    Args:
        there: (drones,), which drones count.
        doubt: (drones,); where it is equal the number of the drone decides.
    """
    apart = (position_m[:, None] - position_m) / (MIN_APART * (size_m[:, None] + size_m) / 2)
    conflict = (jnp.square(apart).sum(axis=-1) < 1) & there[:, None] & there
    number = jnp.arange(len(there))
    equal = (doubt[:, None] == doubt) & (number[:, None] > number)
    more = (doubt[:, None] > doubt) | equal
    return (conflict & more).any(axis=1)


def _averaged(
    dispersion: Float[Array, "drones"], latest: Float[Array, "drones"], was_found: Bool[Array, "drones"]
) -> Float[Array, "drones"]:
    """The dispersion with this frame's in it: eight cameras of one frame say it roughly."""
    believed = was_found & jnp.isfinite(latest)
    return dispersion + jnp.where(believed, latest - dispersion, 0.0) / DISPERSION_FRAMES
