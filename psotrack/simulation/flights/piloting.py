"""Flying by hand: from stick samples to a recorded flight at a given rate.

The flight depends only on the samples and their times, so the same samples give the same flight again.
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
from psotrack.simulation.flights.resampling import MIN_SAMPLES
from psotrack.support import Column, TextRow, read_table, write_rows

#: Smallest number of integration steps per second: several steps in each time constant of the dynamics.
_MIN_STEPS_HZ = 250.0
#: Rounding error of sample times, which come from divisions and clocks, as a share of a step.
_ROUNDING = 1e-6

_HEADER = ("time_s", *Sticks._fields)


class Sample(NamedTuple):
    """Stick positions from a time on, until the next sample."""

    time_s: float
    sticks: Sticks


@dataclass(frozen=True)
class Flown:
    """A flight by hand and the stick samples that made it.

    Attributes:
        recorded: samples of the flight.
        samples: samples of the sticks.
    """

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
    """Simulate a flight that stick samples control, from hovering until the time of the last sample.

    Args:
        samples: samples of the sticks, with times that increase from 0; the iterator may wait for a person.
        start_m: (3,), position at time 0, where the drone hovers.
        space: space that the drone stays in.
        dynamics: dynamics of the drone.
        rate_hz: rate of the recorded flight; its times are exactly k / rate_hz.
        watch: function that is called with the time of each sample and the state at that time.

    Raises:
        SettingsError: the start is outside the space, the rate is not above 0, the samples' times do not increase, or
            the flight is too short to be replayed.
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
    """Check start and rate before the flight; raises the same `SettingsError` as `fly`."""
    check_positive("rate", rate_hz)
    if not np.all((start_m >= space.lower_m) & (start_m <= space.upper_m)):
        lower, upper, start = (
            ", ".join(f"{value:g}" for value in point) for point in (space.lower_m, space.upper_m, start_m)
        )
        raise SettingsError("start", expected=f"a point from ({lower}) to ({upper})", found=f"({start})")


def until(samples: Iterable[Sample], end_s: float) -> Iterator[Sample]:
    """Yield the samples before a time, and one last sample at this time if there are later samples."""
    sticks = Sticks()
    for sample in samples:
        if sample.time_s >= end_s:
            yield Sample(end_s, sticks)
            return
        sticks = sample.sticks
        yield sample


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
