"""What the tracker is compiled for and called with, from what people set."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack.initiation import InitialState
from psotrack.motion import MotionParams
from psotrack.settings import TrackSettings
from psotrack.tracking import tracker
from psotrack.tracking.fitness import PAPER_SCORE, ScoreSettings


def tracker_inputs(
    reduction: int,
    start: InitialState,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
) -> tuple[tracker.Program, tracker.TrackerParams]:
    """What the tracker compiles, and the numbers that it is called with, from what people set."""
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
    return tracker_program(reduction, settings), params


def tracker_program(reduction: int, settings: TrackSettings) -> tracker.Program:
    """What the tracker compiles: runs whose programs are equal can be a batch."""
    soft = settings.score == "soft"
    score = ScoreSettings(windows=settings.windows) if soft else PAPER_SCORE
    return tracker.Program(
        num_particles=settings.particles,
        joint=settings.swarm == "joint",
        claims=settings.claims and soft,
        refined=settings.refinements > 0,
        vertex=settings.vertex and soft,
        score=replace(score, reduction=reduction),
    )


def motion_params(settings: TrackSettings, num_drones: int) -> MotionParams:
    """How drones move, and how their measured positions err."""
    return MotionParams(
        jerk_density_m2_s5=jnp.full(num_drones, settings.jerk_density_m2_s5, jnp.float32),
        velocity_std_m_s=jnp.float32(settings.velocity_std_m_s),
        acceleration_std_m_s2=jnp.float32(settings.acceleration_std_m_s2),
        error_share=jnp.float32(settings.error_share),
        error_time_s=jnp.float32(settings.error_time_s),
    )
