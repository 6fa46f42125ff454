"""Covariances of tracks from the errors of the cameras.

An error of a drone's place in a camera's image moves the estimated position by the gain of the estimate
(`CameraViews.gain`). Noise is averaged by the motion model; systematic errors are not, however many frames are
averaged. So the covariance of a track is that of the motion model, for the noise that was found, plus the covariance of
the systematic errors: biases, turns and clocks (consider parameters: B. D. Tapley, B. E. Schutz, G. H. Born,
Statistical Orbit Determination, 2004, section 6.4).

Clocks. Camera c shows a drone with the velocity v as late as d_c after the instant, so its place is J_c v d_c behind,
and the position errs by

    e = -sum_c G_c J_c v d_c,    G_c the gain of camera c, J_c the derivative of its projection.

The clocks are taken to err independently about the time of the recording, with mean 0 and variance s², so that
cov(e) = s² sum_c (G_c J_c v) (G_c J_c v)ᵀ. A delay d that all cameras share is in this sum with the part that
independent clocks have by chance, and no residual shows more of it: sum_c G_c J_c is the identity, so the drone is seen
v d behind its place by all cameras alike. Such a delay is not in the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.settings import ErrorSettings, MotionSettings
from psotrack.tracking.camera_errors.changes import Knock
from psotrack.tracking.camera_errors.learning import CameraErrors
from psotrack.tracking.camera_errors.views import CameraViews
from psotrack.tracking.motion import white_jerk_noise

#: Time over which stated and found noise are compared, seconds, and number of levels of the stated noise.
_WINDOW_S, _NUM_LEVELS = 1.0, 8
#: Nothing is known of the cameras' errors beforehand.
NO_ERRORS = ErrorSettings()
#: Number of doublings of the number of frames after which every filter has settled.
_DOUBLINGS = 30


def noise_covariance(views: CameraViews, errors: CameraErrors) -> Float[np.ndarray, "frames drones 3 3"]:
    """(frames, drones, 3, 3), covariance of positions from single frames by the cameras' noise, m².

    NaN where the noise is not known, or where the cameras do not determine a position.
    """
    noise_px = np.where(np.isnan(errors.noise_px), _mean(errors.noise_px), errors.noise_px)
    covariance_m2 = np.concatenate(
        [_moved_by_places(part.gain, np.square(noise_px)) for part in views.parts()]
    )
    return np.where((np.trace(covariance_m2, axis1=-2, axis2=-1) > 0)[..., None, None], covariance_m2, np.nan)


@dataclass(frozen=True)
class SystematicCovariances:
    """Covariances of positions by systematic errors, m².

    Attributes:
        absolute_m2: (frames, drones, 3, 3), of the positions in the world.
        relative_m2: (frames, drones, 3, 3), of the positions without each drone's mean error.
    """

    absolute_m2: Float[np.ndarray, "frames drones 3 3"]
    relative_m2: Float[np.ndarray, "frames drones 3 3"]


def systematic_covariances(
    views: CameraViews, errors: CameraErrors, given: ErrorSettings = NO_ERRORS, knock: Knock | None = None
) -> SystematicCovariances:
    """Covariances of the positions by systematic errors of the cameras.

    Turned cameras are off by nearly the same vector in all frames, so most of this error is a constant offset of each
    drone.

    Args:
        views: the views of all drones.
        errors: the cameras' errors.
        given: smallest errors that the settings state.
        knock: a camera that shows everything elsewhere from some frame on; None: no camera.
    """
    bias_px2 = np.maximum(np.square(errors.bias_px), given.pixel_px**2)
    constant = errors.constant_covariance.copy()
    of_turns = np.arange(len(constant)) % 4 < 3
    given_rad2 = float(np.radians(given.rig_deg)) ** 2 / 3
    constant[of_turns, of_turns] += max(0.0, given_rad2 - float(np.diag(constant)[of_turns].mean()))
    mean, parts, first = _mean_turned(views), [], 0
    for part in views.parts():
        gain = part.gain
        by_place, turned = _moved_by_places(gain, bias_px2), gain @ part.turn_px
        if knock is not None:
            after = np.arange(first, first + len(gain)) >= knock.frame
            moved_m = after[:, None, None] * (gain[:, :, knock.camera] @ knock.shift_px)
            by_place = by_place + moved_m[..., :, None] * moved_m[..., None, :]
        first += len(gain)
        late = -np.einsum("fdcik,fdck->fdci", gain, part.flow_px_s)[..., None]
        totals_m2 = []
        for offset in (0.0, mean):
            moved = np.concatenate([turned - offset, late], axis=-1).swapaxes(2, 3)
            moved = moved.reshape(*moved.shape[:3], -1)
            totals_m2.append(by_place + moved @ constant @ moved.swapaxes(-1, -2))
        parts.append((turned.any(axis=(-3, -2, -1)), *totals_m2))
    found, absolute_m2, relative_m2 = map(np.concatenate, zip(*parts, strict=True))
    return SystematicCovariances(_filled(absolute_m2, found, 0.0), _filled(relative_m2, found, 0.0))


def _moved_by_places(
    gain: Float[np.ndarray, "frames drones cameras 3 2"], variance_px2: Float[np.ndarray, "cameras 2"]
) -> Float[np.ndarray, "frames drones 3 3"]:
    """Covariances of positions by errors of the places: sum over cameras of gain x variances x gain transposed."""
    return np.einsum("fdcik,ck,fdcjk->fdij", gain, variance_px2, gain, optimize=True)


def _mean_turned(views: CameraViews) -> Float[np.ndarray, "drones cameras 3 3"]:
    """Mean of the derivatives of the positions by the cameras' turns, over the frames in which there are any."""
    total = np.zeros((*views.shown.shape[1:], 3, 3))
    count = np.zeros(views.shown.shape[1], int)
    for part in views.parts():
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
    motion: MotionSettings,
    fps: float,
) -> tuple[Float[np.ndarray, "frames drones"], Float[np.ndarray, "frames drones"]]:
    """Ratios of found and stated variances around each frame: of measured positions, and of filtered positions.

    A drone that leaves the view of some cameras is measured less well from then on, so the ratios change with time.
    1 where the noise is not known; a drone that is not measured keeps its last ratios.

    Args:
        measured_m2: (frames, drones, 3, 3), covariances of the measured positions as the tracker states them, m²; NaN
            where a drone was not measured.
        noise_m2: (frames, drones, 3, 3), from `noise_covariance`.
        errors: the cameras' errors.
        motion: the filter's motion model, and how it takes errors to fade.
        fps: frames per second.
    """
    stated, found = (np.trace(value, axis1=-2, axis2=-1) / 3 for value in (measured_m2, noise_m2))
    known = (stated > 0) & np.isfinite(stated) & np.isfinite(found)
    if not known.any():
        return np.ones(known.shape), np.ones(known.shape)
    dt_s = 1 / fps
    window = 1 + 2 * round(_WINDOW_S / dt_s / 2)
    stated, found = (_local_medians(np.where(known, value, np.nan), window) for value in (stated, found))
    # The filter's gain depends on the stated variance; with the gain, the variance is linear in the found variance.
    levels_m2 = np.geomspace(stated[known].min(), stated[known].max(), _NUM_LEVELS)

    def ratio(level_m2: float, part: float) -> float:
        assumed = MeasurementErrors(level_m2, motion.error_share, motion.error_time_s)
        real = MeasurementErrors(part * level_m2, errors.fading_fraction, errors.fading_time_s)
        before, after = filtered_variances(assumed, real, dt_s=dt_s, jerk_density_m2_s5=motion.jerk_density)
        return after / before

    level = np.where(known, stated, levels_m2[0])
    measured = np.where(known, found / level, 1.0)
    by_motion, by_both = (
        np.interp(np.log(level), np.log(levels_m2), [ratio(each, part) for each in levels_m2])
        for part in (0.0, 1.0)
    )
    filtered = by_motion + (by_both - by_motion) * measured
    return _filled(measured, known, 1.0), _filled(filtered, known, 1.0)


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


