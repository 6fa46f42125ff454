"""The tracker's program, which is compiled, and its parameters, from its parts of the settings."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack.settings import (
    DroneSettings,
    MotionSettings,
    ScoreSettings,
    StatusSettings,
    SwarmSettings,
    TrackSettings,
)
from psotrack.support import make_plugin
from psotrack.tracking.motion import motion_params
from psotrack.tracking.swarm import tracker
from psotrack.tracking.swarm.fitness import PAPER_SCORE, Score, SoftIoU
from psotrack.tracking.swarm.search import Search, particle_swarm

#: Name of the swarm as one kernel. Its module is imported when it is chosen: Pallas takes long to import.
KERNEL = "pso-kernel"


@dataclass(frozen=True)
class TrackerSettings:
    """The parts of the settings that the tracker reads (see `psotrack.settings`), and its search and score.

    Attributes:
        swarm, score, motion, drones, status: parts of `TrackSettings`.
        search: the search in one frame.
        camera_score: the score of positions in single cameras.
        seed: seed of the random numbers.
    """

    swarm: SwarmSettings
    score: ScoreSettings
    motion: MotionSettings
    drones: DroneSettings
    status: StatusSettings
    search: Search
    camera_score: Score
    seed: int = 0


def tracker_settings(
    settings: TrackSettings, *, search: Search | None = None, score: Score | None = None
) -> TrackerSettings:
    """The tracker's parts of the settings of a run.

    Args:
        settings: settings of the run.
        search: replaces the search that the settings name.
        score: replaces the score that the settings name.

    Raises:
        SettingsError: the settings name a search or a score that does not exist, or that do not fit each other.
    """
    camera_score = find_score(settings.score) if score is None else score
    if search is None and settings.swarm.search == KERNEL:
        from psotrack.tracking.swarm.kernel import check_kernel

        check_kernel(settings.swarm.kind, camera_score)
    return TrackerSettings(
        settings.swarm,
        settings.score,
        settings.motion,
        settings.drones,
        settings.status,
        search=find_search(settings.swarm) if search is None else search,
        camera_score=camera_score,
        seed=settings.seed,
    )


def find_search(settings: SwarmSettings) -> Search:
    """The search that `settings.search` names.

    Raises:
        SettingsError: there is no search of this name.
    """
    if settings.search == "pso":
        return particle_swarm(settings)
    if settings.search == KERNEL:
        from psotrack.tracking.swarm.kernel import kernel_swarm

        return kernel_swarm(settings)
    return make_plugin(
        "search",
        settings.search,
        settings,
        interface=Search,
        setting="swarm.search",
        built_in=["pso", KERNEL],
    )


def find_score(settings: ScoreSettings) -> Score:
    """The score that `settings.kind` names.

    Raises:
        SettingsError: there is no score of this name.
    """
    if settings.kind == "soft":
        return SoftIoU(windows=settings.windows)
    if settings.kind == "hard":
        return PAPER_SCORE
    return make_plugin(
        "score", settings.kind, settings, interface=Score, setting="score.kind", built_in=["soft", "hard"]
    )


def tracker_program(settings: TrackerSettings, reduction: int, *, on_cpu: bool = True) -> tracker.Program:
    """What is compiled in: runs whose programs are equal can be one batch.

    Args:
        settings: the tracker's parts of the settings.
        reduction: image pixels per silhouette pixel, along each side.
        on_cpu: whether a CPU computes: there, the number of iterations needs no compilation of its own.
    """
    # The paper's score has neither occlusion nor a slope from which a vertex could be found.
    hard = settings.camera_score == PAPER_SCORE
    return tracker.Program(
        num_particles=settings.swarm.particles,
        num_iterations=None if on_cpu else settings.swarm.iterations,
        joint=settings.swarm.kind == "joint",
        occlusion=settings.score.occlusion and not hard,
        vertex=settings.score.vertex and not hard,
        score=settings.camera_score,
        reduction=reduction,
    )


def tracker_params(
    settings: TrackerSettings, num_slots: int, *, fps: float, bounds_m: Float[np.ndarray, "2 3"]
) -> tracker.TrackerParams:
    """The numbers with which the tracker is called.

    Args:
        settings: the tracker's parts of the settings.
        num_slots: number of slots for drones.
        fps: instants per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
    """
    return tracker.TrackerParams(
        num_iterations=jnp.int32(settings.swarm.iterations),
        bounds_m=jnp.asarray(bounds_m, jnp.float32),
        dt_s=jnp.float32(1 / fps),
        max_speed_m_s=jnp.float32(settings.motion.speed_limit_m_s),
        spread_m=jnp.float32(settings.swarm.spread_m),
        search=settings.search,
        motion=motion_params(settings.motion, num_slots),
        min_fitness=jnp.float32(settings.status.min_fitness),
        min_cameras=jnp.int32(settings.status.min_cameras),
        max_coasting_frames=jnp.int32(round(settings.status.max_coasting_s * fps)),
        learns_sizes=jnp.bool_(settings.drones.learn_sizes and settings.drones.size_m is None),
    )
