"""Flights: positions with derivatives at any time, and the attitudes that follow from the acceleration.

The thrust of a multirotor acts along its body's z axis only, so this axis points along a + g (Mellinger and Kumar,
"Minimum snap trajectory generation and control for quadrotors", 2011; drag is neglected). The heading is free.
Flights from formulas (harmonics, relative and delayed flights, waypoints) have exact derivatives.
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

    def tilt_deg(self, time_s: Times) -> Float[np.ndarray, "times"]:
        """(times,), angle between the body's z axis and the vertical, degrees."""
        return np.degrees(np.arccos(np.clip(self.rotation(time_s)[:, 2, 2], -1, 1)))

    def orientation_wxyz(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 4"]:
        """(times, 4), unit quaternions, body to world; their signs do not change from one time to the next."""
        return quaternions_wxyz(self.rotation(time_s))


@dataclass(frozen=True)
class HarmonicFlight(Flight):
    """A flight that is a sum of sinusoids about a centre.

    Attributes:
        centre_m: (3,), centre, world.
        amplitude_m: (harmonics, 3), amplitudes along each axis.
        angular_rad_s: (harmonics,), angular frequencies.
        phase_rad: (harmonics, 3), phases at time 0.
        heading: heading of the drone.
    """

    centre_m: Float[np.ndarray, "3"]
    amplitude_m: Float[np.ndarray, "harmonics 3"]
    angular_rad_s: Float[np.ndarray, "harmonics"]
    phase_rad: Float[np.ndarray, "harmonics 3"]
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3); the n-th derivative of a sine is the sine with n quarter turns added to its angle."""
        w = self.angular_rad_s[:, None]
        angle = w * time_s[:, None, None] + self.phase_rad + order * np.pi / 2
        moved_m = (self.amplitude_m * w**order * np.sin(angle)).sum(axis=1)
        return moved_m if order else self.centre_m + moved_m


@dataclass(frozen=True)
class RelativeFlight(Flight):
    """A flight relative to another flight: the sum of the other flight and an offset.

    Attributes:
        other: flight of the other drone.
        offset: offset from the other drone over time, world axes; its heading is not used.
        heading: heading of the drone.
    """

    other: Flight
    offset: Flight
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), sum of both derivatives."""
        return self.other.derivative(time_s, order) + self.offset.derivative(time_s, order)


@dataclass(frozen=True)
class DelayedFlight(Flight):
    """The flight of another drone with a delay.

    Attributes:
        leader: flight of the other drone; its formula also holds before time 0.
        delay_s: the delay.
        heading: heading of the drone.
    """

    leader: Flight
    delay_s: float
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), derivative of the leader at an earlier time."""
        return self.leader.derivative(time_s - self.delay_s, order)


#: Share of the distance after a share t of the time, for the motion with minimum jerk from rest to rest, and its two
#: derivatives: 10 t^3 - 15 t^4 + 6 t^5 (Flash and Hogan, "The coordination of arm movements", 1985).
_MINIMUM_JERK = tuple(np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]).deriv(n) for n in (0, 1, 2))


@dataclass(frozen=True)
class WaypointFlight(Flight):
    """A flight around a closed loop of points, with a stop at each point and minimum jerk between the points.

    Attributes:
        points_m: (points, 3), world; the first point follows the last.
        moving_s: (points,), times of the motion from each point to the next.
        hover_s: time that the drone stands still at each point before it moves.
        heading: heading of the drone.
    """

    points_m: Float[np.ndarray, "points 3"]
    moving_s: Float[np.ndarray, "points"]
    hover_s: float
    heading: Heading

    def derivative(self, time_s: Times, order: int) -> Vectors:
        """(times, 3), derivative of the motion along the leg of each time."""
        ends_s = np.cumsum(self.moving_s + self.hover_s)
        loop_s = time_s % ends_s[-1]
        # Rounding can place the end of the loop after the last leg.
        leg = np.minimum(np.searchsorted(ends_s, loop_s, side="right"), len(ends_s) - 1)
        moving_s = self.moving_s[leg]
        share = np.clip((loop_s - ends_s[leg]) / moving_s + 1, 0, 1)
        leg_m = (np.roll(self.points_m, -1, axis=0) - self.points_m)[leg]
        moved = (_MINIMUM_JERK[order](share) / moving_s**order)[:, None] * leg_m
        return self.points_m[leg] + moved if order == 0 else moved
