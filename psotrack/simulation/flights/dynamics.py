"""Dynamics of a drone that is flown by hand: from stick positions to velocity commands, thrust and motion.

The autopilot commands the acceleration that reaches the commanded velocity in a given time, within the limits of tilt
and climb. The thrust follows with a first-order lag of attitude and rotors, drag is linear, and the motion is
integrated with a fixed step (semi-implicit Euler). Near walls and floor the autopilot brakes with the exponential
control barrier of Nguyen and Sreenath ("Exponential control barrier functions for enforcing high relative-degree
safety-critical constraints", American Control Conference, 2016), so that the limits also hold there. A hard stop at the
walls remains for cases that the barrier does not cover.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.simulation.flights.motion import GRAVITY_M_S2
from psotrack.simulation.world.halls import HALLS

#: Smallest distance from a wall to the body origin: half the size of a drone with rotors.
_CLEARANCE_M = 0.4
#: Height of the body origin of a drone that stands on the floor.
_ON_FLOOR_M = 0.15

Vector = Float[np.ndarray, "3"]


class Sticks(NamedTuple):
    """Positions of the sticks, each from -1 to 1, in the drone's own directions."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True)
class Dynamics:
    """Parameters of a drone and its autopilot.

    Attributes:
        max_speed_m_s: largest horizontal speed.
        max_climb_m_s: largest vertical speed, up or down.
        max_turn_rad_s: largest rate of the heading.
        max_tilt_deg: largest angle between the thrust and the vertical.
        max_climb_m_s2: largest vertical acceleration by the thrust, without gravity.
        response_s: time in which the autopilot tries to reach the commanded velocity.
        lag_s: time constant of attitude, thrust and turning.
        drag_per_s: deceleration by drag, divided by the speed.
        braking_per_s: strength of braking near walls; braking from a speed v begins at the distance
            2 v / braking_per_s.
    """

    max_speed_m_s: float = 2.5
    max_climb_m_s: float = 1.2
    max_turn_rad_s: float = 1.5
    max_tilt_deg: float = 20.0
    max_climb_m_s2: float = 2.5
    response_s: float = 0.5
    lag_s: float = 0.1
    drag_per_s: float = 0.2
    braking_per_s: float = 3.0


#: Dynamics of a small drone in a hall.
DYNAMICS = Dynamics()


@dataclass(frozen=True)
class Space:
    """Box that the body origin stays in.

    Attributes:
        lower_m: (3,), lower corner, world.
        upper_m: (3,), upper corner, world.
    """

    lower_m: Vector
    upper_m: Vector


def flight_space(hall: str) -> Space:
    """Space in which a drone touches neither floor nor walls nor ceiling of a hall; furniture is ignored.

    Raises:
        SettingsError: no hall has this name.
    """
    if hall not in HALLS:
        raise SettingsError("hall", expected=f"one of {', '.join(HALLS)}", found=hall)
    length_m, width_m, height_m = HALLS[hall].size_m
    x_m, y_m = length_m / 2 - _CLEARANCE_M, width_m / 2 - _CLEARANCE_M
    return Space(np.array([-x_m, -y_m, _ON_FLOOR_M]), np.array([x_m, y_m, height_m - _CLEARANCE_M]))


@dataclass(frozen=True)
class FlightState:
    """State of a drone in flight.

    Attributes:
        position_m: (3,), world.
        velocity_m_s: (3,), world.
        push_m_s2: (3,), thrust divided by mass, without the part that carries the weight.
        yaw_rad: heading.
        turn_rad_s: rate of the heading, positive to the left.
    """

    position_m: Vector
    velocity_m_s: Vector
    push_m_s2: Vector
    yaw_rad: float = 0.0
    turn_rad_s: float = 0.0

    @classmethod
    def hovering(cls, position_m: Vector) -> FlightState:
        """State of a drone at rest that points along x."""
        return cls(position_m, np.zeros(3), np.zeros(3))


def step(state: FlightState, sticks: Sticks, dynamics: Dynamics, space: Space, step_s: float) -> FlightState:
    """State after one step with constant stick positions."""
    x_m, v_m_s = state.position_m, state.velocity_m_s
    commanded_m_s = _commanded_velocity(sticks, state.yaw_rad, dynamics)
    # The thrust compensates the drag at the commanded velocity; otherwise the drone would not reach this velocity.
    # The thrust is limited already here, because the second limit would weaken the braking of a too large command.
    push = _limit_thrust(
        (commanded_m_s - v_m_s) / dynamics.response_s + dynamics.drag_per_s * commanded_m_s, dynamics
    )
    braking, drag = dynamics.braking_per_s, dynamics.drag_per_s * v_m_s
    push = np.clip(
        push,
        braking * (braking * (space.lower_m - x_m) - 2 * v_m_s) + drag,
        braking * (braking * (space.upper_m - x_m) - 2 * v_m_s) + drag,
    )
    follow = -np.expm1(-step_s / dynamics.lag_s)
    push = state.push_m_s2 + follow * (_limit_thrust(push, dynamics) - state.push_m_s2)
    turn = state.turn_rad_s + follow * (sticks.turn * dynamics.max_turn_rad_s - state.turn_rad_s)
    v_m_s = v_m_s + step_s * (push - dynamics.drag_per_s * v_m_s)
    x_m = x_m + step_s * v_m_s
    stopped_m = np.clip(x_m, space.lower_m, space.upper_m)
    v_m_s = np.where(stopped_m == x_m, v_m_s, 0.0)
    return FlightState(stopped_m, v_m_s, push, state.yaw_rad + step_s * turn, turn)


def _commanded_velocity(sticks: Sticks, yaw_rad: float, dynamics: Dynamics) -> Vector:
    # Forward and left at full deflection together are limited to the speed of one of them.
    level = dynamics.max_speed_m_s / max(1.0, float(np.hypot(sticks.forward, sticks.left)))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            level * (cos * sticks.forward - sin * sticks.left),
            level * (sin * sticks.forward + cos * sticks.left),
            dynamics.max_climb_m_s * sticks.up,
        ]
    )


def _limit_thrust(push_m_s2: Vector, dynamics: Dynamics) -> Vector:
    """Thrust within the limits that is nearest to a given thrust; the vertical part has priority.

    The possible thrusts are a convex set, so a mixture of two possible thrusts, as the lag makes, is possible too.
    """
    up = float(np.clip(push_m_s2[2], -dynamics.max_climb_m_s2, dynamics.max_climb_m_s2))
    level = float(np.hypot(push_m_s2[0], push_m_s2[1]))
    most = float(np.tan(np.radians(dynamics.max_tilt_deg))) * (GRAVITY_M_S2 + up)
    share = min(1.0, most / level) if level > 0 else 1.0
    return np.array([share * push_m_s2[0], share * push_m_s2[1], up])
