"""Flights from formulas with exact derivatives: harmonics, relative and delayed flights, and waypoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.simulation.flights.motion import Flight, Heading, Times, Vectors


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
