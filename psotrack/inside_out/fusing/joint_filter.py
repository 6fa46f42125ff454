"""One drone from two sources of positions: a motion, an error that lasts in each source, and an arm between them.

A forward-backward filter (H. E. Rauch, F. Tung, C. T. Striebel, Maximum likelihood estimates of linear dynamic systems,
AIAA Journal 3(8), 1965) over the motion of `psotrack.motion`: white jerk (Y. Bar-Shalom, X. R. Li, T. Kirubarajan,
Estimation with Applications to Tracking and Navigation, 2001, section 6.2.3). The two sources share no error. What each
is off by is partly new in every frame and partly lasts, a first-order Gauss-Markov process (chapter 8 there), because
the output of a filter or a body seen from one side errs alike in neighbouring frames. Such an error is in the state:
where one source ends, what is known of the other's error is not forgotten, and the path does not jump.

In float64, all of it, over any number of error models at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

INSIDE, OUTSIDE = 0, 1

#: Standard deviations that a drone starts with along each axis: about its first reading, of velocity and acceleration.
_START_M, _START_M_S, _START_M_S2 = 1.0, 10.0, 10.0

#: Blocks of the state, three numbers each.
_POSITION, _VELOCITY, _ACCELERATION, _ERRORS, _ARM = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    (slice(9, 12), slice(12, 15)),
    slice(15, 18),
)
SIZE = 18
_EYE = np.eye(SIZE)

_Vector = Float[np.ndarray, "models 18"]
_Matrix = Float[np.ndarray, "models 18 18"]
#: Mean and covariance.
State = tuple[_Vector, _Matrix]


@dataclass(frozen=True)
class Readings:
    """What two sources say of one drone: the inside (index 0) and the outside (1).

    Attributes:
        time_s: (frames,), increasing.
        position_m: (frames, 2, 3), world.
        covariance_m2: (frames, 2, 3, 3), as the sources state them; numbers everywhere.
        known: (frames, 2), where a source says something.
        ahead_s: (frames, 2), by how much the reading is of a later time than the frame.
        lever: (frames, 2, 3, 3), what a reading is off the fused point, per arm: a rotation, its negative, or 0.
        added_m2: (frames, 2, 3, 3), covariance that comes on top, whatever the scales: of an arm that is turned by
            nobody knows what, or of a reading that is not to count in full.
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
    """How the sources err, and how quickly the drone changes its acceleration. Several models at once, or one.

    Attributes:
        white: (models, 2), variance that is new in every frame, per stated variance.
        lasting: (models, 2), variance of the error that lasts, likewise.
        time_s: (models, 2), after which 1 / e of that error is left.
        jerk_density_m2_s5: (models,), of the white jerk along each axis.
    """

    white: Float[np.ndarray, "models 2"]
    lasting: Float[np.ndarray, "models 2"]
    time_s: Float[np.ndarray, "models 2"]
    jerk_density_m2_s5: Float[np.ndarray, "models"]


@dataclass(frozen=True)
class Arm:
    """What is known of the arm beforehand: its mean (3,), metres, and its standard deviation along each axis."""

    mean_m: Float[np.ndarray, "3"]
    std_m: float


@dataclass(frozen=True)
class Joint:
    """The drone from all readings, of the frames before and after each.

    Attributes:
        position_m, velocity_m_s: (frames, 3), world.
        covariance_m2: (frames, 3, 3), of the position.
        arm_m, arm_covariance_m2: (3,), (3, 3), of the arm.
    """

    position_m: Float[np.ndarray, "frames 3"]
    velocity_m_s: Float[np.ndarray, "frames 3"]
    covariance_m2: Float[np.ndarray, "frames 3 3"]
    arm_m: Float[np.ndarray, "3"]
    arm_covariance_m2: Float[np.ndarray, "3 3"]


def log_likelihood(readings: Readings, model: ErrorModel, arm: Arm) -> Float[np.ndarray, "models"]:
    """(models,), logarithm of the density of all readings under each model."""
    total = np.zeros(len(model.white))
    for step in _forward(readings, model, arm):
        total += step.log_density
    return total


