"""What the residuals of all cameras show of the cameras' errors.

The place that a camera shows of a drone errs by the sum of

- a turn of the camera, the same in all frames, which moves places by about the same pixels everywhere,
- an error of its clock times the drone's velocity in the image,
- a bias that changes over seconds, such as that of a wrong lens or place of the camera, of a detector, or of a hand
  that labels; no filter averages it,
- noise: white noise, and a correlated error that fades over some frames.

Turns and clocks are learned for all cameras together (`constant_errors`). What remains has a variance per camera
(`variance_components`) and one autocorrelation, a sum of exponentials (`Autocorrelation`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from psotrack.tracking.camera_errors.constant_errors import fit_constant_errors, student_inflation
from psotrack.tracking.camera_errors.variance_components import camera_variances, weighted_residuals
from psotrack.tracking.camera_errors.views import CameraViews

#: Correlated errors with a time constant below this, seconds, are noise; slower ones are a bias.
_SLOW_S = 1.5
#: Shortest time constant that is tried, seconds, and number of time constants.
_SHORTEST_S, _NUM_TIMES = 0.04, 30
#: Longest lag of the autocorrelation, seconds, and as a fraction of the recording; number of lags.
_LONGEST_S, _LONGEST_FRACTION, _NUM_LAGS = 20.0, 0.5, 60
#: Least number of pairs of residuals at a lag, and least number of lags.
_LEAST_PAIRS, _LEAST_LAGS = 30, 5
#: Errors are learned from frames that are this far apart, seconds, because errors of neighbouring frames are alike;
#: from nearer ones where there are fewer rows (frames x drones), and from fewer where there are more: more rows add
#: time and little accuracy.
_STEP_S, _MIN_ROWS, _MAX_ROWS = 0.1, 300, 3000
#: Least fraction of a camera's variance that is noise.
_LEAST_NOISE = 0.02
#: Largest number of rounds in which noise and constant errors are learned in turn. They end when no variance changes by
#: more than this fraction.
_ROUNDS, _SETTLED = 12, 0.01


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation of errors: white at lag 0, plus a sum of fractions x exp(-lag / time).

    Attributes:
        white: fraction of the variance that is white noise.
        fractions: (times,), fractions of the variance of the exponentials; all fractions together are 1.
        time_s: (times,), time constants, seconds.
    """

    white: float
    fractions: Float[np.ndarray, "times"]
    time_s: Float[np.ndarray, "times"]

    @property
    def bias(self) -> float:
        """Fraction of the variance that is bias."""
        return float(self.fractions[self.time_s >= _SLOW_S].sum())

    def fading(self) -> tuple[float, float]:
        """Fraction of the noise's variance that fades over some frames, and its mean time constant, seconds."""
        fast = self.time_s < _SLOW_S
        fractions, time_s = self.fractions[fast], self.time_s[fast]
        total = float(fractions.sum())
        if not total > 0:
            return 0.0, _SHORTEST_S
        return total / (total + self.white), float(fractions @ time_s / total)

    def inflation(self, step_s: float, duration_s: float = np.inf) -> float:
        """How much more the variance of a sum over frames `step_s` apart is than that of a sum of white noise.

        What changes more slowly than the recording of `duration_s` is one error for all of its frames.
        """
        decay = np.exp(-step_s / np.minimum(self.time_s, duration_s / 2))
        return float(self.white + self.fractions @ ((1 + decay) / (1 - decay)))


def autocorrelation_of(
    residual: Float[np.ndarray, "frames drones cameras 2"],
    shown: Bool[np.ndarray, "frames drones cameras"],
    dt_s: float,
    usual: Autocorrelation,
) -> Autocorrelation:
    """Fit the autocorrelation of the residuals of all drones and cameras together.

    A fit of positions shrinks residuals at all lags alike, so that the fractions do not change.

    Args:
        residual: (frames, drones, cameras, 2), residuals in standard deviations of their cameras; any value where not
            shown.
        shown: (frames, drones, cameras), which residuals count.
        dt_s: time between frames, seconds.
        usual: the result where too few frames show it.
    """
    num_frames = len(residual)
    values = np.where(shown[..., None], residual, 0.0).reshape(num_frames, -1)
    longest = int(min(_LONGEST_FRACTION * num_frames, _LONGEST_S / dt_s))
    lags = np.unique(np.round(np.concatenate([[0], np.geomspace(1, max(longest, 1), _NUM_LAGS)])).astype(int))
    pairs = np.array([(shown[: num_frames - lag] & shown[lag:]).sum() for lag in lags])
    # Not by BLAS, whose threads wait long where processors are shared.
    sums = np.array([np.einsum("fi,fi", values[: num_frames - lag], values[lag:]) for lag in lags])
    enough = pairs >= _LEAST_PAIRS
    if enough.sum() < _LEAST_LAGS or not enough[0] or not sums[0] > 0:
        return usual
    lags, correlation = lags[enough], sums[enough] / pairs[enough] / (sums[0] / pairs[0])
    # Lags are spread evenly on a logarithmic scale, so that each time constant is seen by as many lags.
    # Far longer than the longest lag: an error that never changes.
    time_s = np.geomspace(max(_SHORTEST_S, dt_s), 10 * max(lags[-1] * dt_s, _SHORTEST_S), _NUM_TIMES)
    parts = np.concatenate([(lags == 0)[:, None], np.exp(-lags[:, None] * dt_s / time_s)], axis=-1)
    weight = np.sqrt(pairs[enough])
    fractions, _ = nnls(parts * weight[:, None], correlation * weight)
    fractions = fractions / max(fractions.sum(), 1e-12)
    return Autocorrelation(float(fractions[0]), fractions[1:], time_s)


