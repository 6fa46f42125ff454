"""The tracker: where the search and the score meet, frame after frame.

Each frame is searched from the positions that the motion model predicts (a warm start): particles about the prediction,
bounded by a drone's largest distance in one frame and by the room, in windows of the silhouettes that are cut there.
The position that is found corrects the motion model, with its covariance (a Kalman filter). A drone that is not found
coasts on its prediction with growing covariance, and after a while it is lost.

`step` does one frame, `track` is a scan of `step` over a chunk of frames. A live source calls `step`, so online and
offline are the same code, and the state crosses chunk borders. Tracks may start in any frame (`TrackStarts`): until
then their drones are absent, so the number of drones, on which the arrays' shapes depend, does not change.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt8

from psotrack._typing import Array, Coverage, Key, Positions
from psotrack.geometry import Camera, Extents, make_extents
from psotrack.motion import MotionParams, MotionState, kalman
from psotrack.silhouettes import Exposures
from psotrack.tracking.fitness import (
    Score,
    ScoreInputs,
    SoftIoU,
    drone_fitness,
    filled_share,
    joint_fitness,
)
from psotrack.tracking.patches import ExpectedDrones, cut
from psotrack.tracking.search import Search, SearchRegion
from psotrack.tracking.vertex import find_vertex
from psotrack.trajectories import Status

#: Least share of a drone's box that must be foreground for its camera to count as seeing the drone.
MIN_FILLED = 0.1
#: Distance from the prediction that windows contain beyond the ring, in standard deviations of the particles.
REACH_SIGMAS = 3.0
#: Largest number of frames since a drone was last found for which its expected position may occlude other drones.
MAX_OCCLUDING_FRAMES = 4
#: Initial dispersion of a track, and the number of frames over which the dispersion is averaged.
DISPERSION, DISPERSION_FRAMES = 1e-3, 25
#: Ratio of the measured positions' variance and the variance that follows from the cameras' disagreement. Errors that
#: all cameras have in common do not appear as disagreement: a wrong size, a clock, a rotor that no camera sees.
COMMON = 2.0
#: Two tracks are of one drone if their distance, divided along each axis by this share of their mean size, is below 1.
MIN_APART = 0.5
#: A lost drone is found again only with this many times the least fitness: any foreground may be near its last
#: position.
REGAIN = 3.0


@dataclass(frozen=True)
class Program:
    """Static values of the tracker: a change of any value causes a new compilation.

    Attributes:
        num_particles: number of particles of every swarm.
        joint: one search over the positions of all drones (the paper's) instead of one per drone.
        occlusion: whether foreground that another drone is expected to cover is left out of a drone's score.
        vertex: whether a drone's position is the vertex of a paraboloid through the scores, not the best position
            tried.
        score: the score of positions.
        windows: scales of a drone's box whose filling is reported with the learned sizes.
        reduction: image pixels per silhouette pixel, along each side.
    """

    num_particles: int = 100
    joint: bool = False
    occlusion: bool = True
    vertex: bool = True
    score: Score = field(default_factory=SoftIoU)
    windows: tuple[float, ...] = (0.4, 0.7, 1.0)
    reduction: int = 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerParams:
    """Numbers that may differ between calls without a new compilation.

    Attributes:
        num_iterations: iterations of the search per frame.
        size_m: (drones, 3), full lengths of each drone's extent, metres.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        dt_s: seconds between frames.
        max_speed_m_s: largest speed of a drone, m/s; bounds the search and the velocity.
        spread_m: standard deviation of the particles about the prediction, metres.
        search: the search in one frame.
        motion: the motion model.
        min_fitness: smallest fitness of a drone that counts as found.
        min_cameras: smallest number of cameras with foreground at a drone that counts as found.
        max_coasting_frames: largest number of frames for which a drone that is not found coasts before it is lost.
    """

    num_iterations: Int[Array, ""]
    size_m: Positions
    bounds_m: Float[Array, "2 3"]
    dt_s: Float[Array, ""]
    max_speed_m_s: Float[Array, ""]
    spread_m: Float[Array, ""]
    search: Search
    motion: MotionParams
    min_fitness: Float[Array, ""]
    min_cameras: Int[Array, ""]
    max_coasting_frames: Int[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerState:
    """What the next frame needs.

    Attributes:
        key: random key; consumed and replaced by every frame.
        motion: position, velocity and acceleration after the last frame.
        present: (drones,), whether the drone's track has started.
        missed: (drones,), frames since the drone was last found.
        dispersion: (drones,), disagreement of the cameras, averaged over time (phi of `vertex`).
    """

    key: Key
    motion: MotionState
    present: Bool[Array, "drones"]
    missed: Int[Array, "drones"]
    dispersion: Float[Array, "drones"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackStarts:
    """Tracks that start, or start again, within a chunk of frames.

    Attributes:
        frame: (drones,), the frame of the chunk in which a track starts, from 0; negative for all other drones.
        position_m, velocity_m_s: (drones, 3), position and velocity in that frame, metres and m/s.
    """

    frame: Int[Array, "drones"]
    position_m: Positions
    velocity_m_s: Positions


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerInfo:
    """Results per frame, for people and for the stages after the tracker; NaN for absent drones.

    A "measured" quantity comes from the frame alone, also where the motion model treats it as an outlier. Every other
    array depends on earlier frames too. `Tracks` lists the shapes and units.
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
        motion=_motion_before(position_m, velocity_m_s, params),
        present=jnp.ones(drones, bool),
        missed=jnp.zeros(drones, jnp.int32),
        dispersion=jnp.full(drones, DISPERSION, jnp.float32),
    )


