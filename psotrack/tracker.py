"""The tracker: where swarm and fitness meet, frame after frame.

Each frame is searched from where the motion model expects the drones (a warm start): particles around the
prediction, bounded by what a drone can reach and by the room, in windows of the silhouettes that are cut there. What
the swarm finds corrects position and velocity (an alpha-beta filter); where it finds nothing the drone coasts on its
prediction, and after a while is lost.

`step` does one frame, `track` is a scan of it over a chunk of frames. A live source calls `step`, so online and
offline are the same code, and the state crosses chunk borders.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, UInt8

from psotrack import swarm
from psotrack._typing import Array, Coverage, Key, Positions
from psotrack.boxes import extents
from psotrack.cameras import Camera
from psotrack.fitness import Scene, ScoreSettings, drone_fitness, filled, joint_fitness
from psotrack.patches import cut
from psotrack.trajectories import Status

#: Share of a drone's box that must be foreground for its camera to count as seeing it.
MIN_FILLED = 0.1
#: Particles start about the prediction; windows reach that many of their standard deviations beyond the ring.
REACH_SIGMAS = 3.0
#: A drone that was not found for more frames is not expected anywhere well enough to claim foreground.
MAX_CLAIMING_FRAMES = 4


@dataclass(frozen=True)
class Program:
    """What is compiled in: a change of any of these compiles anew.

    Attributes:
        num_particles: of every swarm.
        joint: one swarm over all drones (the paper's) instead of one per drone.
        claims: whether foreground that another drone is expected to cover says nothing about a drone.
        score: how positions are scored.
    """

    num_particles: int = 100
    joint: bool = False
    claims: bool = True
    score: ScoreSettings = field(default_factory=ScoreSettings)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerParams:
    """Knobs; all may differ between calls without a new compilation.

    Attributes:
        num_iterations: of the swarm, per frame.
        size_m: (drones, 3), full lengths of each drone's extent.
        bounds_m: (2, 3), lowest and highest corner of the room.
        dt_s: seconds between frames.
        max_speed_m_s: of a drone; bounds the search and the velocity.
        spread_m: standard deviation of the particles about the prediction.
        inertia, cognitive, social: of the swarm.
        position_gain, velocity_gain: alpha and beta of the motion model.
        min_fitness: below it a drone was not found.
        min_cameras: fewer than these, and a drone was not found.
        max_coasting_frames: after so many frames without being found a drone is lost.
    """

    num_iterations: Int[Array, ""]
    size_m: Positions
    bounds_m: Float[Array, "2 3"]
    dt_s: Float[Array, ""]
    max_speed_m_s: Float[Array, ""]
    spread_m: Float[Array, ""]
    inertia: Float[Array, ""]
    cognitive: Float[Array, ""]
    social: Float[Array, ""]
    position_gain: Float[Array, ""]
    velocity_gain: Float[Array, ""]
    min_fitness: Float[Array, ""]
    min_cameras: Int[Array, ""]
    max_coasting_frames: Int[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerState:
    """What the next frame needs.

    Attributes:
        key: consumed and replaced by every frame.
        position_m, velocity_m_s: (drones, 3), after the last frame.
        missed: (drones,), frames since the drone was last found.
    """

    key: Key
    position_m: Positions
    velocity_m_s: Positions
    missed: Int[Array, "drones"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrackerInfo:
    """What people look at, per frame; status holds values of `Status`."""

    position_m: Float[Array, "*frames drones 3"]
    velocity_m_s: Float[Array, "*frames drones 3"]
    fitness: Float[Array, "*frames drones"]
    num_cameras: Int[Array, "*frames drones"]
    status: Int[Array, "*frames drones"]


def init(key: Key, position_m: Positions, velocity_m_s: Positions, params: TrackerParams) -> TrackerState:
    """State before the first frame, for drones that will be at `position_m` in it. The key is consumed."""
    # One step back, so that the first prediction is the given position.
    return TrackerState(
        key=key,
        position_m=position_m - velocity_m_s * params.dt_s,
        velocity_m_s=velocity_m_s,
        missed=jnp.zeros(position_m.shape[0], jnp.int32),
    )


def step(
    state: TrackerState, coverage: Coverage, cameras: Camera, params: TrackerParams, program: Program
) -> tuple[TrackerState, TrackerInfo]:
    """One frame: predict, search, correct.

    Args:
        coverage: (cameras, height, width), silhouettes of the frame, 0..255, reduced.
    """
    key_next, key_spread, key_swarm = jax.random.split(state.key, 3)
    low, high = _reachable(state, params)
    predicted = jnp.clip(state.position_m + state.velocity_m_s * params.dt_s, low, high)
    view = _view(state, coverage, cameras, predicted, params, program)
    found = _search(key_spread, key_swarm, view, predicted, state, params, program, (low, high))
    fitness, num_cameras = _evidence(view, found, params)
    was_found = (fitness >= params.min_fitness) & (num_cameras >= params.min_cameras)

    innovation = jnp.where(was_found[:, None], found - predicted, 0.0)
    position = predicted + params.position_gain * innovation
    velocity = state.velocity_m_s + params.velocity_gain / params.dt_s * innovation
    velocity = _clamp_length(velocity, params.max_speed_m_s)
    missed = jnp.where(was_found, 0, state.missed + 1)
    lost = missed > params.max_coasting_frames
    velocity = jnp.where(lost[:, None], 0.0, velocity)
    status = jnp.where(was_found, Status.TRACKED, jnp.where(lost, Status.LOST, Status.COASTING))
    info = TrackerInfo(
        position_m=position,
        velocity_m_s=velocity,
        fitness=jnp.nan_to_num(fitness),
        num_cameras=num_cameras,
        status=status.astype(jnp.int32),
    )
    return TrackerState(key_next, position, velocity, missed), info


@partial(jax.jit, static_argnames="program")
def track(
    state: TrackerState,
    coverage: UInt8[Array, "frames cameras height width"],
    cameras: Camera,
    params: TrackerParams,
    program: Program,
) -> tuple[TrackerState, TrackerInfo]:
    """`step` over a chunk of frames, one compiled scan.

    Args:
        coverage: (frames, cameras, height, width) uint8; a chunk of silhouettes.

    Returns:
        The state after the last frame, and the info of every frame along a leading axis.
    """

    def one(carry: TrackerState, frame: Any) -> tuple[TrackerState, TrackerInfo]:
        return step(carry, frame, cameras, params, program)

    return jax.lax.scan(one, state, coverage)


def _view(
    state: TrackerState,
    coverage: Coverage,
    cameras: Camera,
    predicted: Positions,
    params: TrackerParams,
    program: Program,
) -> Scene:
    """What the score reads: windows about the predictions."""
    seen = extents(cameras, params.size_m)
    patches = cut(
        coverage,
        seen,
        predicted,
        reach_m=REACH_SIGMAS * params.spread_m * _frames_since_found(state)[:, 0],
        claiming=(state.missed <= MAX_CLAIMING_FRAMES) & program.claims,
        reduction=program.score.reduction,
        ring=program.score.ring,
    )
    return Scene(seen, patches, program.score)


def _reachable(state: TrackerState, params: TrackerParams) -> tuple[Positions, Positions]:
    """Bounds of the search for each drone: where it can have got to since it was last found, within the room."""
    reach = params.max_speed_m_s * params.dt_s * _frames_since_found(state)
    low, high = params.bounds_m
    return jnp.clip(state.position_m - reach, low, high), jnp.clip(state.position_m + reach, low, high)


def _frames_since_found(state: TrackerState) -> Float[Array, "drones 1"]:
    return 1.0 + state.missed[:, None].astype(jnp.float32)


def _search(
    key_spread: Key,
    key_swarm: Key,
    view: Scene,
    predicted: Positions,
    state: TrackerState,
    params: TrackerParams,
    program: Program,
    bounds: tuple[Positions, Positions],
) -> Positions:
    """The best positions that the swarm finds about the prediction."""
    particles, drones = program.num_particles, predicted.shape[0]
    spread = params.spread_m * _frames_since_found(state)
    start = predicted + spread * jax.random.normal(key_spread, (particles, drones, 3))
    # The prediction and the last position are particles too: a drone that flies on, or stands, is found at once.
    start = jnp.asarray(start).at[0].set(predicted).at[1].set(state.position_m)

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
    view: Scene, position_m: Positions, params: TrackerParams
) -> tuple[Float[Array, "drones"], Int[Array, "drones"]]:
    """Fitness of each drone where it was found, and the number of cameras that have foreground there."""
    num_cameras = (filled(view, position_m) >= MIN_FILLED).sum(axis=-1)
    return drone_fitness(view, position_m), num_cameras


def _clamp_length(vector: Positions, longest: Float[Array, ""]) -> Positions:
    length = jnp.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * jnp.minimum(1.0, longest / jnp.maximum(length, 1e-9))
