"""The tracker's program, which is compiled, and its parameters, from its parts of the settings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psotrack.settings import ScoreSettings, SwarmSettings, TrackSettings
from psotrack.support import as_written, make_plugin
from psotrack.tracking.births import FlightLimits
from psotrack.tracking.motion import motion_params
from psotrack.tracking.swarm import tracker
from psotrack.tracking.swarm.fitness import PAPER_SCORE, Score, SoftIoU
from psotrack.tracking.swarm.search import Search, particle_swarm

#: Name of the swarm as one kernel. Its module is imported when it is chosen: Pallas takes long to import.
KERNEL = "pso-kernel"


@dataclass(frozen=True)
class TrackerSettings:
    """The settings of a run, and its search and score.

    Attributes:
        of_run: the settings.
        search: the search in one frame.
        camera_score: the score of positions in single cameras.
    """

    of_run: TrackSettings
    search: Search
    camera_score: Score


@as_written()
def tracker_settings(
    settings: TrackSettings, *, search: Search | None = None, score: Score | None = None
) -> TrackerSettings:
    """The settings of a run with its search and score.

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
        settings,
        search=find_search(settings.swarm) if search is None else search,
        camera_score=camera_score,
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
        settings: settings of the run, with search and score.
        reduction: image pixels per silhouette pixel, along each side.
        on_cpu: whether a CPU computes: there, the number of iterations needs no compilation of its own.
    """
    # The paper's score has neither occlusion nor a slope from which a vertex could be found.
    of_run, hard = settings.of_run, settings.camera_score == PAPER_SCORE
    return tracker.Program(
        num_particles=of_run.swarm.particles,
        num_iterations=None if on_cpu else of_run.swarm.iterations,
        joint=of_run.swarm.kind == "joint",
        occlusion=of_run.score.occlusion and not hard,
        vertex=of_run.score.vertex and not hard,
        score=settings.camera_score,
        reduction=reduction,
    )


def tracker_params(settings: TrackerSettings, num_slots: int, limits: FlightLimits) -> tracker.TrackerParams:
    """The numbers with which the tracker is called.

    Args:
        settings: settings of the run, with search and score.
        num_slots: number of slots for drones.
        limits: where and how fast drones may fly.
    """
    of_run = settings.of_run
    return tracker.TrackerParams(
        num_iterations=np.asarray(of_run.swarm.iterations, np.int32),
        bounds_m=np.asarray(limits.bounds_m, np.float32),
        dt_s=np.asarray(1 / limits.fps, np.float32),
        max_speed_m_s=np.asarray(limits.max_speed_m_s, np.float32),
        spread_m=np.asarray(of_run.swarm.spread_m, np.float32),
        search=settings.search,
        motion=motion_params(of_run.motion, num_slots),
        min_fitness=np.asarray(of_run.status.min_fitness, np.float32),
        min_cameras=np.asarray(of_run.status.min_cameras, np.int32),
        max_coasting_frames=np.asarray(round(of_run.status.max_coasting_s * limits.fps), np.int32),
        learns_sizes=np.asarray(of_run.drones.learn_sizes and of_run.drones.size_m is None, np.bool_),
    )