def with_added_tracks(state: TrackerState, params: TrackerParams) -> TrackerState:
    """Extend the state to the number of drones in `params`; the added drones are last, and absent."""
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
    """No track starts."""
    zero = jnp.zeros((num_drones, 3))
    return TrackStarts(jnp.full(num_drones, -1, jnp.int32), zero, zero)


def step(
    state: TrackerState,
    coverage: Coverage,
    cameras: Camera,
    params: TrackerParams,
    program: Program,
    exposures: Exposures | None = None,
) -> tuple[TrackerState, TrackerInfo]:
    """One frame: predict, search, correct.

    Args:
        state: state after the previous frame.
        coverage: (cameras, height, width), silhouettes of the frame, 0..255, reduced.
        cameras: cameras with one leading axis, float32.
        params: parameters, which may change without a new compilation.
        program: static values, which are compiled in.
        exposures: when each camera's frame was exposed; None where all were exposed at the instant.
    """
    key_next, key_spread, key_search = jax.random.split(state.key, 3)
    region = _reachable(state, params)
    was_lost = state.missed > params.max_coasting_frames
    predicted = kalman.predict(state.motion, params.dt_s, params.motion)
    # The motion of a lost drone is not known: it stays where it was lost.
    predicted = kalman.select_drones(was_lost | ~state.present, state.motion, predicted)
    expected = jnp.clip(predicted.apparent_m, region.low, region.high)
    extents = _extents(cameras, expected, predicted.velocity_m_s, params, exposures)
    inputs = _score_inputs(state, coverage, extents, expected, params, program)
    first = _first_particles(key_spread, expected, state, params, program)
    best = _search(key_search, inputs, first, region, params, program)
    vertex = find_vertex(inputs, best, params.size_m, None if exposures is None else exposures.share)
    found = jnp.clip(vertex.position_m, region.low, region.high) if program.vertex else best
    fitness = drone_fitness(inputs, found)
    num_cameras = (filled_share(inputs, found) >= MIN_FILLED).sum(axis=-1)
    enough = params.min_fitness * jnp.where(was_lost, REGAIN, 1.0)
    # A lost drone is found again only near its last position. Farther away there may be another drone: which drone that
    # is takes more than one frame to tell (see `psotrack.initiation.reidentification`).
    near = jnp.linalg.norm(found - state.motion.apparent_m, axis=-1) < params.size_m.max(axis=-1)
    was_found = state.present & (fitness >= enough) & (num_cameras >= params.min_cameras)
    was_found &= near | ~was_lost
    dispersion = _averaged(state.dispersion, vertex.dispersion, was_found)
    covariance = COMMON * dispersion[:, None, None] * vertex.inverse_curvature_m2
    if exposures is not None:
        covariance += _displacement_covariance(predicted, vertex.camera_share, exposures)

    plausible = kalman.log_likelihood(predicted, found, covariance, params.motion)
    was_found &= ~_displaced(found, was_found, -plausible, params.size_m)
    corrected, _ = kalman.update(predicted, found, covariance, was_found, params.motion)
    restarted = kalman.init(found, jnp.zeros_like(found), covariance, params.motion)
    corrected = kalman.select_drones(was_found & was_lost, restarted, corrected)
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
    return TrackerState(key_next, after, state.present, missed, dispersion), _without_absent(
        info, state.present
    )


