"""Covariances of tracks from the errors of the cameras.

An error of a drone's place in a camera's image moves the estimated position by the gain of the estimate
(`CameraViews.gain`). Noise is averaged by the motion model; errors that last are not, however many frames are averaged.
So the covariance of a track is that of the motion model, for the noise that was found, plus the covariance of the
errors that last (consider parameters: B. D. Tapley, B. E. Schutz, G. H. Born, Statistical Orbit Determination, 2004,
section 6.4).

Clocks. Camera c shows a drone with the velocity v as late as d_c after the instant, so its place is J_c v d_c behind,
and the position errs by

    e = -sum_c G_c J_c v d_c,    G_c the gain of camera c, J_c the derivative of its projection.

The clocks are taken to err independently about the time of the recording, with mean 0 and variance s², so that
cov(e) = s² sum_c (G_c J_c v) (G_c J_c v)ᵀ. A delay d that all cameras share is in this sum with the share that
independent clocks have by chance, and no residual shows more of it: sum_c G_c J_c is the identity, so the drone is seen
v d behind its place by all cameras alike. Such a delay is not in the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.tracking.camera_errors.filtered_variance import MeasurementErrors, filtered_variances
from psotrack.tracking.camera_errors.learning import CameraErrors
from psotrack.tracking.camera_errors.views import CameraViews

#: Time over which stated and found noise are compared, seconds, and number of levels of the stated noise.
_WINDOW_S, _NUM_LEVELS = 1.0, 8
#: Sum over cameras of gain x variances of their places x gain transposed.
_MOVED_BY_PLACES = "fdcik,ck,fdcjk->fdij"


def noise_covariance(views: CameraViews, errors: CameraErrors) -> Float[np.ndarray, "frames drones 3 3"]:
    """(frames, drones, 3, 3), covariance of positions from single frames by the cameras' noise, m².

    NaN where the noise is not known, or where the cameras do not determine a position.
    """
    noise_px = np.where(np.isnan(errors.noise_px), _mean(errors.noise_px), errors.noise_px)
    covariance_m2 = np.empty((*views.shown.shape[:2], 3, 3))
    for frames, part in views.parts():
        gain = part.gain
        covariance_m2[frames] = np.einsum(_MOVED_BY_PLACES, gain, np.square(noise_px), gain, optimize=True)
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
    *,
    rig_error_deg: float = 0.0,
    pixel_error_px: float = 0.0,
) -> LastingCovariances:
    """Covariances of the positions by errors of the cameras that last.

    Turned cameras are off by nearly the same vector in all frames, so most of this error is a constant offset of each
    drone.

    Args:
        views: the views of all drones.
        errors: the cameras' errors.
        rig_error_deg: angle by which each camera is turned at least, about a random axis, degrees.
        pixel_error_px: standard deviation of each camera's lasting error along either axis at least, pixels.
    """
    lasting_px2 = np.maximum(np.square(errors.lasting_px), pixel_error_px**2)
    constant = errors.constant_covariance.copy()
    of_turns = np.arange(len(constant)) % 4 < 3
    given_rad2 = float(np.radians(rig_error_deg)) ** 2 / 3
    constant[of_turns, of_turns] += max(0.0, given_rad2 - float(np.diag(constant)[of_turns].mean()))
    mean = _mean_turned(views)
    found = np.empty(views.shown.shape[:2], bool)
    absolute_m2, relative_m2 = (np.empty((*found.shape, 3, 3)) for _ in range(2))
    for frames, part in views.parts():
        gain = part.gain
        by_place = np.einsum(_MOVED_BY_PLACES, gain, lasting_px2, gain, optimize=True)
        turned = gain @ part.turn_px
        found[frames] = turned.any(axis=(-3, -2, -1))
        late = -np.einsum("fdcik,fdck->fdci", gain, part.flow_px_s)[..., None]
        for total_m2, offset in ((absolute_m2, 0.0), (relative_m2, mean)):
            moved = np.concatenate([turned - offset, late], axis=-1).swapaxes(2, 3)
            moved = moved.reshape(*moved.shape[:3], -1)
            total_m2[frames] = by_place + moved @ constant @ moved.swapaxes(-1, -2)
    return LastingCovariances(_filled(absolute_m2, found, 0.0), _filled(relative_m2, found, 0.0))


def _mean_turned(views: CameraViews) -> Float[np.ndarray, "drones cameras 3 3"]:
    """Mean of the derivatives of the positions by the cameras' turns, over the frames in which there are any."""
    total = np.zeros((*views.shown.shape[1:], 3, 3))
    count = np.zeros(views.shown.shape[1], int)
    for _, part in views.parts():
        turned = part.gain @ part.turn_px
        # Where nothing was found, the derivatives are 0.
        total += turned.sum(axis=0)
        count += turned.any(axis=(-3, -2, -1)).sum(axis=0)
    return total / np.maximum(count, 1)[:, None, None, None]


