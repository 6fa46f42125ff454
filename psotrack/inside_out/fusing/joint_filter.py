"""Kalman filter and smoother of one drone from two sources: its motion, the errors of both sources, and an arm.

The motion has white jerk (`psotrack.tracking.motion`); the backward pass is Rauch-Tung-Striebel's
(`psotrack.geometry.estimation`). The two sources have independent errors. Part of each source's error is white noise,
and part lasts: a first-order Gauss-Markov process (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, chapter 8), because the output of a filter, or a body seen from one side,
has similar errors in neighbouring frames. The lasting errors are part of the state. Where one source ends, the estimate
of the other source's error stays, and the path does not jump. The arm is the vector between the points that the two
sources measure.

All computations are in float64, and for several error models at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry.estimation import backward_step
from psotrack.tracking.motion import white_jerk_noise

INSIDE, OUTSIDE = 0, 1

#: Standard deviations of the initial position (about its first reading), velocity and acceleration along each axis.
_START_M, _START_M_S, _START_M_S2 = 1.0, 10.0, 10.0

#: Slices of the state vector; a tuple has one slice for each source.
_POSITION, _VELOCITY, _ACCELERATION, _ERRORS, _ARM = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    (slice(9, 12), slice(12, 15)),
    slice(15, 18),
)
SIZE = 18
_IDENTITY = np.eye(SIZE)

_Vector = Float[np.ndarray, "models 18"]
_Matrix = Float[np.ndarray, "models 18 18"]
#: Mean and covariance of the state under each model.
State = tuple[_Vector, _Matrix]


@dataclass(frozen=True)
class Readings:
    """Positions of one drone from two sources: the inside source (index 0) and the outside source (index 1).

    Attributes:
        time_s: (frames,), increasing, seconds.
        position_m: (frames, 2, 3), world, metres.
        covariance_m2: (frames, 2, 3, 3), covariances as the sources state them, m²; finite in all frames.
        known: (frames, 2), True where a source has a reading.
        ahead_s: (frames, 2), time of the reading minus time of the frame, seconds.
        lever: (frames, 2, 3, 3), matrix whose product with the arm is the reading minus the fused point: a rotation,
            its negative, or 0.
        added_m2: (frames, 2, 3, 3), covariance to be added without any scale: for the unknown rotation of the arm, or
            to reduce the weight of a reading.
    """

    time_s: Float[np.ndarray, "frames"]
    position_m: Float[np.ndarray, "frames 2 3"]
    covariance_m2: Float[np.ndarray, "frames 2 3 3"]
    known: Bool[np.ndarray, "frames 2"]
    ahead_s: Float[np.ndarray, "frames 2"]
    lever: Float[np.ndarray, "frames 2 3 3"]
    added_m2: Float[np.ndarray, "frames 2 3 3"]


@dataclass(frozen=True)
class ErrorModel:
    """Error models of the sources, and the jerk density of the drone: one or several alternatives.

    Attributes:
        white: (models, 2), variance of each source's white noise, as a multiple of the stated variance.
        lasting: (models, 2), variance of each source's lasting error, as a multiple of the stated variance.
        time_s: (models, 2), time constant of the lasting error's exponential decay, seconds.
        jerk_density_m2_s5: (models,), power spectral density of the white jerk along each axis, m²/s⁵.
    """

    white: Float[np.ndarray, "models 2"]
    lasting: Float[np.ndarray, "models 2"]
    time_s: Float[np.ndarray, "models 2"]
    jerk_density_m2_s5: Float[np.ndarray, "models"]


@dataclass(frozen=True)
class Arm:
    """Prior of the arm: its mean (3,), metres, and its standard deviation along each axis, metres."""

    mean_m: Float[np.ndarray, "3"]
    std_m: float


@dataclass(frozen=True)
class Joint:
    """Smoothed states of the drone, each from the readings of all frames.

    Attributes:
        position_m, velocity_m_s: (frames, 3), world.
        covariance_m2: (frames, 3, 3), covariances of the positions, m².
        arm_m, arm_covariance_m2: (3,), (3, 3), mean and covariance of the arm, m and m².
    """

    position_m: Float[np.ndarray, "frames 3"]
    velocity_m_s: Float[np.ndarray, "frames 3"]
    covariance_m2: Float[np.ndarray, "frames 3 3"]
    arm_m: Float[np.ndarray, "3"]
    arm_covariance_m2: Float[np.ndarray, "3 3"]


def log_likelihood(readings: Readings, model: ErrorModel, arm: Arm) -> Float[np.ndarray, "models"]:
    """(models,), logarithm of the probability density of all readings under each model."""
    total = np.zeros(len(model.white))
    for frame in _filter(readings, model, arm):
        total += frame.log_density
    return total


def smooth(readings: Readings, model: ErrorModel, arm: Arm) -> Joint:
    """Estimate every frame from all readings under one model."""
    frames = list(_filter(readings, model, arm))
    mean, covariance = frames[-1].state
    smoothed = [(mean, covariance)]
    for now, later in zip(frames[-2::-1], frames[:0:-1], strict=True):
        deviation = (mean - later.predicted[0])[..., None]
        step = backward_step(now.state[1], later.F, later.Q, later.predicted[1], covariance, deviation)
        change, covariance = map(np.asarray, step)
        mean = now.state[0] + change[..., 0]
        smoothed.append((mean, covariance))
    means, covariances = (np.concatenate(parts) for parts in zip(*smoothed[::-1], strict=True))
    return Joint(
        position_m=means[:, _POSITION],
        velocity_m_s=means[:, _VELOCITY],
        covariance_m2=covariances[:, _POSITION, _POSITION],
        arm_m=means[0, _ARM],
        arm_covariance_m2=covariances[0, _ARM, _ARM],
    )


@dataclass(frozen=True)
class _FilteredFrame:
    """One frame of the forward pass.

    Attributes:
        F, Q: transition matrix and process noise from the previous frame.
        predicted: state before the readings of the frame.
        state: state after the readings of the frame.
        log_density: (models,), logarithm of the density of the readings under the predicted state.
    """

    F: _Matrix
    Q: _Matrix
    predicted: State
    state: State
    log_density: Float[np.ndarray, "models"]


def _filter(readings: Readings, model: ErrorModel, arm: Arm) -> Iterator[_FilteredFrame]:
    roots = covariance_roots(readings)
    first = int(np.argmax(readings.known.any(axis=1)))
    state = initial_state(readings, model, arm, first)
    for k, (F, Q) in enumerate(iterate_transitions(readings.time_s, model)):
        predicted = state = predict(state, F, Q)
        log_density = np.zeros(len(model.white))
        if readings.known[k].any():
            parts = observe(readings, model, roots, k, np.flatnonzero(readings.known[k]))
            state, log_density = update(predicted, *parts)
        yield _FilteredFrame(F, Q, predicted, state, log_density)


def initial_state(readings: Readings, model: ErrorModel, arm: Arm, first: int | np.integer) -> State:
    """Make the initial state: at rest at the reading of frame `first`, with large standard deviations."""
    models = len(model.white)
    source = int(np.argmax(readings.known[first]))
    mean = np.zeros((models, SIZE))
    mean[:, _POSITION] = readings.position_m[first, source] - readings.lever[first, source] @ arm.mean_m
    mean[:, _ARM] = arm.mean_m
    std = np.repeat([_START_M, _START_M_S, _START_M_S2, 1.0, 1.0, arm.std_m], 3)
    return mean, np.broadcast_to(np.diag(std**2), (models, SIZE, SIZE)).copy()


def transition(dt_s: float, model: ErrorModel) -> tuple[_Matrix, _Matrix]:
    """Transition matrix F and process noise Q over `dt_s` seconds; lasting errors have unit variance in the state."""
    models = len(model.white)
    kept = np.exp(-dt_s / model.time_s)
    F = np.tile(np.eye(SIZE), (models, 1, 1))
    F[:, _POSITION, _VELOCITY] = F[:, _VELOCITY, _ACCELERATION] = dt_s * np.eye(3)
    F[:, _POSITION, _ACCELERATION] = dt_s**2 / 2 * np.eye(3)
    Q = np.zeros_like(F)
    Q[:, :9, :9] = model.jerk_density_m2_s5[:, None, None] * np.kron(white_jerk_noise(dt_s), np.eye(3))
    for source, block in enumerate(_ERRORS):
        F[:, block, block] = kept[:, source, None, None] * np.eye(3)
        Q[:, block, block] = (1 - kept[:, source, None, None] ** 2) * np.eye(3)
    return F, Q


def iterate_transitions(
    time_s: Float[np.ndarray, "frames"], model: ErrorModel
) -> Iterator[tuple[_Matrix, _Matrix]]:
    """Yield the `transition` from the previous frame to each frame; equal time steps share one computation."""
    by_step: dict[float, tuple[_Matrix, _Matrix]] = {}
    for dt_s in np.round(np.diff(time_s, prepend=time_s[:1]), 9).tolist():
        if dt_s not in by_step:
            by_step[dt_s] = transition(dt_s, model)
        yield by_step[dt_s]


def predict(state: State, F: _Matrix, Q: _Matrix) -> State:
    """Take a state through a transition."""
    mean, covariance = state
    return (F @ mean[..., None])[..., 0], F @ covariance @ F.swapaxes(1, 2) + Q


def observe(
    readings: Readings,
    model: ErrorModel,
    roots: Float[np.ndarray, "frames 2 3 3"],
    k: int | np.integer,
    sources: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make the observation equations of n sources in frame k.

    Returns:
        H (models, 3 n, 18), observation matrix; y (3 n,), measured positions, metres; and R (models, 3 n, 3 n), noise
        covariance, m².
    """
    models = len(model.white)
    H = np.zeros((models, 3 * len(sources), SIZE))
    R = np.zeros((models, 3 * len(sources), 3 * len(sources)))
    for row, source in enumerate(sources):
        rows, ahead_s = slice(3 * row, 3 * row + 3), readings.ahead_s[k, source]
        H[:, rows, _POSITION] = _IDENTITY[:3, :3]
        H[:, rows, _VELOCITY] = ahead_s * _IDENTITY[:3, :3]
        H[:, rows, _ACCELERATION] = ahead_s**2 / 2 * _IDENTITY[:3, :3]
        H[:, rows, _ERRORS[source]] = np.sqrt(model.lasting[:, source, None, None]) * roots[k, source]
        H[:, rows, _ARM] = readings.lever[k, source]
        white = model.white[:, source, None, None]
        R[:, rows, rows] = white * readings.covariance_m2[k, source] + readings.added_m2[k, source]
    return H, readings.position_m[k, sources].ravel(), R