@partial(jax.jit, static_argnames="program")
def track(
    state: TrackerState,
    coverage: UInt8[Array, "frames cameras height width"],
    cameras: Camera,
    params: TrackerParams,
    program: Program,
    starts: TrackStarts,
    exposures: Exposures | None = None,
) -> tuple[TrackerState, TrackerInfo]:
    """`step` over a chunk of frames, one compiled scan.

    Args:
        state: state before the first frame.
        coverage: (frames, cameras, height, width) uint8; a chunk of silhouettes.
        cameras: cameras with one leading axis, float32.
        params: parameters, which may change without a new compilation.
        program: static values, which are compiled in.
        starts: tracks that start in this chunk (see `no_track_starts`).
        exposures: when each camera's frames were exposed, with an axis of frames; None where all cameras' frames were
            exposed together, which compiles to a program without displacements.

    Returns:
        The state after the last frame, and the info of every frame along a leading axis.
    """

    def one(carry: TrackerState, frame: Any) -> tuple[TrackerState, TrackerInfo]:
        number, silhouettes, exposed = frame
        started = with_started_tracks(carry, starts, number, params)
        return step(started, silhouettes, cameras, params, program, exposed)

    return jax.lax.scan(one, state, (jnp.arange(coverage.shape[0]), coverage, exposures))


def with_started_tracks(
    state: TrackerState, starts: TrackStarts, frame: Int[Array, ""], params: TrackerParams
) -> TrackerState:
    """The state before a frame, with the tracks that start in the frame."""
    begins = starts.frame == frame
    begun = _motion_before(starts.position_m, starts.velocity_m_s, params)
    return replace(
        state,
        motion=kalman.select_drones(begins, begun, state.motion),
        present=state.present | begins,
        missed=jnp.where(begins, 0, state.missed),
        dispersion=jnp.where(begins, DISPERSION, state.dispersion),
    )


def _motion_before(position_m: Positions, velocity_m_s: Positions, params: TrackerParams) -> MotionState:
    """Motion states one frame before the drones are at these positions: the first prediction is the position."""
    before = position_m - velocity_m_s * params.dt_s
    covariance = jnp.broadcast_to(jnp.square(params.spread_m) * jnp.eye(3), (position_m.shape[0], 3, 3))
    return kalman.init(before, velocity_m_s, covariance, params.motion)


def _without_absent(info: TrackerInfo, present: Bool[Array, "drones"]) -> TrackerInfo:
    """The info with NaN, and status lost, for absent drones."""

    def known(value: Array) -> Array:
        if not jnp.issubdtype(value.dtype, jnp.floating):
            return value
        return jnp.where(present.reshape(-1, *[1] * (value.ndim - 1)), value, jnp.nan)

    known_info = jax.tree.map(known, info)
    return replace(known_info, status=jnp.where(present, info.status, Status.LOST))


def _extents(
    cameras: Camera,
    expected: Positions,
    velocity_m_s: Positions,
    params: TrackerParams,
    exposures: Exposures | None,
) -> Extents:
    """The drones' extents as each camera's frame shows them: where the drones are when the frame is exposed."""
    if exposures is None:
        return make_extents(cameras, params.size_m)
    return exposures.moved(make_extents(exposures.seeing(cameras), params.size_m), expected, velocity_m_s)


def _displacement_covariance(
    predicted: MotionState, camera_share: Float[Array, "drones cameras"], exposures: Exposures
) -> Float[Array, "drones 3 3"]:
    """Covariance of a measured position that comes from the uncertain velocity between instant and exposures.

    The position is off by the error of the velocity times the cameras' mean offset.
    """
    offset_s = (camera_share * exposures.offset_s).sum(axis=-1)
    return jnp.square(offset_s)[:, None, None] * predicted.covariance[:, 3:6, 3:6]


