"""Covariances of tracks from the errors of the cameras.

An error of a drone's place in a camera's image moves the estimated position by the gain of the estimate
(`CameraViews.gain`). Noise is averaged by the motion model; errors that last are not, however many frames are averaged.
So the covariance of a track is that of the motion model, for the noise that was found, plus the covariance of the
errors that last (consider parameters: B. D. Tapley, B. E. Schutz, G. H. Born, Statistical Orbit Determination, 2004,
section 6.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import fdtri, gammaincinv

from psotrack.camera_errors.filtered_variance import MeasurementErrors, filtered_variances
from psotrack.camera_errors.learning import CameraErrors
from psotrack.camera_errors.views import CameraViews

#: Probability of the ellipsoid for which few degrees of freedom are allowed.
_PROBABILITY = 0.9
#: Least number of degrees of freedom: with fewer, no finite ellipsoid would be wide enough to be of use.
_LEAST_FREEDOM = 2


def noise_covariance(views: CameraViews, errors: CameraErrors) -> Float[np.ndarray, "frames drones 3 3"]:
    """(frames, drones, 3, 3), covariance of positions from single frames by the cameras' noise, m².

    NaN where the noise is not known, or where the cameras do not determine a position.
    """
    noise_px = np.where(np.isnan(errors.noise_px), _mean(errors.noise_px), errors.noise_px)
    gain = views.gain
    covariance_m2 = np.einsum("fdcik,c,fdcjk->fdij", gain, np.square(noise_px), gain, optimize=True)
    return np.where((np.trace(covariance_m2, axis1=-2, axis2=-1) > 0)[..., None, None], covariance_m2, np.nan)


@dataclass(frozen=True)
class LastingCovariances:
    """Covariances of positions by errors that last, m².

    Attributes:
        absolute_m2: (frames, drones, 3, 3), of the positions in the world.
        relative_m2: (frames, drones, 3, 3), of the positions without each drone's mean error.
    """

    absolute_m2: Float[np.ndarray, "frames drones 3 3"]
    relative_m2: Float[np.ndarray, "frames drones 3 3"]


def lasting_covariances(
    views: CameraViews,
    errors: CameraErrors,
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
    *,
    rig_error_deg: float = 0.0,
    pixel_error_px: float = 0.0,
) -> LastingCovariances:
    """Covariances of the positions by errors of the cameras that last.

    Turned cameras are off by nearly the same vector in all frames, so most of this error is a constant offset of each
    drone. The clock of the recording is one more clock that errs as the cameras' clocks do.

    Args:
        views: the views of all drones.
        errors: the cameras' errors.
        velocity_m_s: (frames, drones, 3), velocities, m/s; NaN where they are not known.
        rig_error_deg: angle by which each camera is turned at least, about a random axis, degrees.
        pixel_error_px: standard deviation of each camera's lasting error along either axis at least, pixels.
    """
    gain, cameras = views.gain, views.num_cameras
    lasting_px2 = np.maximum(np.square(errors.lasting_px), pixel_error_px**2)
    by_place = np.einsum("fdcik,c,fdcjk->fdij", gain, lasting_px2, gain, optimize=True)
    turn_rad2 = max(
        widening(3 * (cameras - 1)) * errors.turn_rad**2, float(np.radians(rig_error_deg)) ** 2 / 3
    )
    turned = gain @ views.turn_px
    known = np.expand_dims(np.abs(turned).sum(axis=(-3, -2, -1)), (-3, -2, -1)) > 0
    mean = np.where(known, turned, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    moved = np.einsum("fdcik,fdck->fdci", gain, views.flow_px_s)
    own = np.nan_to_num(velocity_m_s)
    by_clock = _outer(moved) + own[..., :, None] * own[..., None, :]
    others = by_place + widening(cameras - 1) * errors.clock_s**2 * by_clock
    found = known[..., 0]
    return LastingCovariances(
        *(_filled(others + turn_rad2 * _outer_of_turns(each), found) for each in (turned, turned - mean))
    )


def _outer(vectors: Float[np.ndarray, "frames drones cameras 3"]) -> Float[np.ndarray, "frames drones 3 3"]:
    return vectors.swapaxes(-1, -2) @ vectors


def _outer_of_turns(
    turned: Float[np.ndarray, "frames drones cameras 3 3"],
) -> Float[np.ndarray, "frames drones 3 3"]:
    frames, drones, cameras = turned.shape[:3]
    flat = turned.swapaxes(-2, -1).reshape(frames, drones, 3 * cameras, 3)
    return flat.swapaxes(-1, -2) @ flat


def _filled(
    values_m2: Float[np.ndarray, "frames drones 3 3"], known: Bool[np.ndarray, "frames drones 1 1"]
) -> Float[np.ndarray, "frames drones 3 3"]:
    """The values of the nearest earlier known frame, or else of the first one; 0 where a drone has none."""
    frame = np.arange(len(values_m2))[:, None]
    there = known[..., 0, 0]
    last = np.maximum.accumulate(np.where(there, frame, -1), axis=0)
    nearest = np.where(last >= 0, last, there.argmax(axis=0))
    filled = np.take_along_axis(values_m2, nearest[..., None, None], axis=0)
    return np.where(there.sum(axis=0)[:, None, None] > 0, filled, 0.0)


def widening(freedom: int) -> float:
    """Factor of a covariance in three dimensions that was learned from few numbers: Student's t instead of the normal.

    With the factor, 90 % of the errors lie in the 90 % ellipsoid (Hotelling 1931: F instead of chi-square).

    Args:
        freedom: number of independent numbers behind the covariance.
    """
    freedom = max(freedom, _LEAST_FREEDOM)
    return float(3 * fdtri(3, freedom, _PROBABILITY) / (2 * gammaincinv(3 / 2, _PROBABILITY)))


def noise_ratios(
    measured_m2: Float[np.ndarray, "frames drones 3 3"],
    noise_m2: Float[np.ndarray, "frames drones 3 3"],
    errors: CameraErrors,
    assumed: MeasurementErrors,
    *,
    dt_s: float,
    jerk_density_m2_s5: float,
) -> tuple[Float[np.ndarray, "drones"], Float[np.ndarray, "drones"]]:
    """Ratios of found and stated variances for each drone: of measured positions, and of filtered positions.

    1 where the noise is not known.

    Args:
        measured_m2: (frames, drones, 3, 3), covariances of the measured positions as the tracker states them, m²; NaN
            where a drone was not measured.
        noise_m2: (frames, drones, 3, 3), from `noise_covariance`.
        errors: the cameras' errors.
        assumed: how the filter takes errors to fade; its variance does not count.
        dt_s: time between frames, seconds.
        jerk_density_m2_s5: spectral density of the white jerk of the filter.
    """
    stated, found = (np.trace(value, axis1=-2, axis2=-1) / 3 for value in (measured_m2, noise_m2))
    measured, filtered = np.ones((2, stated.shape[1]))
    for drone in range(stated.shape[1]):
        known = np.isfinite(stated[:, drone]) & np.isfinite(found[:, drone])
        if not known.any():
            continue
        stated_m2, found_m2 = (float(np.median(value[known, drone])) for value in (stated, found))
        measured[drone] = found_m2 / stated_m2
        before_m2, after_m2 = filtered_variances(
            MeasurementErrors(stated_m2, assumed.fading_share, assumed.time_s),
            MeasurementErrors(found_m2, errors.fading.fading_share, errors.fading.time_s),
            dt_s=dt_s,
            jerk_density_m2_s5=jerk_density_m2_s5,
        )
        filtered[drone] = after_m2 / before_m2
    return measured, filtered


def _mean(values: np.ndarray) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
