"""What the residuals of all cameras show of the cameras' errors.

The place that a camera shows of a drone errs by the sum of

- a turn of the camera, the same in all frames, which moves places by about the same pixels everywhere,
- an error of its clock times the drone's velocity in the image,
- a lasting error, that stays for as long as the drone flies in one part of the image: a wrong lens or place of the
  camera, a detector's habit,
- noise, a part of which fades over some frames (`Fading`).

Noise and lasting errors are learned per camera (`variance_components`), turns and clocks for all cameras together
(`constant_errors`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls

from psotrack.tracking.camera_errors.constant_errors import ConstantErrors, fit_constant_errors
from psotrack.tracking.camera_errors.variance_components import (
    FittedPlaces,
    camera_variances,
    weighted_residuals,
)
from psotrack.tracking.camera_errors.views import CameraViews

#: Shortest and longest time constant that is tried for errors that fade, seconds, and number of time constants. What
#: fades more slowly counts as lasting.
_SHORTEST_S, _SLOWEST_S, _NUM_TIMES = 0.04, 1.5, 24
#: Longest lag of the autocorrelation, seconds, and as a share of the recording.
_LONGEST_S, _LONGEST_SHARE = 4.0, 0.5
#: Least number of pairs of residuals at a lag, and least number of lags.
_LEAST_PAIRS, _LEAST_LAGS = 30, 5


@dataclass(frozen=True)
class Fading:
    """Autocorrelation of errors: the sum of the white share at lag 0, fading share x exp(-lag / time), lasting share.

    Attributes:
        white_share, fading_share, lasting_share: shares of the variance; the sum is 1.
        time_s: time constant of the fading errors, seconds.
    """

    white_share: float
    fading_share: float
    lasting_share: float
    time_s: float

    def without_lasting(self) -> Fading:
        """The errors that do not last, alone."""
        rest = self.white_share + self.fading_share
        if not rest > 0:
            return Fading(1.0, 0.0, 0.0, self.time_s)
        return Fading(self.white_share / rest, self.fading_share / rest, 0.0, self.time_s)

    def inflation(self, step_s: float) -> float:
        """How much more the variance of a long sum over frames `step_s` apart is than that of a sum of white noise."""
        decay = np.exp(-step_s / self.time_s)
        return float(self.white_share + self.fading_share * (1 + decay) / (1 - decay))

    def variance_of_mean(
        self, num_frames: Int[np.ndarray, "*shape"], dt_s: float
    ) -> Float[np.ndarray, "*shape"]:
        """Variance of means over a number of neighbouring frames, as a share of the variance in one frame."""
        longest = max(1, int(num_frames.max(initial=1)))
        lag = np.arange(1, longest)
        n = np.arange(1, longest + 1)
        # The sum over lags k below n of (1 - k / n) rho_k, for every n at once.
        rho = np.exp(-lag * dt_s / self.time_s)
        first = np.concatenate([[0.0], np.cumsum(rho)])
        second = np.concatenate([[0.0], np.cumsum(lag * rho)])
        fading = (1 + 2 * (first - second / n)) / n
        share = self.white_share / n + self.fading_share * fading + self.lasting_share
        return share[np.maximum(num_frames, 1) - 1]


def fading_of(
    residual: Float[np.ndarray, "frames drones cameras 2"],
    shown: Bool[np.ndarray, "frames drones cameras"],
    dt_s: float,
    usual: Fading,
) -> Fading:
    """Fit the autocorrelation of the residuals of all drones and cameras together.

    A fit of positions shrinks residuals at all lags alike, so that the shares do not change.

    Args:
        residual: (frames, drones, cameras, 2), residuals in standard deviations of their cameras; any value where not
            shown.
        shown: (frames, drones, cameras), which residuals count.
        dt_s: time between frames, seconds.
        usual: the result where too few frames show it.
    """
    num_frames = len(residual)
    values = np.where(shown[..., None], residual, 0.0)
    lags = np.arange(int(min(_LONGEST_SHARE * num_frames, _LONGEST_S / dt_s)) + 1)
    pairs = np.array([(shown[: num_frames - lag] & shown[lag:]).sum() for lag in lags])
    sums = np.array([(values[: num_frames - lag] * values[lag:]).sum() for lag in lags])
    enough = pairs >= _LEAST_PAIRS
    if enough.sum() < _LEAST_LAGS or not enough[0] or not sums[0] > 0:
        return usual
    correlation = sums[enough] / pairs[enough] / (sums[0] / pairs[0])
    lags, weight = lags[enough], np.sqrt(pairs[enough])
    fits = []
    for time_s in np.geomspace(max(_SHORTEST_S, dt_s), max(_SLOWEST_S, 2 * dt_s), _NUM_TIMES):
        parts = np.stack([lags == 0, np.exp(-lags * dt_s / time_s), np.ones(len(lags))], axis=-1)
        shares, cost = nnls(parts * weight[:, None], correlation * weight)
        fits.append((cost, float(time_s), shares / max(shares.sum(), 1e-12)))
    _, time_s, shares = min(fits, key=lambda fit: fit[0])
    return Fading(float(shares[0]), float(shares[1]), float(shares[2]), time_s)


#: Errors are learned from frames that are this far apart, seconds, because errors of neighbouring frames are alike;
#: from nearer ones where there are fewer rows (frames x drones), and from fewer where there are more: more rows add
#: time and little accuracy.
_STEP_S, _MIN_ROWS, _MAX_ROWS = 0.1, 300, 6000
#: Least length of a block of frames whose mean shows lasting errors, seconds, and in time constants of fading errors.
_BLOCK_S, _BLOCK_TIMES = 1.0, 2.0
#: Weight of the mean of all cameras in each camera's lasting variance: a camera that is seen in one part of the image
#: has two numbers.
_SHARED_WEIGHT = 0.5
#: Least share of a camera's variance that is noise.
_LEAST_NOISE = 0.02
#: Variance of the noise in the first fit of turns and clocks, squared pixels.
_NO_NOISE = 1e-6
#: Rounds in which noise and constant errors are learned in turn.
_ROUNDS = 2


@dataclass(frozen=True)
class CameraErrors:
    """Standard deviations of the errors of the places that cameras show.

    Attributes:
        noise_px: (cameras, 2), errors that do not last, along columns and rows, pixels; NaN where no residual shows
            them.
        fading: how the errors that do not last fade.
        lasting_px: (cameras, 2), errors that last while a drone stays in one part of the image, pixels.
        turn_rad: turns of the cameras about each axis, radians.
        clock_s: the cameras' clocks, seconds.
        constant_covariance: (4 cameras, 4 cameras), of turns about x, y and z, radians, and clock, seconds, camera by
            camera; larger where residuals show little (see `constant_errors`).
    """

    noise_px: Float[np.ndarray, "cameras 2"]
    fading: Fading
    lasting_px: Float[np.ndarray, "cameras 2"]
    turn_rad: float
    clock_s: float
    constant_covariance: Float[np.ndarray, "all all"]


def learn_camera_errors(views: CameraViews, fps: float, usual: Fading) -> CameraErrors:
    """Learn the errors of a recording's cameras.

    Args:
        views: the views of all drones.
        fps: frames per second.
        usual: how noise fades, where too few frames show it.
    """
    num_cameras, dt_s = views.num_cameras, 1 / fps
    found = np.concatenate([_rows(part).determined for part in views.parts()])
    found = found.reshape(views.shown.shape[:2])
    num_rows = int(found.sum())
    step = max(1, min(round(_STEP_S * fps), num_rows // _MIN_ROWS), -(-num_rows // _MAX_ROWS))
    if found[::step].sum() < 2:
        none = np.zeros((num_cameras, 2))
        unknown = np.zeros((4 * num_cameras, 4 * num_cameras))
        return CameraErrors(none * np.nan, usual.without_lasting(), none, 0.0, 0.0, unknown)
    sample = views[::step]
    rows = _rows(sample)
    which = np.flatnonzero(rows.determined)
    fitted = partial(
        fit_constant_errors,
        rows.only(which),
        sample.turn_px.reshape(-1, num_cameras, 2, 3)[which],
        sample.flow_px_s.reshape(-1, num_cameras, 2)[which],
    )
    # First as if there were next to no noise: the noise of residuals that contain a turn would hide the turn.
    constant = fitted(np.ones((num_cameras, 2)), _NO_NOISE, with_covariance=False)
    total_px2 = None
    for round_number in range(_ROUNDS):
        rest = _without(views, constant)
        total_px2 = _total_variances(rest[::step], total_px2)
        fading = fading_of(rest.residual_px / np.sqrt(total_px2), rest.shown, dt_s, usual)
        noise_px = np.sqrt(total_px2 * max(1 - fading.lasting_share, _LEAST_NOISE))
        inflation = fading.without_lasting().inflation(step * dt_s)
        constant = fitted(noise_px, inflation, with_covariance=round_number == _ROUNDS - 1)
    rest = _without(views, constant)
    total_px2 = _total_variances(rest[::step], total_px2)
    fading = fading_of(rest.residual_px / np.sqrt(total_px2), rest.shown, dt_s, usual)
    noise = fading.without_lasting()
    length = max(1, round(max(_BLOCK_S, _BLOCK_TIMES * noise.time_s) * fps))
    blocks, num_frames = _blocks(rest, length)
    noise_px2 = total_px2 * max(1 - fading.lasting_share, _LEAST_NOISE)
    lasting_px2 = camera_variances(blocks, noise_px2 * noise.variance_of_mean(num_frames, dt_s)[..., None])
    shared_px2 = float(np.nanmean(lasting_px2)) if np.isfinite(lasting_px2).any() else 0.0
    lasting_px2 = np.where(np.isnan(lasting_px2), shared_px2, lasting_px2)
    lasting_px2 = _SHARED_WEIGHT * shared_px2 + (1 - _SHARED_WEIGHT) * lasting_px2
    return CameraErrors(
        noise_px=np.sqrt(np.maximum(total_px2 - lasting_px2, _LEAST_NOISE * total_px2)),
        fading=noise,
        lasting_px=np.sqrt(lasting_px2),
        turn_rad=constant.turn_std_rad,
        clock_s=constant.clock_std_s,
        constant_covariance=constant.covariance,
    )


def _rows(views: CameraViews) -> FittedPlaces:
    """The views of all frames and drones, as rows."""
    cameras = views.num_cameras
    return FittedPlaces(
        np.nan_to_num(views.residual_px).reshape(-1, cameras, 2),
        views.jacobian.reshape(-1, cameras, 2, 3),
        views.shown.reshape(-1, cameras),
    )


def _total_variances(
    views: CameraViews, near_px2: Float[np.ndarray, "cameras 2"] | None
) -> Float[np.ndarray, "cameras 2"]:
    """(cameras, 2), variances of the places in single frames; the mean of the others where a camera shows nothing.

    `near_px2` are the variances of the round before.
    """
    rows = _rows(views)
    variance_px2 = camera_variances(rows, np.zeros(rows.residual_px.shape), near_px2)
    return np.where(np.isnan(variance_px2), np.nanmean(variance_px2), variance_px2)


def _without(views: CameraViews, constant: ConstantErrors) -> CameraViews:
    """The views without the fitted turns and clocks, with residuals of positions that are fitted anew."""
    residuals_px = []
    for part in views.parts():
        turned_px = np.einsum("fdcip,cp->fdci", part.turn_px, constant.turn_rad)
        late_px = -part.flow_px_s * constant.clock_s[:, None]
        rows = _rows(replace(part, residual_px=part.residual_px - turned_px - late_px))
        determined = rows.determined
        fitted_px = np.where(rows.shown[..., None], rows.residual_px, np.nan)
        weight = np.repeat(rows.shown[determined][..., None].astype(float), 2, axis=-1)
        refitted_px = weighted_residuals(rows.only(determined), weight)[0]
        fitted_px[determined] = np.where(rows.shown[determined][..., None], refitted_px, np.nan)
        residuals_px.append(fitted_px.reshape(part.residual_px.shape))
    return replace(views, residual_px=np.concatenate(residuals_px))


def _blocks(views: CameraViews, length: int) -> tuple[FittedPlaces, np.ndarray]:
    """Means over blocks of frames, and the number of frames of each camera in them, (rows, cameras)."""
    residuals, jacobians, shown, counts = [], [], [], []
    for first in range(0, len(views.shown), length):
        part = slice(first, first + length)
        there = views.shown[part]
        count = there.sum(axis=0)
        least = np.maximum(count, 1)
        residuals.append(
            np.where(there[..., None], views.residual_px[part], 0.0).sum(axis=0) / least[..., None]
        )
        jacobian = np.where(there[..., None, None], views.jacobian[part], 0.0).sum(axis=0)
        jacobians.append(jacobian / least[..., None, None])
        shown.append(count >= max(1, len(there) // 2))
        counts.append(count)
    places = FittedPlaces(np.concatenate(residuals), np.concatenate(jacobians), np.concatenate(shown))
    return places, np.concatenate(counts)