@dataclass(frozen=True)
class CameraErrors:
    """Standard deviations of the errors of the places that cameras show, so wide that a 90 % ellipsoid holds 90 %.

    Attributes:
        noise_px: (cameras, 2), noise along columns and rows, pixels; NaN where no residual shows it.
        fading_fraction, fading_time_s: fraction of the noise's variance that fades, and its time constant, seconds.
        bias_px: (cameras, 2), bias, which changes over seconds, pixels.
        turn_rad: turns of the cameras about each axis, radians.
        clock_s: the cameras' clocks, seconds.
        constant_covariance: (4 cameras, 4 cameras), of turns about x, y and z, radians, and clock, seconds, camera by
            camera; larger where residuals show little (see `constant_errors`).
    """

    noise_px: Float[np.ndarray, "cameras 2"]
    fading_fraction: float
    fading_time_s: float
    bias_px: Float[np.ndarray, "cameras 2"]
    turn_rad: float
    clock_s: float
    constant_covariance: Float[np.ndarray, "all all"]


def learn_camera_errors(views: CameraViews, fps: float, usual: tuple[float, float]) -> CameraErrors:
    """Learn the errors of a recording's cameras.

    Args:
        views: the views of all drones.
        fps: frames per second.
        usual: fraction of the noise that fades, and its time constant, where too few frames show it.
    """
    num_cameras, dt_s = views.num_cameras, 1 / fps
    duration_s = len(views.shown) * dt_s
    found = np.concatenate([part.places.determined for part in views.parts()])
    found = found.reshape(views.shown.shape[:2])
    num_rows = int(found.sum())
    step = max(1, min(round(_STEP_S * fps), num_rows // _MIN_ROWS), -(-num_rows // _MAX_ROWS))
    if found[::step].sum() < 2:
        none = np.zeros((num_cameras, 2))
        unknown = np.zeros((4 * num_cameras, 4 * num_cameras))
        return CameraErrors(none * np.nan, *usual, none, 0.0, 0.0, unknown)
    sample = views[::step]
    rows = sample.places
    which = np.flatnonzero(rows.determined)
    linear = (
        rows.only(which),
        sample.turn_px.reshape(-1, num_cameras, 2, 3)[which],
        sample.flow_px_s.reshape(-1, num_cameras, 2)[which],
    )
    # The first fit has no turns: noise that is learned from what many turns leave would be too small to doubt them.
    turn_rad, clock_s = np.zeros((num_cameras, 3)), np.zeros(num_cameras)
    correlation = Autocorrelation(1 - usual[0], *(np.array([value]) for value in usual))
    total_px2 = None
    for _ in range(_ROUNDS):
        rest = _without(views, turn_rad, clock_s)
        inflation, before_px2 = correlation.inflation(step * dt_s, duration_s), total_px2
        total_px2 = camera_variances(rest[::step].places, inflation, before_px2)
        total_px2 = np.where(np.isnan(total_px2), np.nanmean(total_px2), total_px2)
        correlation = autocorrelation_of(rest.residual_px / np.sqrt(total_px2), rest.shown, dt_s, correlation)
        inflation = correlation.inflation(step * dt_s, duration_s)
        constant = fit_constant_errors(*linear, np.sqrt(total_px2), inflation)
        turn_rad, clock_s = constant.turn_rad, constant.clock_s
        if before_px2 is not None and np.allclose(total_px2, before_px2, rtol=_SETTLED):
            break
    # Few independent residuals: the variance is itself uncertain.
    told = (2 * rows.shown[which].sum(axis=-1) - 3).sum() / inflation
    total_px2 = total_px2 * student_inflation(max(float(told), 1.0))
    bias = min(correlation.bias, 1 - _LEAST_NOISE)
    return CameraErrors(
        np.sqrt((1 - bias) * total_px2),
        *correlation.fading(),
        bias_px=np.sqrt(bias * total_px2),
        turn_rad=constant.turn_std_rad,
        clock_s=constant.clock_std_s,
        constant_covariance=constant.covariance,
    )


def _without(
    views: CameraViews, turn_rad: Float[np.ndarray, "cameras 3"], clock_s: Float[np.ndarray, "cameras"]
) -> CameraViews:
    """The views without the fitted turns and clocks, with residuals of positions that are fitted anew."""
    residuals_px = []
    for part in views.parts():
        turned_px = np.einsum("fdcip,cp->fdci", part.turn_px, turn_rad)
        late_px = -part.flow_px_s * clock_s[:, None]
        rows = replace(part, residual_px=part.residual_px - turned_px - late_px).places
        determined = rows.determined
        fitted_px = np.where(rows.shown[..., None], rows.residual_px, np.nan)
        weight = np.repeat(rows.shown[determined][..., None].astype(float), 2, axis=-1)
        refitted_px = weighted_residuals(rows.only(determined), weight)[0]
        fitted_px[determined] = np.where(rows.shown[determined][..., None], refitted_px, np.nan)
        residuals_px.append(fitted_px.reshape(part.residual_px.shape))
    return replace(views, residual_px=np.concatenate(residuals_px))
