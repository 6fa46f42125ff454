"""Flying by hand: from stick samples, by the dynamics of a drone and its autopilot, to a recorded flight.

The flight depends only on the samples and their times, so the same samples give the same flight again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError, check_positive
from psotrack.simulation.flights.motion import GRAVITY_M_S2, attitude
from psotrack.simulation.flights.recordings import MIN_SAMPLES, Recorded
from psotrack.simulation.world.halls import HALLS
from psotrack.support import Column, TextRow, read_table, write_rows

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


#: Smallest number of integration steps per second: several steps in each time constant of the dynamics.
_MIN_STEPS_HZ = 250.0
#: Rounding error of sample times, which come from divisions and clocks, as a share of a step.
_ROUNDING = 1e-6

_HEADER = ("time_s", *Sticks._fields)


class Sample(NamedTuple):
    """Stick positions from a time on, until the next sample."""

    time_s: float
    sticks: Sticks


def fly(
    samples: Iterable[Sample],
    start_m: Vector,
    space: Space,
    *,
    dynamics: Dynamics = DYNAMICS,
    rate_hz: float = 25.0,
    max_s: float = np.inf,
    watch: Callable[[float, FlightState], None] = lambda time_s, state: None,
) -> tuple[Recorded, tuple[Sample, ...]]:
    """Simulate a flight that stick samples control, from hovering until the time of the last sample.

    Args:
        samples: samples of the sticks, with times that increase from 0; the iterator may wait for a person.
        start_m: (3,), position at time 0, where the drone hovers.
        space: space that the drone stays in.
        dynamics: dynamics of the drone.
        rate_hz: rate of the recorded flight; its times are exactly k / rate_hz.
        max_s: longest duration of the flight.
        watch: function that is called with the time of each sample and the state at that time.

    Returns:
        The recorded flight, and the samples of the sticks that made it.

    Raises:
        SettingsError: the start is outside the space, the rate is not above 0, the samples' times do not increase, or
            the flight is too short to be replayed.
    """
    check_positive("rate", rate_hz)
    if not np.all((start_m >= space.lower_m) & (start_m <= space.upper_m)):
        lower, upper, start = (
            ", ".join(f"{value:g}" for value in point) for point in (space.lower_m, space.upper_m, start_m)
        )
        raise SettingsError("start", expected=f"a point from ({lower}) to ({upper})", found=f"({start})")
    per_record = int(np.ceil(_MIN_STEPS_HZ / rate_hz))
    step_s = 1 / (rate_hz * per_record)
    state, sticks, done = FlightState.hovering(start_m), Sticks(), 0
    records: list[FlightState] = [state]
    used: list[Sample] = []
    for sample in samples:
        if used and sample.time_s <= used[-1].time_s:
            raise SettingsError(
                "sticks", expected=f"a time after {used[-1].time_s:g} s", found=f"{sample.time_s:g} s"
            )
        if sample.time_s >= max_s:
            sample = Sample(max_s, sticks)
        used.append(sample)
        due = int(sample.time_s / step_s + _ROUNDING)
        while done < due:
            state = step(state, sticks, dynamics, space, step_s)
            done += 1
            if done % per_record == 0:
                records.append(state)
        sticks = sample.sticks
        watch(sample.time_s, state)
        if sample.time_s == max_s:
            break
    return _recorded(records, rate_hz), tuple(used)


def _recorded(states: list[FlightState], rate_hz: float) -> Recorded:
    if len(states) < MIN_SAMPLES:
        raise SettingsError("flight", expected=f"at least {MIN_SAMPLES} samples", found=f"{len(states)}")
    thrust = np.array([state.push_m_s2 for state in states]) + np.array([0.0, 0.0, GRAVITY_M_S2])
    rotation = attitude(thrust, np.array([state.yaw_rad for state in states]))
    return Recorded(
        np.arange(len(states)) / rate_hz,
        np.array([state.position_m for state in states]),
        Rotation.from_matrix(rotation).as_quat(scalar_first=True),
    )


# --- files


def read_sticks(path: Path) -> tuple[Sample, ...]:
    """Read stick samples: `time_s,forward,left,up,turn`, positions from -1 to 1 that hold until the next row.

    Raises:
        InputError: the file cannot be read, a column is missing, the times do not increase from 0, or a stick position
            is not from -1 to 1. The message names file, line and column.
    """
    table = read_table(path, ",")
    time_column, *stick_columns = (table.column(name) for name in _HEADER)
    samples: list[Sample] = []
    for row in table.rows:
        time_s = row.number(time_column)
        if time_s < 0 or (samples and time_s <= samples[-1].time_s):
            expected = f"a time above {samples[-1].time_s:g}" if samples else "a time of 0 or more"
            raise row.error(time_column, expected, row.text(time_column))
        samples.append(Sample(time_s, Sticks(*(_stick(row, column) for column in stick_columns))))
    return tuple(samples)


def write_sticks(path: Path, samples: Iterable[Sample]) -> None:
    """Write stick samples in the format of `read_sticks`, with all digits, so that they give the same flight again.

    Raises:
        OutputError: the file cannot be written.
    """
    write_rows(path, [_HEADER, *((sample.time_s, *sample.sticks) for sample in samples)], ",")


def _stick(row: TextRow, column: Column) -> float:
    value = row.number(column)
    if abs(value) > 1:
        raise row.error(column, "a number from -1 to 1", row.text(column))
    return value
