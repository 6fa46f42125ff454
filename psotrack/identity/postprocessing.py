"""Post-processing: identity swaps are resolved, and on request later frames correct earlier ones (smoothing)."""

from __future__ import annotations

import logging
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from psotrack.identity.records import Identities, IdentityParams, LabelOutcome, relabelled
from psotrack.identity.resolving import resolve
from psotrack.motion import MotionParams, estimate_jerk_density, motion_params, smooth
from psotrack.settings import IdentitySettings, MotionSettings
from psotrack.trajectories import Status, Tracks, Trajectories

logger = logging.getLogger(__name__)


def postprocess(
    tracks: Tracks,
    motion: MotionSettings,
    identity: IdentitySettings,
    *,
    fps: float,
    smoothing: MotionSettings | None,
) -> tuple[Trajectories, Identities]:
    """Trajectories with resolved labels, and which drones may have been taken for each other.

    Args:
        tracks: tracks of the whole recording.
        motion: settings of the motion model.
        identity: when drones may be taken for each other, and whether swapped labels are put right.
        fps: frames per second.
        smoothing: settings of the motion model with which later frames correct earlier ones; None leaves the frames as
            they are.
    """
    time_s = np.arange(tracks.num_frames) / fps
    identities = resolve(
        time_s,
        *_measurements(tracks),
        _params(motion, tracks.num_drones),
        IdentityParams(encounter_m=identity.encounter_m),
        np.asarray(tracks.measured_size_m, np.float64),
    )
    for encounter in identities.encounters:
        if encounter.outcome is not LabelOutcome.KEPT:
            logger.info(
                "drones %d and %d, %.2f m apart in frame %d: labels %s",
                *encounter.drones,
                encounter.distance_m,
                encounter.closest_frame,
                encounter.outcome.value,
            )
    if identity.resolve_swaps:
        tracks = tracks.with_arrays(lambda name, value: relabelled(value, identities.order))
    trajectories = _trajectories(tracks, time_s)
    if smoothing is not None:
        trajectories = _smoothed(trajectories, tracks, _params(smoothing, tracks.num_drones))
    return trajectories, identities


def _params(motion: MotionSettings, num_drones: int) -> MotionParams:
    """The motion model's parameters in float64."""
    return jax.tree.map(lambda value: np.asarray(value, np.float64), motion_params(motion, num_drones))


def _measurements(
    tracks: Tracks,
) -> tuple[
    Float[np.ndarray, "frames drones 3"],
    Float[np.ndarray, "frames drones 3 3"],
    Bool[np.ndarray, "frames drones"],
]:
    """Measured positions, their covariances, and where a drone was found."""
    return (
        np.asarray(tracks.measured_m, np.float64),
        np.asarray(tracks.measured_covariance_m2, np.float64),
        np.asarray(tracks.status) == Status.TRACKED,
    )


def _trajectories(tracks: Tracks, time_s: Float[np.ndarray, "frames"]) -> Trajectories:
    return Trajectories(
        frame=np.arange(len(time_s)),
        time_s=time_s,
        drones=tuple(str(drone) for drone in range(tracks.num_drones)),
        position_m=np.asarray(tracks.position_m, np.float64),
        velocity_m_s=np.asarray(tracks.velocity_m_s, np.float64),
        covariance_m2=np.asarray(tracks.covariance_m2, np.float64),
        fitness=np.nan_to_num(np.asarray(tracks.fitness, np.float64)),
        num_cameras=np.asarray(tracks.num_cameras, np.int64),
        status=np.asarray(tracks.status, np.int64),
    )


def _smoothed(trajectories: Trajectories, tracks: Tracks, params: MotionParams) -> Trajectories:
    """The trajectories with earlier frames corrected by later ones."""
    measured = (trajectories.time_s, *_measurements(tracks))
    # The whole recording shows how much the drones really change their acceleration.
    known = replace(params, jerk_density_m2_s5=estimate_jerk_density(*measured, params))
    smoothed = smooth(*measured, known)
    return replace(
        trajectories,
        position_m=smoothed.position_m,
        velocity_m_s=smoothed.velocity_m_s,
        covariance_m2=smoothed.covariance_m2,
    )
