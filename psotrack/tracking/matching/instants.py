"""Detections of frames that were exposed before or after the instant, moved along the drones' expected motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from psotrack.geometry import NEAR_M, Camera, project
from psotrack.tracking.matching.sightings import Sightings

#: A detection is moved with the drone whose expected box, this many times larger, holds its middle.
_REACH = 1.5


def moved_to_instant(
    cameras: Camera,
    view: Sightings,
    expected_m: Float[np.ndarray, "drones 3"],
    velocity_m_s: Float[np.ndarray, "drones 3"],
    velocity_covariance: Float[np.ndarray, "drones 3 3"],
    unknown_std_m_s: float,
) -> Sightings:
    """The detections as they would be if all frames had been exposed at the instant.

    A detection near an expected drone is moved by the drone's motion in the image between exposure and instant, and is
    less certain by the error of the velocity. Any other detection stays and is less certain by the motion of a drone
    of unknown velocity.

    Args:
        cameras: cameras with one leading axis.
        view: detections of the frames, and when the frames were exposed.
        expected_m, velocity_m_s: (drones, 3), expected positions at the instant, metres, and velocities, m/s.
        velocity_covariance: (drones, 3, 3), covariances of the velocities, m²/s².
        unknown_std_m_s: standard deviation of the velocity of a drone that is not expected.
    """
    if view.exposures is None:
        return view
    offset_s, line_time_s = (
        np.asarray(value, np.float64) for value in (view.exposures.offset_s, view.exposures.line_time_s)
    )
    focal_px = np.sqrt(np.abs(cameras.K[:, 0, 0] * cameras.K[:, 1, 1]))
    # Distance of a drone that is not expected: that of the point at which the cameras look, roughly.
    centre_m = cameras.centre_world
    usual_m = np.linalg.norm(centre_m - centre_m.mean(axis=0), axis=-1).max(initial=1.0)
    noise_px = np.hypot(view.noise_px, (unknown_std_m_s * focal_px * np.abs(offset_s) / usual_m)[:, None])
    if not len(expected_m):
        return replace(view, noise_px=noise_px)
    at_instant, depth = project(cameras, np.repeat(expected_m[:, None], len(offset_s), axis=1))
    height_px = np.asarray(cameras.image_size_wh, np.float64)[:, 1]
    row_px = np.clip(at_instant[..., 1], 0, height_px) - height_px / 2
    own_s = offset_s + line_time_s * row_px
    at_exposure, _ = project(cameras, expected_m[:, None] + velocity_m_s[:, None] * own_s[..., None])
    # (drones, cameras, boxes): distance in half sides of the box.
    off = np.abs(at_exposure[:, :, None] - view.centre_px) / (view.size_px / 2)
    off = np.where((depth > NEAR_M)[..., None], off.max(axis=-1), np.inf)
    off = np.where(np.isfinite(off), off, np.inf)
    drone = off.argmin(axis=0)
    near = off.min(axis=0) <= _REACH
    camera = np.arange(len(offset_s))[:, None]
    moved_px = (at_instant - at_exposure)[drone, camera]
    variance = np.maximum(velocity_covariance.trace(axis1=-2, axis2=-1) / 3, 0.0)
    error_px = np.sqrt(variance)[drone] * (focal_px * np.abs(offset_s))[:, None] / depth[drone, camera]
    return replace(
        view,
        centre_px=np.where(near[..., None], view.centre_px + moved_px, view.centre_px),
        noise_px=np.where(near, np.hypot(view.noise_px, error_px), noise_px),
    )
