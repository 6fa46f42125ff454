"""From tracks to trajectories: which track is which drone, smoothing, and where the body's origin is.

All that needs the frames after a frame. A live source goes without.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from psotrack.identity import Identities, IdentityParams, LabelOutcome, relabelled, resolve
from psotrack.motion import MotionParams, estimate_jerk_density, smooth
from psotrack.settings import TrackSettings
from psotrack.tracking import Tracked, TrackerInfo, motion_params
from psotrack.trajectories import Status, Trajectories

logger = logging.getLogger(__name__)


def postprocess(tracked: Tracked, settings: TrackSettings, *, fps: float) -> tuple[Trajectories, Identities]:
    """The trajectories, and which drones may have been taken for each other when."""
    info = tracked.info
    num_frames, num_drones = info.status.shape
    time_s = np.arange(num_frames) / fps
    motion = jax.tree.map(lambda value: np.asarray(value, np.float64), motion_params(settings, num_drones))
    measured_m, covariance_m2, was_measured = _measured(info)
    identities = resolve(
        time_s,
        measured_m,
        covariance_m2,
        was_measured,
        motion,
        IdentityParams(encounter_m=settings.encounter_m),
        np.asarray(tracked.looks.size_m, np.float64),
    )
    for meeting in identities.encounters:
        if meeting.outcome is not LabelOutcome.KEPT:
            logger.info(
                "drones %d and %d, %.2f m apart in frame %d: labels %s",
                *meeting.drones,
                meeting.distance_m,
                meeting.closest_frame,
                meeting.outcome.value,
            )
    if settings.mend:
        info = jax.tree.map(lambda value: relabelled(value, identities.order), info)
    trajectories = _trajectories(info, time_s)
    if settings.smooth:
        trajectories = _smoothed(trajectories, info, motion)
    return replace(trajectories, position_m=trajectories.position_m - settings.body_offset_m), identities


def _measured(
    info: TrackerInfo,
) -> tuple[
    Float[np.ndarray, "frames drones 3"],
    Float[np.ndarray, "frames drones 3 3"],
    Bool[np.ndarray, "frames drones"],
]:
    """What each frame says by itself, where a drone was found."""
    was_measured = np.asarray(info.status) == Status.TRACKED
    return (
        np.asarray(info.measured_m, np.float64),
        np.asarray(info.measured_covariance_m2, np.float64),
        was_measured,
    )


def _trajectories(info: TrackerInfo, time_s: Float[np.ndarray, "frames"]) -> Trajectories:
    return Trajectories(
        frame=np.arange(len(time_s)),
        time_s=time_s,
        drones=tuple(str(drone) for drone in range(info.status.shape[1])),
        position_m=np.asarray(info.position_m, np.float64),
        velocity_m_s=np.asarray(info.velocity_m_s, np.float64),
        covariance_m2=np.asarray(info.covariance_m2, np.float64),
        fitness=np.nan_to_num(np.asarray(info.fitness, np.float64)),
        num_cameras=np.asarray(info.num_cameras, np.int64),
        status=np.asarray(info.status, np.int64),
    )


def _smoothed(trajectories: Trajectories, info: TrackerInfo, motion: MotionParams) -> Trajectories:
    """The trajectories with what later frames say of earlier ones."""
    measured = (trajectories.time_s, *_measured(info))
    # How much drones really change their acceleration: all of the recording tells.
    known = replace(motion, jerk_density_m2_s5=estimate_jerk_density(*measured, motion))
    smoothed = smooth(*measured, known)
    return replace(
        trajectories,
        position_m=smoothed.position_m,
        velocity_m_s=smoothed.velocity_m_s,
        covariance_m2=smoothed.covariance_m2,
    )
