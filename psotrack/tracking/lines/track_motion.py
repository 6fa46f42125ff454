"""The motion model of all tracks in float64, in arrays that have room for more tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack.settings import MotionSettings
from psotrack.support.array_types import Array
from psotrack.tracking.births import FlightLimits
from psotrack.tracking.matching import Measurement
from psotrack.tracking.motion import MotionParams, MotionState, kalman, motion_params

#: The arrays' length is a multiple of this number: each length is compiled once.
ROOM = 16


class TrackMotion:
    """Motion states of the tracks, each in a slot of the arrays.

    Attributes:
        state: states of all slots, on the host.
    """

    def __init__(self, settings: MotionSettings, limits: FlightLimits) -> None:
        self._settings = settings
        self._limits = {
            "dt_s": np.array(1 / limits.fps),
            "bounds_m": limits.bounds_m,
            "max_speed_m_s": np.array(limits.max_speed_m_s),
        }
        self._params = _params(settings, 0)
        self.state = _states_at_origin(0, self._params)

    def __len__(self) -> int:
        return len(self.state.position_m)

    def grow(self) -> None:
        """Make room for more tracks."""
        self._params = _params(self._settings, len(self) + ROOM)
        more = _states_at_origin(ROOM, _params(self._settings, ROOM))
        self.state = _on_host(jax.tree.map(lambda *both: np.concatenate(both), self.state, more))

    def place(
        self,
        slot: int,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        covariance_m2: Float[np.ndarray, "3 3"],
        velocity_std_m_s: float,
    ) -> None:
        """Start the motion of a track, or start it anew."""
        params = replace(_params(self._settings, 1), velocity_std_m_s=jnp.float64(velocity_std_m_s))
        self.put(slot, kalman.init(position_m[None], velocity_m_s[None], covariance_m2[None], params))

    def put(self, slot: int, first: MotionState) -> None:
        """Put the first of some states into a slot."""
        for each in fields(MotionState):
            getattr(self.state, each.name)[slot] = getattr(first, each.name)[0]

    def predict(self) -> None:
        """Go on to the next frame."""
        self.state = _on_host(_predict(self.state, self._limits["dt_s"], self._params))

    def correct(self, measured: dict[int, Measurement], seen_by_one: Sequence[int] = ()) -> None:
        """Correct by the measured positions, within the room and the largest speed.

        Args:
            measured: measurements by slot.
            seen_by_one: slots of tracks that one camera alone sees.
        """
        measured_m, covariance_m2 = np.zeros((len(self), 3)), np.tile(np.eye(3), (len(self), 1, 1))
        was_measured = np.zeros(len(self), bool)
        for slot, one in measured.items():
            measured_m[slot], covariance_m2[slot] = one.position_m, one.covariance_m2
        was_measured[[*measured]] = True
        unseen = ~was_measured
        unseen[list(seen_by_one)] = False
        # A lost track has no place until it begins again.
        limits = {"unseen": unseen, "lost": np.zeros_like(unseen), **self._limits}
        measurements = (measured_m, covariance_m2, was_measured)
        self.state = _on_host(_correct(self.state, measurements, limits, self._params))

    def correct_in_image(
        self,
        slot: int,
        jacobian: Float[np.ndarray, "2 3"],
        off_px: Float[np.ndarray, "2"],
        noise_px: float,
    ) -> None:
        """Correct a track by a detection of one camera: an extended Kalman filter's update in the image.

        Args:
            slot: the track's slot.
            jacobian: (2, 3), derivative of the drone's pixel by the apparent position, pixels per metre.
            off_px: (2,), detection minus expected pixel.
            noise_px: standard deviation of the detection along each axis; the part that lasts is in the state.
        """
        state, covariance = self.state, np.asarray(self.state.covariance[slot])
        observed = np.zeros((2, covariance.shape[-1]))
        observed[:, :3] = jacobian
        noise_px2 = (1 - self._settings.error_share) * noise_px**2 * np.eye(2)
        spread = observed @ covariance @ observed.T + noise_px2
        gain = np.linalg.solve(spread, observed @ covariance).T
        rest = np.eye(len(covariance)) - gain @ observed
        after = rest @ covariance @ rest.T + gain @ noise_px2 @ gain.T
        moved = np.asarray(state.mean[slot]) + gain @ off_px
        self.put(slot, kalman.state_from_mean(moved[None], after[None], state.noise_m2[[slot]]))


def _params(settings: MotionSettings, room: int) -> MotionParams:
    return jax.tree.map(lambda value: np.asarray(value, np.float64), motion_params(settings, room))


def _states_at_origin(room: int, params: MotionParams) -> MotionState:
    zero = np.zeros((room, 3))
    return _on_host(kalman.init(zero, zero, np.tile(np.eye(3), (room, 1, 1)), params))


def _on_host(state: MotionState) -> MotionState:
    """The state in NumPy arrays of its own."""
    return jax.tree.map(np.array, state)


_predict = jax.jit(kalman.predict)


@jax.jit
def _correct(
    state: MotionState,
    measurements: tuple[Float[Array, "drones 3"], Float[Array, "drones 3 3"], Bool[Array, "drones"]],
    limits: dict[str, Array],
    params: MotionParams,
) -> MotionState:
    state, _ = kalman.update(state, *measurements, params)
    return kalman.limit_motion(state, **limits)
