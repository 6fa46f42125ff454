"""Flights of a scenario for a seed, within the scenario's limits."""

from __future__ import annotations

from collections import Counter

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.simulation.flights.checking import check_records, flying_order
from psotrack.simulation.flights.limits import Excess, excess
from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.flights.recordings import recorded_flight
from psotrack.simulation.flights.varying import Turn, draws, make, make_heading, zero_draws
from psotrack.simulation.scenarios import FlightFromFile, Scenario, scenario_error

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