def _score_inputs(
    state: TrackerState,
    coverage: Coverage,
    extents: Extents,
    expected: Positions,
    params: TrackerParams,
    program: Program,
) -> ScoreInputs:
    """What the score reads: windows about the expected positions of the drones."""
    patches = cut(
        coverage,
        extents,
        ExpectedDrones(
            position_m=expected,
            reach_m=REACH_SIGMAS * params.spread_m * _frames_since_found(state, params)[:, 0],
            occluding=_occluding(state, expected, params) if program.occlusion else None,
            floor_z_m=params.bounds_m[0, 2],
        ),
        reduction=program.reduction,
        ring=program.score.ring,
    )
    return ScoreInputs(extents, patches, program.score)


def _reachable(state: TrackerState, params: TrackerParams) -> SearchRegion:
    """Bounds of the search for each drone: what it can have reached since it was last found, within the room."""
    reach = params.max_speed_m_s * params.dt_s * _frames_since_found(state, params)
    low, high = params.bounds_m
    position = state.motion.apparent_m
    return SearchRegion(
        low=jnp.clip(position - reach, low, high),
        high=jnp.clip(position + reach, low, high),
        max_step=jnp.broadcast_to(params.max_speed_m_s * params.dt_s, (3,)),
    )


def _frames_since_found(state: TrackerState, params: TrackerParams) -> Float[Array, "drones 1"]:
    """Frames since each drone was last found, from 1.

    The number grows until the drone is lost and then stays: a region that grows further would be searched with too few
    particles.
    """
    missed = jnp.minimum(state.missed, params.max_coasting_frames)
    return 1.0 + missed[:, None].astype(jnp.float32)


def _first_particles(
    key: Key, expected: Positions, state: TrackerState, params: TrackerParams, program: Program
) -> Float[Array, "particles drones 3"]:
    """First positions of the particles: about the expected position, more widely the longer a drone was not found."""
    spread = params.spread_m * _frames_since_found(state, params)
    shape = (program.num_particles, *expected.shape)
    first = expected + spread * jax.random.normal(key, shape)
    # Two particles are the expected and the last position: a drone that flies on, or hovers, is found at once.
    return jnp.asarray(first).at[0].set(expected).at[1].set(state.motion.apparent_m)


def _search(
    key: Key,
    inputs: ScoreInputs,
    first: Float[Array, "particles drones 3"],
    region: SearchRegion,
    params: TrackerParams,
    program: Program,
) -> Positions:
    """The positions of largest fitness that the search finds."""
    particles, drones, _ = first.shape
    groups = (1, 3 * drones) if program.joint else (drones, 3)

    def objective(position: Array) -> Array:
        position = position.reshape(particles, drones, 3)
        return joint_fitness(inputs, position)[:, None] if program.joint else drone_fitness(inputs, position)

    of_groups = SearchRegion(
        low=region.low.reshape(groups),
        high=region.high.reshape(groups),
        max_step=jnp.broadcast_to(region.max_step[0], groups[1:]),
    )
    best = params.search(key, objective, first.reshape(particles, *groups), of_groups, params.num_iterations)
    return best.reshape(drones, 3)


def _occluding(state: TrackerState, expected: Positions, params: TrackerParams) -> Bool[Array, "drones"]:
    """Which drones' expected positions are certain enough to occlude other drones."""
    known = state.present & (state.missed <= MAX_OCCLUDING_FRAMES)
    return known & ~_displaced(expected, known, state.missed, params.size_m)


def _displaced(
    position_m: Positions,
    there: Bool[Array, "drones"],
    doubt: Array,
    size_m: Positions,
) -> Bool[Array, "drones"]:
    """Which drones cannot be at their positions, because a drone of less doubt is there: one drone has one track.

    Args:
        position_m: (drones, 3), positions, metres.
        there: (drones,), which drones count.
        doubt: (drones,); of two drones of equal doubt the one with the higher number is displaced.
        size_m: (drones, 3), full lengths, metres.
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
    """Dispersion, averaged over frames, because the few cameras of one frame determine it only roughly."""
    believed = was_found & jnp.isfinite(latest)
    return dispersion + jnp.where(believed, latest - dispersion, 0.0) / DISPERSION_FRAMES