def _filled(
    values: Float[np.ndarray, "frames drones *rest"], known: Bool[np.ndarray, "frames drones"], empty: float
) -> Float[np.ndarray, "frames drones *rest"]:
    """The values of the nearest earlier known frame, or else of the first one; `empty` where a drone has none."""
    frame = np.arange(len(values))[:, None]
    last = np.maximum.accumulate(np.where(known, frame, -1), axis=0)
    nearest = np.where(last >= 0, last, known.argmax(axis=0))
    filled = values[nearest, np.arange(values.shape[1])]
    return np.where(known.any(axis=0).reshape(-1, *[1] * (values.ndim - 2)), filled, empty)


def noise_ratios(
    measured_m2: Float[np.ndarray, "frames drones 3 3"],
    noise_m2: Float[np.ndarray, "frames drones 3 3"],
    errors: CameraErrors,
    assumed: MeasurementErrors,
    *,
    dt_s: float,
    jerk_density_m2_s5: float,
) -> tuple[Float[np.ndarray, "frames drones"], Float[np.ndarray, "frames drones"]]:
    """Ratios of found and stated variances around each frame: of measured positions, and of filtered positions.

    A drone that leaves the view of some cameras is measured less well from then on, so the ratios change with time.
    1 where the noise is not known; a drone that is not measured keeps its last ratios.

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
    known = (stated > 0) & np.isfinite(stated) & np.isfinite(found)
    if not known.any():
        return np.ones(known.shape), np.ones(known.shape)
    window = 1 + 2 * round(_WINDOW_S / dt_s / 2)
    stated, found = (_local_medians(np.where(known, value, np.nan), window) for value in (stated, found))
    # The filter's gain depends on the stated variance; with the gain, the variance is linear in the found variance.
    levels_m2 = np.geomspace(stated[known].min(), stated[known].max(), _NUM_LEVELS)

    def filtered(level_m2: float, share: float) -> tuple[float, float]:
        return filtered_variances(
            MeasurementErrors(level_m2, assumed.fading_share, assumed.time_s),
            MeasurementErrors(share * level_m2, errors.fading.fading_share, errors.fading.time_s),
            dt_s=dt_s,
            jerk_density_m2_s5=jerk_density_m2_s5,
        )

    by_motion = np.array([after / before for before, after in (filtered(level, 0.0) for level in levels_m2)])
    by_both = np.array([after / before for before, after in (filtered(level, 1.0) for level in levels_m2)])
    level = np.where(known, stated, levels_m2[0])
    measured = np.where(known, found / level, 1.0)
    motion, both = (np.interp(np.log(level), np.log(levels_m2), each) for each in (by_motion, by_both))
    ratios = (measured, motion + (both - motion) * measured)
    return _filled(ratios[0], known, 1.0), _filled(ratios[1], known, 1.0)


def _local_medians(
    values: Float[np.ndarray, "frames drones"], window: int
) -> Float[np.ndarray, "frames drones"]:
    """Medians of the finite values in a window of frames around each finite value; NaN elsewhere."""
    half = window // 2
    padded = np.pad(values, [(half, half), (0, 0)], constant_values=np.nan)
    medians = np.full(values.shape, np.nan)
    for drone in range(values.shape[1]):
        frames = np.flatnonzero(np.isfinite(values[:, drone]))
        around = np.lib.stride_tricks.sliding_window_view(padded[:, drone], window)[frames]
        medians[frames, drone] = np.nanmedian(around, axis=-1)
    return medians


def _mean(values: np.ndarray) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
