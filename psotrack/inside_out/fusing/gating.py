"""Gross errors of two sources of positions, detected by their differences and by the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaincinv

from psotrack.inside_out.fusing.joint_filter import (
    Arm,
    ErrorModel,
    Readings,
    State,
    covariance_roots,
    initial_state,
    iterate_transitions,
    observe,
    predict,
    select_frames,
    update,
)

#: Gate of squared normalised errors: chi-square with 3 degrees of freedom exceeds it with probability 1e-6.
GATE = 2.0 * float(gammaincinv(3 / 2, 1 - 1e-6))

_Observation = tuple[np.ndarray, np.ndarray, np.ndarray]


def gate_readings(
    readings: Readings, model: ErrorModel, arm: Arm
) -> tuple[Bool[np.ndarray, "frames 2"], Float[np.ndarray, "frames 2 3 3"]]:
    """Gross errors among readings, and covariances to add to single readings, under one error model.

    Where both sources have a reading and the two contradict each other, the reading that fits the motion less is left
    out. Two readings that agree are used, even if the motion model predicts another position. A single reading that
    does not fit the motion gets a larger covariance, with which it lies exactly at the gate: a drone that really
    jumped is followed, and a gross error has little effect.

    Gating begins where the two sources first agree, and goes from there to the end and to the beginning.

    Returns:
        (frames, 2), whether a reading is left out; (frames, 2, 3, 3), covariances to add, m².
    """
    first = _first_agreement(readings, model, arm)
    out = np.zeros(readings.known.shape, bool)
    added_m2 = np.zeros(readings.covariance_m2.shape)
    out[first:], added_m2[first:] = _gate_onwards(select_frames(readings, slice(first, None)), model, arm)
    if first:
        back = select_frames(readings, slice(first, None, -1))
        back = replace(back, time_s=-back.time_s, ahead_s=-back.ahead_s)
        out_back, added_back_m2 = _gate_onwards(back, model, arm)
        out[:first], added_m2[:first] = out_back[:0:-1], added_back_m2[:0:-1]
    return out, added_m2


def _gate_onwards(
    readings: Readings, model: ErrorModel, arm: Arm
) -> tuple[Bool[np.ndarray, "frames 2"], Float[np.ndarray, "frames 2 3 3"]]:
    roots = covariance_roots(readings)
    out = np.zeros(readings.known.shape, bool)
    added_m2 = np.zeros(readings.covariance_m2.shape)
    rows = np.flatnonzero(readings.known.any(axis=1))
    state = initial_state(readings, model, arm, rows[0])
    for k, (F, Q) in zip(rows, iterate_transitions(readings.time_s[rows], model), strict=True):
        state = predict(state, F, Q)
        sources = np.flatnonzero(readings.known[k])
        parts = [observe(readings, model, roots, k, sources[row : row + 1]) for row in range(len(sources))]
        misfits = [_misfit(state, part) for part in parts]
        best = int(np.argmin(misfits))
        after, _ = update(state, *parts[best])
        other = parts[1 - best] if len(parts) > 1 else None
        if other is not None and _misfit(after, other) <= GATE:
            state, _ = update(after, *other)
            continue
        if other is not None:
            out[k, sources[1 - best]] = True
        excess = misfits[best] / GATE
        if excess > 1:
            H, y, R = parts[best]
            added_m2[k, sources[best]] = (excess - 1) * (H @ state[1] @ H.swapaxes(1, 2) + R)[0]
            after, _ = update(state, H, y, R + added_m2[k, sources[best]])
        state = after
    return out, added_m2


def _first_agreement(readings: Readings, model: ErrorModel, arm: Arm) -> int:
    """The first frame in which both sources have readings that agree, else the first frame with any reading."""
    roots = covariance_roots(readings)
    for k in np.flatnonzero(readings.known.all(axis=1)):
        inside, outside = (observe(readings, model, roots, k, np.array([source])) for source in (0, 1))
        after, _ = update(initial_state(readings, model, arm, k), *inside)
        if _misfit(after, outside) <= GATE:
            return int(k)
    return int(np.argmax(readings.known.any(axis=1)))


def _misfit(state: State, one: _Observation) -> float:
    """Squared innovation of one source, normalised by its covariance; 3 is expected."""
    H, y, R = one
    mean, covariance = state
    innovation = y - H[0] @ mean[0]
    return float(innovation @ np.linalg.solve(H[0] @ covariance[0] @ H[0].T + R[0], innovation))
