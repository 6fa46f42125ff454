"""How the cameras' errors fade: the autocorrelation of residuals, and the variance of means over correlated frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls

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
