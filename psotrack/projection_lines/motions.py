"""The motion model, for as many tracks as there is room for, in float64."""

from __future__ import annotations

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack._typing import Array
from psotrack.motion import MotionParams, MotionState, kalman
from psotrack.settings import TrackSettings
from psotrack.tracking import motion_params

#: The arrays have room for a multiple of so many tracks: each length is compiled.
ROOM = 16


class Motions:
    """How tracks move, each in a slot of the motion model's arrays.

    Attributes:
        state: on the host, of all slots.
    """

    def __init__(self, settings: TrackSettings, fps: float, bounds_m: Float[np.ndarray, "2 3"]) -> None:
        self._settings = settings
        self._dt_s = 1 / fps
        self._limits = (self._dt_s, bounds_m, settings.max_speed_m_s)
        self._params = _params(settings, 0)
        self.state = _nobody(0, self._params)

    def __len__(self) -> int:
        return len(self.state.position_m)

    def grow(self) -> None:
        """Make room for more tracks."""
        self._params = _params(self._settings, len(self) + ROOM)
        more = _nobody(ROOM, _params(self._settings, ROOM))
        self.state = _on_host(jax.tree.map(lambda *both: np.concatenate(both), self.state, more))

    def place(
        self,
        slot: int,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        covariance_m2: Float[np.ndarray, "3 3"],
        velocity_std_m_s: float,
    ) -> None:
        """Let the motion of a track begin here."""
        params = replace(_params(self._settings, 1), velocity_std_m_s=jnp.float64(velocity_std_m_s))
        begun = kalman.init(position_m[None], velocity_m_s[None], covariance_m2[None], params)
        for each in fields(MotionState):
            getattr(self.state, each.name)[slot] = np.asarray(getattr(begun, each.name))[0]

    def predict(self) -> None:
        """To the next frame."""
        self.state = _on_host(_predict(self.state, self._dt_s, self._params))

    def correct(
        self,
        measured_m: Float[np.ndarray, "slots 3"],
        covariance_m2: Float[np.ndarray, "slots 3 3"],
        was_measured: Bool[np.ndarray, "slots"],
        lost: Bool[np.ndarray, "slots"],
    ) -> None:
        """By what was measured; all stay in the room and as fast as drones are, and what is lost is at rest."""
        self.state = _on_host(
            _correct(self.state, measured_m, covariance_m2, was_measured, lost, *self._limits, self._params)
        )


def _params(settings: TrackSettings, room: int) -> MotionParams:
    return jax.tree.map(lambda value: np.asarray(value, np.float64), motion_params(settings, room))


def _nobody(room: int, params: MotionParams) -> MotionState:
    none = np.zeros((room, 3))
    return _on_host(kalman.init(none, none, np.tile(np.eye(3), (room, 1, 1)), params))


def _on_host(state: MotionState) -> MotionState:
    """The state in arrays of its own."""
    return jax.tree.map(np.array, state)


@jax.jit
def _predict(state: MotionState, dt_s: Float[Array, ""], params: MotionParams) -> MotionState:
    return kalman.predict(state, dt_s, params)


@jax.jit
def _correct(
    state: MotionState,
    measured_m: Float[Array, "drones 3"],
    covariance_m2: Float[Array, "drones 3 3"],
    was_measured: Bool[Array, "drones"],
    lost: Bool[Array, "drones"],
    dt_s: Float[Array, ""],
    bounds_m: Float[Array, "2 3"],
    max_speed_m_s: Float[Array, ""],
    params: MotionParams,
) -> MotionState:
    state, _ = kalman.update(state, measured_m, covariance_m2, was_measured, params)
    limits = {"dt_s": dt_s, "bounds_m": bounds_m, "max_speed_m_s": max_speed_m_s}
    return kalman.limit_motion(state, ~was_measured, lost, **limits)