@dataclass(frozen=True)
class MeasurementErrors:
    """Errors of measured positions along one axis.

    Attributes:
        variance_m2: variance, m².
        fading_fraction: fraction of the variance that fades exponentially; the rest is white.
        time_s: time constant of the fading errors, seconds.
    """

    variance_m2: float
    fading_fraction: float
    time_s: float

    @property
    def fading_m2(self) -> float:
        """Variance of the fading errors, m²."""
        return self.fading_fraction * self.variance_m2


def filtered_variances(
    assumed: MeasurementErrors, found: MeasurementErrors, *, dt_s: float, jerk_density_m2_s5: float
) -> tuple[float, float]:
    """Variance of the filtered position as the filter states it, and as it is with the errors that were found, m².

    The filter of `psotrack.tracking.motion` assumes how much of the measurements' variance lasts, and for how long.
    What the errors of a recording are like is known only when all of it has been seen. Here the filter keeps its gain,
    and the variance of its error follows from the errors that were found (the Lyapunov equation of the joint error of
    state and filter; A. Gelb, Applied Optimal Estimation, 1974, section 7.2). One axis is enough, because the filter
    treats the axes alike.

    Args:
        assumed: errors that the filter assumes.
        found: errors of the measurements.
        dt_s: time between frames, seconds.
        jerk_density_m2_s5: spectral density of the white jerk.
    """
    # In units of the standard deviation that is assumed, and seconds.
    unit_m2 = assumed.variance_m2
    F, noise = np.eye(5), np.zeros((5, 5))
    F[:3, :3] += np.array([[0, dt_s, dt_s**2 / 2], [0, 0, dt_s], [0, 0, 0]])
    noise[:3, :3] = jerk_density_m2_s5 * white_jerk_noise(float(dt_s)) / unit_m2
    # State: position, velocity, acceleration, the filter's fading error; the real fading error.
    for row, errors in ((3, assumed), (4, found)):
        F[row, row] = np.exp(-dt_s / errors.time_s)
        noise[row, row] = errors.fading_m2 / unit_m2 * (1 - F[row, row] ** 2)
    # A measurement is the position plus the fading error plus white noise.
    H = np.array([1.0, 0.0, 0.0, 1.0])
    white = (assumed.variance_m2 - assumed.fading_m2) / unit_m2
    # The covariance of the predicted state in the end, by doubling the number of frames (B. D. O. Anderson,
    # International Journal of Control 28(2), 1978). SciPy's solver uses BLAS, whose threads wait long where processors
    # are shared.
    onward, told, P = F[:4, :4].T, np.outer(H, H) / white, noise[:4, :4]
    for _ in range(_DOUBLINGS):
        solved = np.linalg.inv(np.eye(4) + told @ P)
        told = told + onward @ solved @ told @ onward.T
        onward, P = onward @ solved @ onward, P + onward.T @ P @ solved @ onward
    gain = P @ H / (H @ P @ H + white)
    stated = P[0, 0] - gain[0] * (P @ H)[0]
    # With true minus estimated values, the innovation is the error of the position + the real fading error - the
    # filter's fading error + white noise.
    corrects = np.append(gain * np.array([-1.0, -1.0, -1.0, 1.0]), 0.0)
    correct = np.eye(5) + np.outer(corrects, [1.0, 0.0, 0.0, -1.0, 1.0])
    noise[3, 3] = 0.0
    white = (found.variance_m2 - found.fading_m2) / unit_m2
    driven = correct @ noise @ correct.T + white * np.outer(corrects, corrects)
    # X = (correct F) X (correct F)ᵀ + driven, as linear equations.
    ahead = correct @ F
    real = np.linalg.solve(np.eye(25) - np.kron(ahead, ahead), driven.ravel())[0]
    return float(stated * unit_m2), float(real * unit_m2)