def smooth(readings: Readings, model: ErrorModel, arm: Arm) -> Joint:
    """The best estimate of every frame from all readings, under one model."""
    steps = list(_forward(readings, model, arm))
    F, Q, mean, spread, mean_before, spread_before = (
        np.stack([getattr(step, name)[0] for step in steps])
        for name in ("F", "Q", "mean", "spread", "mean_before", "spread_before")
    )
    # P F^T P_ahead^-1, in units of standard deviations, so that metres and m/s2 count alike.
    unit = np.sqrt(np.diagonal(spread_before[1:], axis1=1, axis2=2))
    ahead = spread_before[1:] / (unit[:, :, None] * unit[:, None, :])
    gain = np.linalg.solve(ahead, (F[1:] @ spread[:-1]) / unit[:, :, None]).swapaxes(1, 2) / unit[:, None, :]
    kept = np.eye(SIZE) - gain @ F[1:]
    for k in range(len(steps) - 2, -1, -1):
        mean[k] += gain[k] @ (mean[k + 1] - mean_before[k + 1])
        # A sum, where P + G (P_later - P_ahead) G^T would be a difference and negative after many frames.
        later = gain[k] @ (Q[k + 1] + spread[k + 1]) @ gain[k].T
        spread[k] = _symmetric(kept[k] @ spread[k] @ kept[k].T + later)
    return Joint(
        position_m=mean[:, _POSITION],
        velocity_m_s=mean[:, _VELOCITY],
        covariance_m2=spread[:, _POSITION, _POSITION],
        arm_m=mean[0, _ARM],
        arm_covariance_m2=spread[0, _ARM, _ARM],
    )


@dataclass(frozen=True)
class _Step:
    """One frame of the forward pass: how it was reached, the state before and after its readings, their density."""

    F: _Matrix
    Q: _Matrix
    mean_before: _Vector
    spread_before: _Matrix
    mean: _Vector
    spread: _Matrix
    log_density: Float[np.ndarray, "models"]


def _forward(readings: Readings, model: ErrorModel, arm: Arm) -> Iterator[_Step]:
    roots = roots_of(readings)
    first = int(np.argmax(readings.known.any(axis=1)))
    state = start(readings, model, arm, first)
    for k, (F, Q) in enumerate(transitions(readings.time_s, model)):
        before = predicted(state, F, Q)
        log_density = np.zeros(len(model.white))
        state = before
        if readings.known[k].any():
            parts = observation(readings, model, roots, k, np.flatnonzero(readings.known[k]))
            state, log_density = updated(before, *parts)
        yield _Step(F, Q, *before, *state, log_density)


def start(readings: Readings, model: ErrorModel, arm: Arm, first: int | np.integer) -> State:
    """At rest about the first reading, and hardly known."""
    models = len(model.white)
    source = int(np.argmax(readings.known[first]))
    mean = np.zeros((models, SIZE))
    mean[:, _POSITION] = readings.position_m[first, source] - readings.lever[first, source] @ arm.mean_m
    mean[:, _ARM] = arm.mean_m
    std = np.repeat([_START_M, _START_M_S, _START_M_S2, 1.0, 1.0, arm.std_m], 3)
    return mean, np.broadcast_to(np.diag(std**2), (models, SIZE, SIZE)).copy()


