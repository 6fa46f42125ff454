"""Flying by hand: samples of sticks to a recording at a target rate.

All of it is a function of the samples and their times, so that who replays them flies the same flight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError, check_positive
from psotrack.simulation.flights.dynamics import DYNAMICS, Dynamics, FlightState, Space, Sticks, Vector, step
from psotrack.simulation.flights.motion import GRAVITY_M_S2, attitude
from psotrack.simulation.flights.recordings import Recorded
from psotrack.support import Column, TextRow, read_table, write_rows

#: Steps per second, at least: several in each time constant of the dynamics.
_MIN_STEPS_HZ = 250.0
#: Sticks' times come from divisions and clocks: so much of a step is rounding.
_ROUNDING = 1e-6

_HEADER = ("time_s", *Sticks._fields)


class Sample(NamedTuple):
    """The sticks at a time, which hold until the next."""

    time_s: float
    sticks: Sticks


@dataclass(frozen=True)
class Flown:
    """What was flown, and the sticks that did it."""

    recorded: Recorded
    samples: tuple[Sample, ...]


def fly(
    samples: Iterable[Sample],
    start_m: Vector,
    space: Space,
    *,
    dynamics: Dynamics = DYNAMICS,
    rate_hz: float = 25.0,
    watch: Callable[[float, FlightState], None] = lambda time_s, state: None,
) -> Flown:
    """Fly as the sticks say, from hovering, until the last sample's time.

    Args:
        samples: of the sticks, times increasing from 0; may wait for a person.
        start_m: (3,), where it hovers at time 0.
        space: what it stays in.
        dynamics: of the drone.
        rate_hz: of the recording, whose times are exactly k / rate_hz.
        watch: called with each sample's time and the state then.

    Raises:
        SettingsError: the start is outside of the space, the rate is not above 0, sticks' times do not increase, or
            the flight ended before there were enough samples for a `Recorded`.
    """
    check(start_m, space, rate_hz)
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
        used.append(sample)
        due = int(sample.time_s / step_s + _ROUNDING)
        while done < due:
            state = step(state, sticks, dynamics, space, step_s)
            done += 1
            if done % per_record == 0:
                records.append(state)
        sticks = sample.sticks
        watch(sample.time_s, state)
    return Flown(_recorded(records, rate_hz), tuple(used))


def check(start_m: Vector, space: Space, rate_hz: float) -> None:
    """Raise the `SettingsError` of `fly` that need not wait for a pilot."""
    check_positive("rate", rate_hz)
    if not np.all((start_m >= space.lower_m) & (start_m <= space.upper_m)):
        lower, upper, start = (
            ", ".join(f"{value:g}" for value in point) for point in (space.lower_m, space.upper_m, start_m)
        )
        raise SettingsError("start", expected=f"a point from ({lower}) to ({upper})", found=f"({start})")


def until(samples: Iterable[Sample], end_s: float) -> Iterator[Sample]:
    """The samples before a time, and a last one at it if there are later ones."""
    sticks = Sticks()
    for sample in samples:
        if sample.time_s >= end_s:
            yield Sample(end_s, sticks)
            return
        sticks = sample.sticks
        yield sample


def _recorded(states: list[FlightState], rate_hz: float) -> Recorded:
    thrust = np.array([state.push_m_s2 for state in states]) + np.array([0.0, 0.0, GRAVITY_M_S2])
    rotation = attitude(thrust, np.array([state.yaw_rad for state in states]))
    return Recorded(
        np.arange(len(states)) / rate_hz,
        np.array([state.position_m for state in states]),
        Rotation.from_matrix(rotation).as_quat(scalar_first=True),
    )


# --- files


def read_sticks(path: Path) -> tuple[Sample, ...]:
    """Read the sticks of a flight: `time_s,forward,left,up,turn`, each from -1 to 1, held until the next row.

    Raises:
        InputError: the file cannot be read, a column is missing, times do not increase from 0, or a stick is beyond
            its ends. The message names file, line and column.
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
    """Write what `read_sticks` reads, with all digits, so that the same flight can be flown again.

    Raises:
        OutputError: the file cannot be written.
    """
    write_rows(path, [_HEADER, *((sample.time_s, *sample.sticks) for sample in samples)], ",")


def _stick(row: TextRow, column: Column) -> float:
    value = row.number(column)
    if abs(value) > 1:
        raise row.error(column, "a number from -1 to 1", row.text(column))
    return value
