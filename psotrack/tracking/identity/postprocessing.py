"""Post-processing: identity swaps are resolved, and on request later frames correct earlier ones (smoothing).

A lost drone has no position: its prediction is worth nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from psotrack.settings import IdentitySettings, MotionSettings
from psotrack.tracking.identity.encounters import Identities, relabelled
from psotrack.tracking.identity.resolving import resolve
from psotrack.tracking.motion import Measurements, estimate_jerk_density, motion_params, smooth
from psotrack.trajectories import Status, Tracks, Trajectories


def postprocess(
    tracks: Tracks,
    motion: MotionSettings,
    identity: IdentitySettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    smoothing: MotionSettings | None,
) -> tuple[Trajectories, Identities]:
    """Trajectories with resolved labels, and which drones may have been taken for each other.

    Args:
        tracks: tracks of the whole recording.
        motion: settings of the motion model.
        identity: when drones may be taken for each other, and whether swapped labels are put right.
        fps: frames per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres, where smoothed tracks end as filtered ones do.
        smoothing: settings of the motion model with which later frames correct earlier ones; None leaves the frames as
            they are.
    """
    time_s = np.arange(tracks.num_frames) / fps
    measured, params = _measurements(tracks, time_s), motion_params(motion, tracks.num_drones)
    identities = resolve(measured, params, identity.encounter_m)
    if identity.resolve_swaps:
        tracks = tracks.with_arrays(lambda name, value: relabelled(value, identities.order))
    trajectories = Trajectories(
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
    if smoothing is not None:
        measured, params = _measurements(tracks, time_s), motion_params(smoothing, tracks.num_drones)
        # The whole recording shows how much the drones really change their acceleration.
        known = replace(params, jerk_density_m2_s5=estimate_jerk_density(measured, params))
        smoothed = smooth(measured, known)
        trajectories = replace(
            trajectories,
            position_m=np.clip(smoothed.position_m, *bounds_m),
            velocity_m_s=smoothed.velocity_m_s,
            covariance_m2=smoothed.covariance_m2,
        )
    return trajectories.without_lost(), identities


def _measurements(tracks: Tracks, time_s: Float[np.ndarray, "frames"]) -> Measurements:
    return Measurements(
        time_s,
        np.asarray(tracks.measured_m, np.float64),
        np.asarray(tracks.measured_covariance_m2, np.float64),
        np.asarray(tracks.status) == Status.TRACKED,
        np.asarray(tracks.status) == Status.LOST,
    )
