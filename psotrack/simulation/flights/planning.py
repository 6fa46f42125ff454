"""Flights of a scenario for a seed, varied until they keep the scenario's limits."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.linalg import norm

from psotrack.errors import SettingsError
from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.flights.recordings import recorded_flight
from psotrack.simulation.flights.varying import (
    Turn,
    check_records,
    draws,
    flying_order,
    make,
    make_heading,
    zero_draws,
)
from psotrack.simulation.scenarios import (
    FlightFromFile,
    NearPass,
    Scenario,
    scenario_error,
)


class Excess(NamedTuple):
    """The largest violation of a limit by a flight.

    Attributes:
        field: the flight's field in the scenario.
        limit: the limit, as text for a message; the same text for the same limit of the same drone.
        found: value and time of the violation, as text for a message.
        time_s: time of the violation.
    """

    field: str
    limit: str
    found: str
    time_s: float


def excess(
    flights: tuple[Flight, ...], scenario: Scenario, time_s: Float[np.ndarray, "times"]
) -> Excess | None:
    """Find the first limit that the flights violate at any of the given times; None if they keep all limits.

    The limits are checked in the order bounds, speed, acceleration, tilt, distance. The distance of two drones in a
    near pass is not checked, because it follows from the formula of the near pass.
    """
    for first, over, limit, values, unit in _measured(flights, scenario, time_s):
        # The comparison is negated, because a position that overflows is NaN, and NaN is not above any limit.
        if not over.max() <= 0:
            row, at = (int(index) for index in np.unravel_index(np.argmax(over), over.shape))
            value = values[row, at]
            shown = f"{value:.4g} {unit}" if unit else f"[{', '.join(f'{each:.3f}' for each in value)}]"
            found = f"{shown} at {time_s[at]:.2f} s"
            return Excess(f"drones[{first + row}].flight", limit, found, float(time_s[at]))
    return None


def _measured(
    flights: tuple[Flight, ...], scenario: Scenario, time_s: Float[np.ndarray, "times"]
) -> Iterator[
    tuple[int, Float[np.ndarray, "drones times"], str, Float[np.ndarray, "drones times *values"], str]
]:
    """Yield for each limit the number of the first drone, the excess, the limit in words, the values and their unit."""
    limits = scenario.limits
    position_m = np.stack([flight.position_m(time_s) for flight in flights])
    outside_m = np.maximum(limits.lower_m - position_m, position_m - limits.upper_m).max(axis=-1)
    bounds = f"{list(limits.lower_m)} (limits.lower_m) to {list(limits.upper_m)} (limits.upper_m)"
    yield 0, outside_m, f"positions from {bounds}", position_m, ""
    measures: dict[str, tuple[str, Callable[[Flight], Float[np.ndarray, "times"]]]] = {
        "max_speed_m_s": ("m/s", lambda flight: norm(flight.velocity_m_s(time_s), axis=-1)),
        "max_acceleration_m_s2": ("m/s2", lambda flight: norm(flight.acceleration_m_s2(time_s), axis=-1)),
        "max_tilt_deg": ("degrees of tilt", lambda flight: flight.tilt_deg(time_s)),
    }
    for name, (unit, measure) in measures.items():
        values, most = np.stack([measure(flight) for flight in flights]), getattr(limits, name)
        yield 0, values - most, f"at most {most:g} {unit} (limits.{name})", values, unit
    passing = {
        frozenset((index, drone.flight.other - 1))
        for index, drone in enumerate(scenario.drones)
        if isinstance(drone.flight, NearPass)
    }
    for one, other in itertools.combinations(range(len(flights)), 2):
        if frozenset((one, other)) not in passing:
            apart_m = norm(position_m[one] - position_m[other], axis=-1)[None]
            limit = f"at least {limits.min_distance_m:g} m from drones[{one}] (limits.min_distance_m)"
            yield other, limits.min_distance_m - apart_m, limit, apart_m, "m"


#: Largest number of random variations that are tried until one keeps the limits.
NUM_ATTEMPTS = 400
#: Step between the frames of a first check. Most variations that violate a limit do so at these frames.
_STRIDE = 6


def frame_times_s(scenario: Scenario, num_frames: int) -> Float[np.ndarray, "frames"]:
    """(frames,), time of the middle of each frame's exposure."""
    return np.arange(num_frames) / scenario.fps


def plan(scenario: Scenario, seed: int) -> tuple[Flight, ...]:
    """Flight of each drone, varied by the seed, within the scenario's limits in all frames.

    Raises:
        SettingsError: no variation keeps the limits, a relative flight, near pass or waypoint is impossible, or a
            recorded flight is too short. The message names the field of the flight, or the file.
        InputError: a recorded flight cannot be used.
    """
    check_records(scenario)
    flying_order(scenario)
    time_s = frame_times_s(scenario, scenario.num_frames)
    recorded = _recorded(scenario, time_s)
    # Other variations often violate a limit at the same frames, so these frames are checked first.
    violated_s = time_s[:1]
    excesses: list[Excess] = []
    for attempt in range(NUM_ATTEMPTS):
        rng = np.random.default_rng([seed, attempt])
        flights = make(scenario, draws(scenario, rng), recorded)
        checks = (excess(flights, scenario, some_s) for some_s in (violated_s, time_s[::_STRIDE], time_s))
        found = next(filter(None, checks), None)
        if found is None:
            return flights
        violated_s = np.union1d(violated_s, found.time_s)
        excesses.append(found)
    raise _refusal(
        scenario, excess(make(scenario, zero_draws(scenario), recorded), scenario, time_s), excesses
    )


def _refusal(scenario: Scenario, nominal: Excess | None, varied: list[Excess]) -> SettingsError:
    """Error that names the limit that the flights violate without variation, or else the most frequent violation."""
    if nominal:
        return scenario_error(scenario, nominal.field, nominal.limit, nominal.found)
    (field, limit), times = Counter((found.field, found.limit) for found in varied).most_common(1)[0]
    example = next(found for found in varied if (found.field, found.limit) == (field, limit))
    remedy = f"{times} of {len(varied)} variations broke this limit: lower variation, or leave more room"
    return scenario_error(scenario, field, limit, example.found, remedy)


def _recorded(scenario: Scenario, time_s: Float[np.ndarray, "frames"]) -> dict[int, Flight]:
    """Recorded flights by the index of their drone, read once and checked to cover all frames."""
    recorded: dict[int, Flight] = {}
    for index, drone in enumerate(scenario.drones):
        if isinstance(drone.flight, FlightFromFile):
            flight = recorded_flight(drone.flight, make_heading(drone, Turn(), scenario.variation))
            flight.check(time_s)
            recorded[index] = flight
    return recorded
