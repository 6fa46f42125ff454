"""Simulated flights with white jerk, and one joint Gaussian of all states in float64 NumPy, as oracles for `motion`.

The textbook's state, (12,), is position, velocity, acceleration and the correlated error of the measurements. A
measurement observes position plus correlated error. The state of `psotrack.tracking.motion` contains this sum instead.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg import block_diag, expm

from psotrack.tracking.motion import Measurements, MotionParams

DT_S = 1 / 25

#: (3, 12), the measurement matrix.
H = np.eye(3, 12) + np.eye(3, 12, k=9)
#: (12, 12), maps the state of `psotrack.tracking.motion` to the textbook's state.
TO_TEXTBOOK = np.eye(12) - np.eye(12, k=9)


@dataclass(frozen=True)
class Model:
    """Motion model of one drone, with the values of `MotionParams`."""

    density: float = 30.0
    velocity_std: float = 1.0
    acceleration_std: float = 2.0
    error_share: float = 0.0
    error_time_s: float = 0.4

    def start(self, measured_m, covariance_m2):
        """Initial mean and covariance from the first measurement z = p + b + w.

        The position p has no prior; the correlated error b has its stationary prior; w is white noise.
        """
        rest = np.diag(np.repeat([self.velocity_std**2, self.acceleration_std**2], 3))
        correlated = self.error_share * covariance_m2
        spread = block_diag(covariance_m2, rest, correlated)
        # p = z - b - w.
        spread[:3, 9:] = spread[9:, :3] = -correlated
        return np.concatenate([measured_m, np.zeros(9)]), spread

    def transition(self, dt_s, covariance_m2):
        """F and Q of a time step; `covariance_m2` is the covariance of the previous measurement."""
        F, Q = transition(dt_s, self.density)
        left, begun = decay(dt_s, self.error_time_s)
        return block_diag(F, left * np.eye(3)), block_diag(Q, begun * self.error_share * covariance_m2)

    def params(self, drones):
        """`MotionParams` in float64 with the same values for all drones."""
        rest = (self.velocity_std, self.acceleration_std, self.error_share, self.error_time_s)
        return MotionParams(np.full(drones, self.density), *map(np.float64, rest))


def van_loan(rate, noise, dt_s):
    """F and Q of dx = rate · x dt + white noise, by the matrix exponential (C. F. Van Loan, 1978)."""
    size = len(rate)
    both = expm(np.block([[-rate, noise], [np.zeros((size, size)), rate.T]]) * dt_s)
    F = both[size:, size:].T
    return F, F @ both[:size, size:]


@cache
def transition(dt_s, density):
    """F and Q (9, 9) of position, velocity and acceleration."""
    return van_loan(
        np.kron(np.eye(3, k=1), np.eye(3)), np.kron(np.diag([0.0, 0.0, density]), np.eye(3)), dt_s
    )


@cache
def decay(dt_s, time_s):
    """Decay factor of an error of variance 1, and the variance of the noise that keeps the variance at 1."""
    left, begun = van_loan(np.array([[-1 / time_s]]), np.array([[2 / time_s]]), dt_s)
    return left.item(), begun.item()


def joint_gaussian(model, time_s, measured_m, covariance_m2, was_measured):
    """Mean and covariance of all states of one drone, given its first measurement, and what the others must be.

    In the first frame, only the measurement determines the position.

    Returns:
        (frames · 12,) and (frames · 12, frames · 12), then (measurements · 3, frames · 12), which maps all states to
        the measurements after the first, and their covariance.
    """
    frames = len(time_s)
    start, P = model.start(measured_m[0], covariance_m2[0])
    size, last = len(start), covariance_m2[0]
    mean = np.zeros((frames, size))
    prior = np.zeros((frames, size, frames, size))
    mean[0], prior[0, :, 0] = start, P
    for k in range(1, frames):
        F, Q = model.transition(round(time_s[k] - time_s[k - 1], 12), last)
        last = covariance_m2[k] if was_measured[k] else last
        mean[k] = F @ mean[k - 1]
        for j in range(k):
            prior[k, :, j] = F @ prior[k - 1, :, j]
            prior[j, :, k] = prior[k, :, j].T
        prior[k, :, k] = F @ prior[k - 1, :, k - 1] @ F.T + Q
    prior, mean = prior.reshape(size * frames, size * frames), mean.ravel()
    rows = np.flatnonzero(was_measured[1:]) + 1
    observed = np.kron(np.eye(frames)[rows], H)
    R = block_diag(*(1 - model.error_share) * covariance_m2[rows])
    return mean, prior, observed, observed @ prior @ observed.T + R


def textbook(model, time_s, measured_m, covariance_m2, was_measured):
    """Means and covariances of one drone without recursion: condition a Gaussian of all states on all measurements."""
    mean, prior, observed, S = joint_gaussian(model, time_s, measured_m, covariance_m2, was_measured)
    gain = np.linalg.solve(S, observed @ prior).T
    mean = mean + gain @ (measured_m[1:][was_measured[1:]].ravel() - observed @ mean)
    frames = len(time_s)
    covariance = (prior - gain @ observed @ prior).reshape(frames, 12, frames, 12)
    return mean.reshape(frames, 12), np.stack([covariance[k, :, k] for k in range(frames)])


@dataclass(frozen=True)
class SimulatedFlight:
    """Simulated drones and their measurements.

    Attributes:
        time_s: (frames,), times of the frames, seconds.
        state: (frames, drones, 9), true positions, velocities and accelerations.
        measured_m: (frames, drones, 3), measured positions, metres.
        covariance_m2: (frames, drones, 3, 3), covariances of the measurements.
        was_measured: (frames, drones), False where a measurement is missing.
        model: motion model that the drones obey.
    """

    time_s: np.ndarray
    state: np.ndarray
    measured_m: np.ndarray
    covariance_m2: np.ndarray
    was_measured: np.ndarray
    model: Model

    @property
    def measurements(self):
        return Measurements(self.time_s, self.measured_m, self.covariance_m2, self.was_measured)

    @property
    def params(self):
        return self.model.params(self.was_measured.shape[1])

    def textbook(self, drone, frames=slice(None)):
        """What the textbook says of one drone in some frames from their measurements."""
        by_drone = (self.measured_m, self.covariance_m2, self.was_measured)
        return textbook(self.model, self.time_s[frames], *(part[frames, drone] for part in by_drone))


def simulate_flight(seed, *, frames, drones, std_m=0.01, dt_s=DT_S, steady=False, **numbers):
    """Simulate drones that obey the model, measured in every frame with errors that obey their covariances.

    Covariances are ellipsoids of random directions, whose axes differ by a factor of about ten. Each measurement has
    its own covariance; if `steady`, all measurements of a drone have the same. `numbers` are attributes of `Model`.
    """
    rng = np.random.default_rng(seed)
    model = Model(**numbers)
    time_s = np.arange(frames) * dt_s
    F, Q = transition(dt_s, model.density)
    root = np.linalg.cholesky(Q)
    state = np.concatenate(
        [
            rng.uniform(-2, 2, (drones, 3)),
            model.velocity_std * rng.normal(size=(drones, 3)),
            model.acceleration_std * rng.normal(size=(drones, 3)),
        ],
        axis=-1,
    )
    states = [state]
    for _ in range(frames - 1):
        states.append(states[-1] @ F.T + rng.normal(size=(drones, 9)) @ root.T)
    states = np.stack(states)
    shape = std_m * (0.3 * np.eye(3) + 0.6 * rng.normal(size=(frames, drones, 3, 3)))
    if steady:
        shape[:] = shape[0]
    white = np.einsum("tdij,tdj->tdi", shape, rng.normal(size=(frames, drones, 3)))
    left, begun = decay(dt_s, model.error_time_s)
    # The new part of the correlated error has the covariance of the previous measurement.
    share = np.full(frames, begun * model.error_share)
    share[0] = model.error_share
    correlated = np.sqrt(share)[:, None, None] * np.einsum(
        "tdij,tdj->tdi", shape[[0, *range(frames - 1)]], rng.normal(size=(frames, drones, 3))
    )
    for k in range(1, frames):
        correlated[k] += left * correlated[k - 1]
    return SimulatedFlight(
        time_s=time_s,
        state=states,
        measured_m=states[..., :3] + correlated + np.sqrt(1 - model.error_share) * white,
        # The added term keeps every covariance positive definite.
        covariance_m2=shape @ np.swapaxes(shape, -1, -2) + 1e-12 * np.eye(3),
        was_measured=np.ones((frames, drones), bool),
        model=model,
    )


def halve_errors(flown):
    """Flight with half the measurement errors and the same covariances, so that no measurement is beyond the gate."""
    truth_m = flown.state[..., :3]
    return replace(flown, measured_m=truth_m + (flown.measured_m - truth_m) / 2)


def remove_measurements(flown, unknown):
    """Flight without the measurements where `unknown`; their values become NaN, so that any use of them would show."""
    return replace(
        flown,
        measured_m=np.where(unknown[..., None], np.nan, flown.measured_m),
        covariance_m2=np.where(unknown[..., None, None], np.nan, flown.covariance_m2),
        was_measured=~unknown,
    )


def remove_random_measurements(flown, seed, share=0.3):
    """Flight without a random share of its measurements; the first frame keeps all of its measurements."""
    unknown = np.random.default_rng(seed).random(flown.was_measured.shape) < share
    unknown[0] = False
    return remove_measurements(flown, unknown)