def transition(dt_s: float, model: ErrorModel) -> tuple[_Matrix, _Matrix]:
    """F and Q over `dt_s`; errors that last have unit variance, and readings scale them."""
    models = len(model.white)
    left = np.exp(-dt_s / model.time_s)
    F = np.tile(np.eye(SIZE), (models, 1, 1))
    F[:, _POSITION, _VELOCITY] = F[:, _VELOCITY, _ACCELERATION] = dt_s * np.eye(3)
    F[:, _POSITION, _ACCELERATION] = dt_s**2 / 2 * np.eye(3)
    Q = np.zeros_like(F)
    reached = np.array([dt_s**5 / 20, dt_s**4 / 8, dt_s**3 / 6, dt_s**3 / 3, dt_s**2 / 2, dt_s])
    jerk = np.kron(reached[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]], np.eye(3))
    Q[:, :9, :9] = model.jerk_density_m2_s5[:, None, None] * jerk
    for source, block in enumerate(_ERRORS):
        F[:, block, block] = left[:, source, None, None] * np.eye(3)
        Q[:, block, block] = (1 - left[:, source, None, None] ** 2) * np.eye(3)
    return F, Q


def transitions(time_s: Float[np.ndarray, "frames"], model: ErrorModel) -> Iterator[tuple[_Matrix, _Matrix]]:
    """`transition` to each frame from the one before; nearly all are alike, and made once."""
    made: dict[float, tuple[_Matrix, _Matrix]] = {}
    for dt_s in np.round(np.diff(time_s, prepend=time_s[:1]), 9).tolist():
        if dt_s not in made:
            made[dt_s] = transition(dt_s, model)
        yield made[dt_s]


def predicted(state: State, F: _Matrix, Q: _Matrix) -> State:
    """The state after a transition."""
    mean, spread = state
    return (F @ mean[..., None])[..., 0], F @ spread @ F.swapaxes(1, 2) + Q


def observation(
    readings: Readings,
    model: ErrorModel,
    roots: Float[np.ndarray, "frames 2 3 3"],
    k: int | np.integer,
    sources: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """H (models, 3 n, 18), y (3 n,) and R (models, 3 n, 3 n) of n sources in frame k."""
    models = len(model.white)
    H = np.zeros((models, 3 * len(sources), SIZE))
    R = np.zeros((models, 3 * len(sources), 3 * len(sources)))
    for row, source in enumerate(sources):
        rows, ahead_s = slice(3 * row, 3 * row + 3), readings.ahead_s[k, source]
        H[:, rows, _POSITION] = _EYE[:3, :3]
        H[:, rows, _VELOCITY] = ahead_s * _EYE[:3, :3]
        H[:, rows, _ACCELERATION] = ahead_s**2 / 2 * _EYE[:3, :3]
        H[:, rows, _ERRORS[source]] = np.sqrt(model.lasting[:, source, None, None]) * roots[k, source]
        H[:, rows, _ARM] = readings.lever[k, source]
        white = model.white[:, source, None, None]
        R[:, rows, rows] = white * readings.covariance_m2[k, source] + readings.added_m2[k, source]
    return H, readings.position_m[k, sources].ravel(), R


def updated(
    state: State, H: np.ndarray, y: np.ndarray, R: np.ndarray
) -> tuple[State, Float[np.ndarray, "models"]]:
    """The corrected state, and the logarithm of the density with which it was expected."""
    mean, spread = state
    PHt = spread @ H.swapaxes(1, 2)
    S = H @ PHt + R
    innovation = y - (H @ mean[..., None])[..., 0]
    precision = np.linalg.inv(S)
    K = PHt @ precision
    correction = (K @ innovation[..., None])[..., 0]
    kept = _EYE - K @ H
    after = kept @ spread @ kept.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
    misfit = (innovation * (precision @ innovation[..., None])[..., 0]).sum(axis=1)
    log_density = -(misfit + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
    return (mean + correction, _symmetric(after)), log_density


def rows_of(readings: Readings, rows: slice) -> Readings:
    """The readings of some frames."""
    return Readings(**{name: value[rows] for name, value in vars(readings).items()})


def roots_of(readings: Readings) -> Float[np.ndarray, "frames 2 3 3"]:
    """Symmetric square roots of the stated covariances."""
    variance, axes = np.linalg.eigh(readings.covariance_m2)
    return np.einsum("...ij,...j,...kj->...ik", axes, np.sqrt(np.maximum(variance, 0.0)), axes)


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return (matrix + matrix.swapaxes(-1, -2)) / 2
