"""Flights of a scenario for a seed, varied until they keep the scenario's limits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
    Limits,
    NearPass,
    Scenario,
    scenario_error,
)


@dataclass(frozen=True)
class Excess:
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
    limits = scenario.limits
    position_m = np.stack([flight.position_m(time_s) for flight in flights])
    outside_m = np.maximum(limits.lower_m - position_m, position_m - limits.upper_m).max(axis=-1)
    # The comparison is negated, because a position that overflows is NaN, and NaN is not above any limit.
    if not outside_m.max() <= 0:
        drone, at = _worst(outside_m)
        x, y, z = position_m[drone, at]
        lower, upper = list(limits.lower_m), list(limits.upper_m)
        limit = f"positions from {lower} (limits.lower_m) to {upper} (limits.upper_m)"
        return _excess(drone, limit, f"[{x:.3f}, {y:.3f}, {z:.3f}]", time_s[at])
    return _excess_of_motion(flights, limits, time_s) or _excess_of_distance(position_m, scenario, time_s)


def _excess_of_motion(
    flights: tuple[Flight, ...], limits: Limits, time_s: Float[np.ndarray, "times"]
) -> Excess | None:
    for name, unit, measure in (
        ("max_speed_m_s", "m/s", lambda flight: np.linalg.norm(flight.velocity_m_s(time_s), axis=-1)),
        ("max_acceleration_m_s2", "m/s2", lambda one: np.linalg.norm(one.acceleration_m_s2(time_s), axis=-1)),
        ("max_tilt_deg", "degrees of tilt", lambda flight: _tilt_deg(flight, time_s)),
    ):
        value = np.stack([measure(flight) for flight in flights])
        most = getattr(limits, name)
        if not value.max() <= most:
            drone, at = _worst(value)
            limit = f"at most {most:g} {unit} (limits.{name})"
            return _excess(drone, limit, f"{value[drone, at]:.4g} {unit}", time_s[at])
    return None


def _tilt_deg(flight: Flight, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    return np.degrees(np.arccos(np.clip(flight.rotation(time_s)[:, 2, 2], -1, 1)))


def _excess_of_distance(
    position_m: Float[np.ndarray, "drones times 3"], scenario: Scenario, time_s: Float[np.ndarray, "times"]
) -> Excess | None:
    least_m = scenario.limits.min_distance_m
    passing = {
        frozenset((index, drone.flight.other - 1))
        for index, drone in enumerate(scenario.drones)
        if isinstance(drone.flight, NearPass)
    }
    for drone in range(1, len(position_m)):
        others = [other for other in range(drone) if frozenset((drone, other)) not in passing]
        apart_m = np.linalg.norm(position_m[others] - position_m[drone], axis=-1)
        if apart_m.size and apart_m.min() < least_m:
            nearest, at = _worst(-apart_m)
            limit = f"at least {least_m:g} m from drones[{others[nearest]}] (limits.min_distance_m)"
            return _excess(drone, limit, f"{apart_m[nearest, at]:.4g} m", time_s[at])
    return None


def _worst(value: Float[np.ndarray, "drones times"]) -> tuple[int, int]:
    row, column = np.unravel_index(np.argmax(value), value.shape)
    return int(row), int(column)


def _excess(drone: int, limit: str, found: str, time_s: float) -> Excess:
    return Excess(f"drones[{drone}].flight", limit, f"{found} at {time_s:.2f} s", float(time_s))


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
