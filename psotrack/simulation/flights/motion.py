"""Flights: positions with derivatives at any time, and the attitudes that follow from the acceleration.

The thrust of a multirotor acts along its body's z axis only, so this axis points along a + g (Mellinger and Kumar,
"Minimum snap trajectory generation and control for quadrotors", 2011; drag is neglected). The heading is free.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

GRAVITY_M_S2 = 9.81

Times = Float[np.ndarray, "times"]
Vectors = Float[np.ndarray, "times 3"]


@dataclass(frozen=True)
class Heading:
    """Heading of a drone over time: `yaw + sway sin(angular t + phase)`, radians and rad/s."""

    yaw_rad: float = 0.0
    sway_rad: float = 0.0
    angular_rad_s: float = 1.0
    phase_rad: float = 0.0

    def at(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
        """(times,), heading at each time, radians."""
        return self.yaw_rad + self.sway_rad * np.sin(self.angular_rad_s * time_s + self.phase_rad)


def attitude(
    thrust_m_s2: Float[np.ndarray, "times 3"], yaw_rad: Float[np.ndarray, "times"]
) -> Float[np.ndarray, "times 3 3"]:
    """(times, 3, 3), body to world: z along the thrust, x as near to the heading as possible."""
    body_z = thrust_m_s2 / np.linalg.norm(thrust_m_s2, axis=-1, keepdims=True)
    ahead = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)
    body_y = np.cross(body_z, ahead)
    body_y /= np.linalg.norm(body_y, axis=-1, keepdims=True)
    return np.stack([np.cross(body_y, body_z), body_y, body_z], axis=-1)


def quaternions_wxyz(rotation: Float[np.ndarray, "times 3 3"]) -> Float[np.ndarray, "times 4"]:
    """(times, 4), unit quaternions, scalar first; their signs do not change from one time to the next."""
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    # `np.sign` would be 0 after half a turn.
    flips = np.where((wxyz[1:] * wxyz[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    return wxyz * np.cumprod(np.concatenate([[1.0], flips]))[:, None]


class Flight(ABC):
    """A twice differentiable position over time, with a heading.

    Attributes:
        heading: direction of the drone's x axis, seen from above.
    """

    heading: Heading

    @abstractmethod
    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), derivative of the position: 0 is the position itself, 1 the velocity, 2 the acceleration."""

    def position_m(self, time_s: Times) -> Vectors:
        """(times, 3), world, metres."""
        return self.derivative(time_s, 0)

    def velocity_m_s(self, time_s: Times) -> Vectors:
        """(times, 3), world."""
        return self.derivative(time_s, 1)

    def acceleration_m_s2(self, time_s: Times) -> Vectors:
        """(times, 3), world, gravity not included."""
        return self.derivative(time_s, 2)

    def rotation(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """(times, 3, 3), body to world: z along a + g, x as near to the heading as possible."""
        thrust_m_s2 = self.acceleration_m_s2(time_s) + np.array([0.0, 0.0, GRAVITY_M_S2])
        return attitude(thrust_m_s2, self.heading.at(time_s))

    def orientation_wxyz(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 4"]:
        """(times, 4), unit quaternions, body to world; their signs do not change from one time to the next."""
        return quaternions_wxyz(self.rotation(time_s))
