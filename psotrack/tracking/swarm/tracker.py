"""One frame, and a block of frames: where the search and the score meet.

Each frame is searched from the positions that the motion model predicts (a warm start): particles about the prediction,
bounded by a drone's largest distance in one frame and by the room, in windows of the silhouettes that are cut there.
The position that is found corrects the motion model, with its covariance (a Kalman filter). A drone that is not found
coasts on its prediction with growing covariance, and after a while it is lost.

`step` does one frame, `track` is a scan of `step` over a block of frames: 25 of a recording, 1 of live cameras. Drones
are in slots, of which some are empty: the arrays' shapes do not depend on the number of drones. A track may start in
any frame of a block (`TrackStarts`), which fills a slot.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from psotrack.foreground.silhouettes import Exposures
from psotrack.geometry import Camera, make_extents, project_boxes
from psotrack.support.array_types import Array, Key, Positions
from psotrack.tracking.motion import MotionParams, MotionState, kalman
from psotrack.tracking.swarm.fitness import (
    DroneFitness,
    Score,
    ScoreInputs,
    SoftIoU,
    drone_fitness,
    filled_share,
    joint_fitness,
)
from psotrack.tracking.swarm.moments import measure
from psotrack.tracking.swarm.patches import ExpectedDrones, Pyramid, cut
from psotrack.tracking.swarm.search import Search, SearchRegion
from psotrack.tracking.swarm.vertex import find_vertex
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
#: Largest ratio of a learned length and the initial length, in either direction.
SIZE_RANGE = 2.0
#: First step of a learned length, as a share of the length, and number of frames after which the step is half as large.
SIZE_STEP, SIZE_FRAMES = 0.15, 5
#: Size of the drone that an empty slot stands for, metres.
_NO_SIZE_M = 0.3


@dataclass(frozen=True)
class Program:
    """Static values of the tracker: a change of any value causes a new compilation.

    Attributes:
        num_particles: number of particles of every swarm.
        num_iterations: iterations of the search per frame; None takes `TrackerParams.num_iterations`. An accelerator
            would be asked after each iteration whether another one follows, if the number were not static.
        joint: one search over the positions of all drones (the paper's) instead of one per drone.
        occlusion: whether foreground that another drone is expected to cover is left out of a drone's score.
        vertex: whether a drone's position is the vertex of a paraboloid through the scores, not the best position
            tried.
        score: the score of positions.
        reduction: image pixels per silhouette pixel, along each side.
    """

    num_particles: int = 100
    num_iterations: int | None = None
    joint: bool = False
    occlusion: bool = True
    vertex: bool = True
    score: Score = field(default_factory=SoftIoU)
    reduction: int = 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerParams:
    """Numbers that may differ between calls without a new compilation.

    Attributes:
        num_iterations: iterations of the search per frame.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        dt_s: seconds between instants.
        max_speed_m_s: largest speed of a drone, m/s; bounds the search and the velocity.
        spread_m: standard deviation of the particles about the prediction, metres.
        search: the search in one frame.
        motion: the motion model.
        min_fitness: smallest fitness of a drone that counts as found.
        min_cameras: smallest number of cameras with foreground at a drone that counts as found.
        max_coasting_frames: largest number of instants for which a drone that is not found coasts before it is lost.
        learns_sizes: whether the sizes of the drones are learned.
    """

    num_iterations: Int[Array, ""]
    bounds_m: Float[Array, "2 3"]
    dt_s: Float[Array, ""]
    max_speed_m_s: Float[Array, ""]
    spread_m: Float[Array, ""]
    search: Search
    motion: MotionParams
    min_fitness: Float[Array, ""]
    min_cameras: Int[Array, ""]
    max_coasting_frames: Int[Array, ""]
    learns_sizes: Bool[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Slots:
    """The drones of a run, in slots: what the next frame needs.

    Attributes:
        key: random key; consumed and replaced by every frame.
        motion: position, velocity and acceleration after the last frame.
        present: (drones,), whether the slot holds a drone whose track has started.
        missed: (drones,), instants since the drone was last found.
        dispersion: (drones,), disagreement of the cameras, averaged over time (phi of `vertex`).
        size_m: (drones, 3), full lengths of each drone's extent, metres, as learned so far.
        first_size_m: (drones, 3), the lengths with which the track started.
        size_frames: (drones, 3), number of frames from which each length was learned.
    """

    key: Key
    motion: MotionState
    present: Bool[Array, "drones"]
    missed: Int[Array, "drones"]
    dispersion: Float[Array, "drones"]
    size_m: Positions
    first_size_m: Positions
    size_frames: Int[Array, "drones 3"]

    def __len__(self) -> int:
        return self.missed.shape[0]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackStarts:
    """Tracks that start, or start again, within a block of frames.

    Attributes:
        frame: (drones,), the frame of the block in which a track starts, from 0; negative for all other slots.
        position_m, velocity_m_s: (drones, 3), position and velocity in that frame, metres and m/s.
        size_m: (drones, 3), full lengths; NaN for a drone that keeps the lengths that were learned.
    """

    frame: Int[Array, "drones"]
    position_m: Positions
    velocity_m_s: Positions
    size_m: Positions


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """The silhouettes of some instants.

    Attributes:
        pyramid: the silhouettes, with an axis of frames.
        elapsed: (frames,), instants since the frame before: 1, or more where frames were left out.
        exposures: when the frames were exposed; None where all cameras' frames were exposed together.
    """

    pyramid: Pyramid
    elapsed: Int[Array, "*frames"]
    exposures: Exposures | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rows:
    """Results per frame, for people and for the stages after the tracker; NaN for empty slots.

    A "measured" quantity comes from the frame alone, also where the motion model treats it as an outlier. Every other
    array depends on earlier frames too. `Tracks` lists the shapes and units.

    Attributes:
        box_px: (..., drones, cameras, 4), middle x and y and half width and half height of the drone's box in the
            camera's frame, pixels, half-open convention; NaN where the camera does not show the drone.
        middle_px: (..., drones, cameras, 2), middle of the drone's foreground, pixels; pixel centres are at whole
            numbers. NaN where the camera does not show the drone whole and clear of other drones.
    """

    position_m: Float[Array, "*frames drones 3"]
    velocity_m_s: Float[Array, "*frames drones 3"]
    covariance_m2: Float[Array, "*frames drones 3 3"]
    measured_m: Float[Array, "*frames drones 3"]
    measured_covariance_m2: Float[Array, "*frames drones 3 3"]
    fitness: Float[Array, "*frames drones"]
    num_cameras: Int[Array, "*frames drones"]
    status: Int[Array, "*frames drones"]
    box_px: Float[Array, "*frames drones cameras 4"]
    middle_px: Float[Array, "*frames drones cameras 2"]


def empty_slots(key: Key, count: int, params: TrackerParams) -> Slots:
    """Slots without drones. The key is consumed."""
    middle = jnp.broadcast_to(params.bounds_m.mean(axis=0), (count, 3))
    size_m = jnp.full((count, 3), _NO_SIZE_M, jnp.float32)
    return Slots(
        key=key,
        motion=_motion_before(middle, jnp.zeros((count, 3)), params.dt_s, params),
        present=jnp.zeros(count, bool),
        missed=jnp.zeros(count, jnp.int32),
        dispersion=jnp.full(count, DISPERSION, jnp.float32),
        size_m=size_m,
        first_size_m=size_m,
        size_frames=jnp.zeros((count, 3), jnp.int32),
    )


def next_keys(key: Key) -> Key:
    """(3,), keys of the next frame, of the particles and of the search. The key is consumed."""
    return jax.random.split(key, 3)


def step(
    slots: Slots, frame: Frames, cameras: Camera, params: TrackerParams, program: Program
) -> tuple[Slots, Rows]:
    """One frame: predict, search, correct.

    Args:
        slots: the drones after the previous frame.
        frame: silhouettes of the frame.
        cameras: cameras with one leading axis, float32.
        params: parameters, which may change without a new compilation.
        program: static values, which are compiled in.
    """
    key_next, key_spread, key_search = next_keys(slots.key)
    elapsed_s, exposures = frame.elapsed.astype(jnp.float32) * params.dt_s, frame.exposures
    region = _reachable(slots, elapsed_s, params)
    was_lost = slots.missed > params.max_coasting_frames
    predicted = kalman.predict(slots.motion, elapsed_s, params.motion)
    # The motion of a lost drone is not known: it stays where it was lost.
    predicted = kalman.select_drones(was_lost | ~slots.present, slots.motion, predicted)
    expected = jnp.clip(predicted.apparent_m, region.low, region.high)
    # As each camera's frame shows the drones: where they are when the frame is exposed.
    extents = make_extents(cameras if exposures is None else exposures.seeing(cameras), slots.size_m)
    if exposures is not None:
        extents = exposures.moved(extents, expected, predicted.velocity_m_s)
    known = slots.present & (slots.missed <= MAX_OCCLUDING_FRAMES)
    patches, windows = cut(
        frame.pyramid,
        extents,
        ExpectedDrones(
            position_m=expected,
            reach_m=REACH_SIGMAS * params.spread_m * _frames_since_found(slots, params)[:, 0],
            occluding=known & ~_displaced(expected, known, slots.missed, slots.size_m)
            if program.occlusion
            else None,
        ),
        reduction=program.reduction,
        ring=program.score.ring,
    )
    inputs = ScoreInputs(extents, patches, program.score)
    first = _first_particles(key_spread, expected, slots, params, program)
    # Whole pixels are enough for the search, because a paraboloid about the first vertex gives the position.
    of_search = replace(inputs, patches=replace(patches, whole_cells=program.vertex))
    best = _search(key_search, of_search, first, region, slots, params, program)
    if program.vertex:
        best = find_vertex(inputs, best, slots.size_m).position_m
    vertex = find_vertex(inputs, best, slots.size_m, None if exposures is None else exposures.share)
    found = jnp.clip(vertex.position_m, region.low, region.high) if program.vertex else best
    fitness = drone_fitness(inputs, found)
    num_cameras = (filled_share(inputs, found) >= MIN_FILLED).sum(axis=-1)
    enough = params.min_fitness * jnp.where(was_lost, REGAIN, 1.0)
    # A lost drone is found again only near its last position. Farther away there may be another drone: which drone that
    # is takes more than one frame to tell (see `psotrack.tracking.births.reidentification`).
    near = jnp.linalg.norm(found - slots.motion.apparent_m, axis=-1) < slots.size_m.max(axis=-1)
    was_found = slots.present & (fitness >= enough) & (num_cameras >= params.min_cameras)
    was_found &= near | ~was_lost
    # Averaged over frames, because the few cameras of one frame determine it only roughly.
    believed = was_found & jnp.isfinite(vertex.dispersion)
    change = jnp.where(believed, vertex.dispersion - slots.dispersion, 0.0)
    dispersion = slots.dispersion + change / DISPERSION_FRAMES
    covariance = COMMON * dispersion[:, None, None] * vertex.inverse_curvature_m2
    if exposures is not None:
        # The error of the velocity times the cameras' mean offset between instant and exposures.
        offset_s = (vertex.camera_share * exposures.offset_s).sum(axis=-1)
        covariance += jnp.square(offset_s)[:, None, None] * predicted.covariance[:, 3:6, 3:6]

    plausible = kalman.log_likelihood(predicted, found, covariance, params.motion)
    was_found &= ~_displaced(found, was_found, -plausible, slots.size_m)
    corrected, _ = kalman.update(predicted, found, covariance, was_found, params.motion)
    restarted = kalman.init(found, jnp.zeros_like(found), covariance, params.motion)
    corrected = kalman.select_drones(was_found & was_lost, restarted, corrected)
    missed = jnp.where(was_found, 0, slots.missed + frame.elapsed)
    lost = missed > params.max_coasting_frames
    after = kalman.limit_motion(
        corrected,
        missed > 0,
        lost,
        dt_s=elapsed_s,
        bounds_m=params.bounds_m,
        max_speed_m_s=params.max_speed_m_s,
    )
    boxes = project_boxes(extents, jnp.where(was_found[:, None], found, after.apparent_m))
    known = slots.present & (missed <= MAX_OCCLUDING_FRAMES)
    seen = measure(windows, boxes, extents, ring=program.score.ring, least_filled=MIN_FILLED, known=known)
    # The blob of a low drone may hold the drone's shadow.
    is_low = found[:, 2] - params.bounds_m[0, 2] < slots.size_m[:, 0]
    measured_size_m = jnp.where((was_found & ~is_low)[:, None], slots.size_m * seen.size_ratio, jnp.nan)
    status = jnp.where(was_found, Status.TRACKED, jnp.where(lost, Status.LOST, Status.COASTING))
    rows = Rows(
        position_m=after.position_m,
        velocity_m_s=after.velocity_m_s,
        covariance_m2=after.position_covariance_m2,
        measured_m=found,
        measured_covariance_m2=covariance,
        fitness=jnp.nan_to_num(fitness),
        num_cameras=num_cameras,
        status=status.astype(jnp.int32),
        box_px=seen.box_px,
        middle_px=jnp.where(was_found[:, None, None], seen.middle_px, jnp.nan),
    )
    slots = replace(
        _with_learned_sizes(slots, measured_size_m, params),
        key=key_next,
        motion=after,
        missed=missed,
        dispersion=dispersion,
    )
    return slots, _without_absent(rows, slots.present)


def track(
    slots: Slots,
    frames: Frames,
    starts: TrackStarts,
    cameras: Camera,
    params: TrackerParams,
    program: Program,
) -> tuple[Slots, Rows]:
    """`step` over a block of frames, one scan; returns the slots after it, and the rows along a leading axis."""

    def one(carry: Slots, numbered: Any) -> tuple[Slots, Rows]:
        number, frame = numbered
        elapsed_s = frame.elapsed.astype(jnp.float32) * params.dt_s
        carry = _with_started_tracks(carry, starts, number, elapsed_s, params)
        return step(carry, frame, cameras, params, program)

    return jax.lax.scan(one, slots, (jnp.arange(frames.elapsed.shape[0]), frames))


def _with_started_tracks(
    slots: Slots,
    starts: TrackStarts,
    frame: Int[Array, ""],
    elapsed_s: Float[Array, ""],
    params: TrackerParams,
) -> Slots:
    """The slots before a frame, with the tracks that start in the frame."""
    begins = starts.frame == frame
    begun = _motion_before(starts.position_m, starts.velocity_m_s, elapsed_s, params)
    is_new = begins[:, None] & jnp.isfinite(starts.size_m)
    return replace(
        slots,
        motion=kalman.select_drones(begins, begun, slots.motion),
        present=slots.present | begins,
        missed=jnp.where(begins, 0, slots.missed),
        dispersion=jnp.where(begins, DISPERSION, slots.dispersion),
        size_m=jnp.where(is_new, starts.size_m, slots.size_m),
        first_size_m=jnp.where(is_new, starts.size_m, slots.first_size_m),
        size_frames=jnp.where(is_new, 0, slots.size_frames),
    )


def _motion_before(
    position_m: Positions, velocity_m_s: Positions, elapsed_s: Float[Array, ""], params: TrackerParams
) -> MotionState:
    """Motion states some time before the drones are at these positions: the first prediction is the position."""
    before = position_m - velocity_m_s * elapsed_s
    covariance = jnp.broadcast_to(jnp.square(params.spread_m) * jnp.eye(3), (position_m.shape[0], 3, 3))
    return kalman.init(before, velocity_m_s, covariance, params.motion)


def _with_learned_sizes(slots: Slots, measured_size_m: Positions, params: TrackerParams) -> Slots:
    """The slots with sizes after one more frame: a running median, by stochastic approximation.

    Each length moves by a step towards the frame's length, whatever their distance, so that a minority of bad frames
    moves it little; the step shrinks with the number of frames (H. Robbins, S. Monro, A stochastic approximation
    method, Annals of Mathematical Statistics 22, 1951, for the median).
    """
    known = jnp.isfinite(measured_size_m) & params.learns_sizes
    share = SIZE_STEP * SIZE_FRAMES / (SIZE_FRAMES + slots.size_frames.astype(jnp.float32))
    # A step is no longer than the way.
    way = jnp.clip(jnp.log(jnp.where(known, measured_size_m, slots.size_m) / slots.size_m), -share, share)
    size_m = jnp.clip(
        slots.size_m * jnp.exp(way), slots.first_size_m / SIZE_RANGE, slots.first_size_m * SIZE_RANGE
    )
    return replace(slots, size_m=size_m, size_frames=slots.size_frames + known.astype(jnp.int32))


def _without_absent(rows: Rows, present: Bool[Array, "drones"]) -> Rows:
    """The rows with NaN, and status lost, for empty slots."""

    def known(value: Array) -> Array:
        if not jnp.issubdtype(value.dtype, jnp.floating):
            return value
        return jnp.where(present.reshape(-1, *[1] * (value.ndim - 1)), value, jnp.nan)

    return replace(jax.tree.map(known, rows), status=jnp.where(present, rows.status, Status.LOST))


def _reachable(slots: Slots, elapsed_s: Float[Array, ""], params: TrackerParams) -> SearchRegion:
    """Bounds of the search for each drone: what it can have reached since it was last found, within the room."""
    longest = params.max_speed_m_s * elapsed_s
    reach = longest * _frames_since_found(slots, params)
    low, high = params.bounds_m
    position = slots.motion.apparent_m
    return SearchRegion(
        low=jnp.clip(position - reach, low, high),
        high=jnp.clip(position + reach, low, high),
        max_step=jnp.broadcast_to(longest, (3,)),
    )


def _frames_since_found(slots: Slots, params: TrackerParams) -> Float[Array, "drones 1"]:
    """Frames since each drone was last found, from 1.

    The number grows until the drone is lost and then stays: a region that grows further would be searched with too few
    particles.
    """
    missed = jnp.minimum(slots.missed, params.max_coasting_frames)
    return 1.0 + missed[:, None].astype(jnp.float32)


def _first_particles(
    key: Key, expected: Positions, slots: Slots, params: TrackerParams, program: Program
) -> Float[Array, "particles drones 3"]:
    """First positions of the particles: about the expected position, more widely the longer a drone was not found."""
    spread = params.spread_m * _frames_since_found(slots, params)
    shape = (program.num_particles, *expected.shape)
    first = expected + spread * jax.random.normal(key, shape)
    # Two particles are the expected and the last position: a drone that flies on, or hovers, is found at once.
    return jnp.asarray(first).at[0].set(expected).at[1].set(slots.motion.apparent_m)


def _search(
    key: Key,
    inputs: ScoreInputs,
    first: Float[Array, "particles drones 3"],
    region: SearchRegion,
    slots: Slots,
    params: TrackerParams,
    program: Program,
) -> Positions:
    """The positions of largest fitness that the search finds."""
    particles, drones, _ = first.shape
    groups = (1, 3 * drones) if program.joint else (drones, 3)

    def together(position: Array) -> Array:
        return joint_fitness(inputs, position.reshape(first.shape), slots.present)[:, None]

    objective = together if program.joint else DroneFitness(inputs)
    of_groups = SearchRegion(
        low=region.low.reshape(groups),
        high=region.high.reshape(groups),
        max_step=jnp.broadcast_to(region.max_step[0], groups[1:]),
    )
    static = program.num_iterations
    num_iterations = params.num_iterations if static is None else jnp.int32(static)
    best = params.search(key, objective, first.reshape(particles, *groups), of_groups, num_iterations)
    return best.reshape(drones, 3)


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