def update(
    state: State, H: np.ndarray, y: np.ndarray, R: np.ndarray
) -> tuple[State, Float[np.ndarray, "models"]]:
    """Correct a state by an observation; return the state and the logarithm of the observation's density."""
    mean, covariance = state
    PHt = covariance @ H.swapaxes(1, 2)
    S = H @ PHt + R
    innovation = y - (H @ mean[..., None])[..., 0]
    precision = np.linalg.inv(S)
    K = PHt @ precision
    correction = (K @ innovation[..., None])[..., 0]
    kept = _IDENTITY - K @ H
    after = kept @ covariance @ kept.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
    misfit = (innovation * (precision @ innovation[..., None])[..., 0]).sum(axis=1)
    log_density = -(misfit + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
    return (mean + correction, (after + after.swapaxes(1, 2)) / 2), log_density


def select_frames(readings: Readings, rows: slice) -> Readings:
    """Take the readings of a slice of frames."""
    return Readings(**{name: value[rows] for name, value in vars(readings).items()})


def covariance_roots(readings: Readings) -> Float[np.ndarray, "frames 2 3 3"]:
    """(frames, 2, 3, 3), symmetric square roots of the stated covariances."""
    variance, axes = np.linalg.eigh(readings.covariance_m2)
    return np.einsum("...ij,...j,...kj->...ik", axes, np.sqrt(np.maximum(variance, 0.0)), axes)
