"""Flights with white jerk, and what a textbook makes of them: written without `motion`, in plain float64 NumPy."""

from dataclasses import dataclass, replace
from functools import cache

import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from psotrack.motion import MotionParams

DT_S = 1 / 25


@cache
def transition(dt_s, density):
    """F and Q (9, 9) by the matrix exponential (C. F. Van Loan, 1978), which knows no closed form of either."""
    rate = np.kron(np.eye(3, k=1), np.eye(3))
    noise = np.kron(np.diag([0.0, 0.0, density]), np.eye(3))
    both = expm(np.block([[-rate, noise], [np.zeros((9, 9)), rate.T]]) * dt_s)
    F = both[9:, 9:].T
    return F, F @ both[:9, 9:]


def textbook_filter(time_s, measured_m, covariance_m2, was_measured, density, velocity_std, acceleration_std):
    """One drone, born in frame 0: (9,) means, (9, 9) covariances and NIS of every frame, by inverse and P - K S K^T."""
    H = np.eye(3, 9)
    x = np.concatenate([measured_m[0], np.zeros(6)])
    P = np.diag(np.repeat([0.0, velocity_std**2, acceleration_std**2], 3))
    P[:3, :3] = covariance_m2[0]
    means, covariances, nis = [x], [P], [np.nan]
    for k in range(1, len(time_s)):
        F, Q = transition(round(time_s[k] - time_s[k - 1], 12), density)
        x, P = F @ x, F @ P @ F.T + Q
        nis.append(np.nan)
        if was_measured[k]:
            innovation = measured_m[k] - H @ x
            S_inv = np.linalg.inv(H @ P @ H.T + covariance_m2[k])
            K = P @ H.T @ S_inv
            x, P = x + K @ innovation, P - K @ H @ P
            nis[-1] = innovation @ S_inv @ innovation
        means.append(x)
        covariances.append(P)
    return np.array(means), np.array(covariances), np.array(nis)


def textbook_smoother(
    time_s, measured_m, covariance_m2, was_measured, density, velocity_std, acceleration_std
):
    """The same as `textbook_filter` given all frames, without any recursion: one Gaussian over all states at once.

    All states together have a joint normal prior; the measurements condition it. In the first frame the position is
    known by its measurement alone.
    """
    frames = len(time_s)
    prior = np.zeros((frames, 9, frames, 9))
    mean = np.zeros((frames, 9))
    mean[0, :3] = measured_m[0]
    P = np.diag(np.repeat([0.0, velocity_std**2, acceleration_std**2], 3))
    P[:3, :3] = covariance_m2[0]
    prior[0, :, 0] = P
    for k in range(1, frames):
        F, Q = transition(round(time_s[k] - time_s[k - 1], 12), density)
        mean[k] = F @ mean[k - 1]
        for j in range(k):
            prior[k, :, j] = F @ prior[k - 1, :, j]
            prior[j, :, k] = prior[k, :, j].T
        prior[k, :, k] = F @ prior[k - 1, :, k - 1] @ F.T + Q
    prior, mean = prior.reshape(9 * frames, 9 * frames), mean.ravel()
    rows = np.flatnonzero(was_measured[1:]) + 1
    H = np.concatenate([np.eye(3, 9 * frames, k=9 * row) for row in rows])
    R = np.zeros((3 * len(rows),) * 2)
    for i, row in enumerate(rows):
        R[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = covariance_m2[row]
    gain = np.linalg.solve(H @ prior @ H.T + R, H @ prior).T
    mean = mean + gain @ (measured_m[rows].ravel() - H @ mean)
    covariance = (prior - gain @ H @ prior).reshape(frames, 9, frames, 9)
    return mean.reshape(frames, 9), np.stack([covariance[k, :, k] for k in range(frames)])


@dataclass(frozen=True)
class Flown:
    """What was flown, (frames, drones, 9), and what was measured of it."""

    time_s: np.ndarray
    state: np.ndarray
    measured_m: np.ndarray
    covariance_m2: np.ndarray
    was_measured: np.ndarray
    params: MotionParams

    @property
    def measurements(self):
        """What `smooth` and `jerk_density` take, but the params."""
        return self.time_s, self.measured_m, self.covariance_m2, self.was_measured


def fly(seed, *, frames, drones, density=30.0, std_m=0.01, velocity_std=1.0, acceleration_std=2.0, dt_s=DT_S):
    """Flights that obey the model to the letter, measured in every frame with errors that obey their covariances.

    Each measurement has a covariance of its own: ellipsoids that point anywhere, some ten times as long as wide.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(frames) * dt_s
    F, Q = transition(dt_s, density)
    root = np.linalg.cholesky(Q)
    state = np.concatenate(
        [
            rng.uniform(-2, 2, (drones, 3)),
            velocity_std * rng.normal(size=(drones, 3)),
            acceleration_std * rng.normal(size=(drones, 3)),
        ],
        axis=-1,
    )
    states = [state]
    for _ in range(frames - 1):
        states.append(states[-1] @ F.T + rng.normal(size=(drones, 9)) @ root.T)
    states = np.stack(states)
    shape = std_m * (0.3 * np.eye(3) + 0.6 * rng.normal(size=(frames, drones, 3, 3)))
    error = np.einsum("tdij,tdj->tdi", shape, rng.normal(size=(frames, drones, 3)))
    return Flown(
        time_s=time_s,
        state=states,
        measured_m=states[..., :3] + error,
        # No covariance is that of a flat disc.
        covariance_m2=shape @ np.swapaxes(shape, -1, -2) + 1e-12 * np.eye(3),
        was_measured=np.ones((frames, drones), bool),
        params=motion_params(density, drones, velocity_std, acceleration_std),
    )


def calm(flown):
    """The same with errors half as large as they claim to be: no measurement is beyond the gate."""
    truth_m = flown.state[..., :3]
    return replace(flown, measured_m=truth_m + (flown.measured_m - truth_m) / 2)


def without(flown, unknown):
    """Nothing measured where `unknown`, and NaN to show that it is not used."""
    measured_m, covariance_m2 = flown.measured_m.copy(), flown.covariance_m2.copy()
    measured_m[unknown], covariance_m2[unknown] = np.nan, np.nan
    return replace(
        flown, measured_m=measured_m, covariance_m2=covariance_m2, was_measured=flown.was_measured & ~unknown
    )


def some_unknown(flown, seed, share=0.3):
    """Some frames without a measurement, but not the first."""
    unknown = np.random.default_rng(seed).random(flown.was_measured.shape) < share
    unknown[0] = False
    return without(flown, unknown)


def motion_params(density, drones, velocity_std=1.0, acceleration_std=2.0):
    """Params of drones that are all alike, float32."""
    return MotionParams(
        jnp.full(drones, density, jnp.float32), jnp.float32(velocity_std), jnp.float32(acceleration_std)
    )


def nees(error, covariance):
    """e^T C^-1 e over the last axes."""
    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)
