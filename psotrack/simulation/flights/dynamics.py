"""How a drone flies by hand: sticks to wished-for velocities, those to thrust, thrust to motion.

The drone's autopilot asks for the acceleration that brings the wished-for velocity in a given time, within what tilt
and climb allow. The thrust follows with the lag of attitude and rotors (first order), linear drag works against it, and
all is integrated with a fixed step (semi-implicit Euler). Near walls and floor the autopilot brakes, by the exponential
control barrier of Nguyen and Sreenath ("Exponential control barrier functions for enforcing high relative-degree
safety-critical constraints", American Control Conference, 2016), so that limits hold there too; a hard stop is behind
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.simulation.flights.motion import GRAVITY_M_S2
from psotrack.simulation.world.halls import HALLS

#: From a wall to the body's origin: half of a drone, rotors included.
_CLEARANCE_M = 0.4
#: The height of the body's origin when it stands.
_ON_FLOOR_M = 0.15

Vector = Float[np.ndarray, "3"]


class Sticks(NamedTuple):
    """Where the sticks stand, each from -1 to 1; as the pilot on board sees it."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True)
class Dynamics:
    """A drone and its autopilot.

    Attributes:
        max_speed_m_s: level, in any direction.
        max_climb_m_s: up or down.
        max_turn_rad_s: of the heading, to the left above 0.
        max_tilt_deg: of the thrust against the vertical.
        max_climb_m_s2: of the thrust along the vertical, without gravity.
        response_s: in which the velocity loop wants to be where the sticks are.
        lag_s: time constant of attitude, thrust and turning.
        drag_per_s: deceleration over speed.
        braking_per_s: how hard it brakes before walls; from full speed it begins twice speed over this away from them.
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

    @property
    def max_acceleration_m_s2(self) -> float:
        """What no flight exceeds: full tilt at full thrust, with the drag of full speed."""
        level = np.tan(np.radians(self.max_tilt_deg)) * (GRAVITY_M_S2 + self.max_climb_m_s2)
        return float(
            np.hypot(
                level + self.drag_per_s * self.max_speed_m_s,
                self.max_climb_m_s2 + self.drag_per_s * self.max_climb_m_s,
            )
        )


#: A small drone in a hall.
DYNAMICS = Dynamics()


@dataclass(frozen=True)
class Space:
    """Where the body's origin may be: a box, (3,) each."""

    lower_m: Vector
    upper_m: Vector


def space_in(hall: str) -> Space:
    """What a drone can fly in without touching floor, walls or ceiling; furniture does not stop it.

    Raises:
        SettingsError: there is no such hall.
    """
    if hall not in HALLS:
        raise SettingsError("hall", expected=f"one of {', '.join(HALLS)}", found=hall)
    length_m, width_m, height_m = HALLS[hall].size_m
    x_m, y_m = length_m / 2 - _CLEARANCE_M, width_m / 2 - _CLEARANCE_M
    return Space(np.array([-x_m, -y_m, _ON_FLOOR_M]), np.array([x_m, y_m, height_m - _CLEARANCE_M]))


@dataclass(frozen=True)
class FlightState:
    """A drone in flight.

    Attributes:
        position_m, velocity_m_s: (3,), world.
        push_m_s2: (3,), thrust over mass, without what carries the weight.
        yaw_rad, turn_rad_s: heading and its rate.
    """

    position_m: Vector
    velocity_m_s: Vector
    push_m_s2: Vector
    yaw_rad: float = 0.0
    turn_rad_s: float = 0.0

    @classmethod
    def hovering(cls, position_m: Vector) -> FlightState:
        """At rest, looking along x."""
        return cls(position_m, np.zeros(3), np.zeros(3))


def step(state: FlightState, sticks: Sticks, dynamics: Dynamics, space: Space, step_s: float) -> FlightState:
    """The state one step later, the sticks as they are."""
    x_m, v_m_s = state.position_m, state.velocity_m_s
    wished_m_s = _wished_velocity(sticks, state.yaw_rad, dynamics)
    # Thrust against the drag of what is wished for: without it the speed would stay below.
    # Within limits already here: braking would shrink with a wish that is beyond them.
    push = _possible((wished_m_s - v_m_s) / dynamics.response_s + dynamics.drag_per_s * wished_m_s, dynamics)
    braking, drag = dynamics.braking_per_s, dynamics.drag_per_s * v_m_s
    push = np.clip(
        push,
        braking * (braking * (space.lower_m - x_m) - 2 * v_m_s) + drag,
        braking * (braking * (space.upper_m - x_m) - 2 * v_m_s) + drag,
    )
    follow = -np.expm1(-step_s / dynamics.lag_s)
    push = state.push_m_s2 + follow * (_possible(push, dynamics) - state.push_m_s2)
    turn = state.turn_rad_s + follow * (sticks.turn * dynamics.max_turn_rad_s - state.turn_rad_s)
    v_m_s = v_m_s + step_s * (push - dynamics.drag_per_s * v_m_s)
    x_m = x_m + step_s * v_m_s
    stopped_m = np.clip(x_m, space.lower_m, space.upper_m)
    v_m_s = np.where(stopped_m == x_m, v_m_s, 0.0)
    return FlightState(stopped_m, v_m_s, push, state.yaw_rad + step_s * turn, turn)


def _wished_velocity(sticks: Sticks, yaw_rad: float, dynamics: Dynamics) -> Vector:
    # Both sticks' axes at full would be faster than one.
    level = dynamics.max_speed_m_s / max(1.0, float(np.hypot(sticks.forward, sticks.left)))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            level * (cos * sticks.forward - sin * sticks.left),
            level * (sin * sticks.forward + cos * sticks.left),
            dynamics.max_climb_m_s * sticks.up,
        ]
    )


def _possible(push_m_s2: Vector, dynamics: Dynamics) -> Vector:
    """The nearest thrust within the limits; height comes first.

    These thrusts are a convex set, so that the lag, which mixes them, does not leave it either.
    """
    up = float(np.clip(push_m_s2[2], -dynamics.max_climb_m_s2, dynamics.max_climb_m_s2))
    level = float(np.hypot(push_m_s2[0], push_m_s2[1]))
    most = float(np.tan(np.radians(dynamics.max_tilt_deg))) * (GRAVITY_M_S2 + up)
    share = min(1.0, most / level) if level > 0 else 1.0
    return np.array([share * push_m_s2[0], share * push_m_s2[1], up])
