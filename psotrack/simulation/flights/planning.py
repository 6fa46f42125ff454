"""Flights of a scenario for a seed: checked before they are made, then varied until they keep the scenario's limits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.flights.recordings import recorded_flight
from psotrack.simulation.flights.varying import Turn, draws, make, make_heading, zero_draws
from psotrack.simulation.scenarios import (
    FlightFromFile,
    FlightRecord,
    FollowingFlight,
    Formation,
    Limits,
    NearPass,
    Scenario,
    Waypoints,
    scenario_error,
)

#: Largest cosine of the angle between a near pass's side and its swing, which should be perpendicular. The relative
#: error of the distance is half of the cosine's square, which is negligible.
_PERPENDICULAR = 1e-6


def followed(record: FlightRecord) -> tuple[str, int] | None:
    """Field and number of the drone that a flight is relative to; None for an independent flight."""
    if isinstance(record, Formation | FollowingFlight):
        return "leader", record.leader
    if isinstance(record, NearPass):
        return "other", record.other
    return None


def flying_order(scenario: Scenario) -> tuple[int, ...]:
    """Indices of the drones in an order in which each drone comes after the drone that its flight is relative to.

    Raises:
        SettingsError: a flight is relative to a drone that does not exist, or, along a chain, to itself.
    """
    order: list[int] = []
    for index in range(len(scenario.drones)):
        chain = _chain(scenario, index)
        order += [link for link in reversed(chain) if link not in order]
    return tuple(order)


def _chain(scenario: Scenario, index: int) -> list[int]:
    """Index of a drone, then of the drone that its flight is relative to, and so on along the chain."""
    chain, count = [index], len(scenario.drones)
    while relation := followed(scenario.drones[chain[-1]].flight):
        name, number = relation
        field = f"drones[{chain[-1]}].flight.{name}"
        if number > count:
            raise scenario_error(scenario, field, f"a drone's number, 1 to {count}", number)
        chain.append(number - 1)
        if chain[-1] in chain[:-1]:
            loop = " -> ".join(f"{link + 1}" for link in chain)
            raise scenario_error(scenario, field, "relative flights without a cycle", f"drones {loop}")
    return chain


def check_records(scenario: Scenario) -> None:
    """Refuse near passes and waypoints that are impossible for every seed.

    Raises:
        SettingsError: a near pass has no side or no swing, or its side is not perpendicular to its swing; the speed
            between waypoints is above the limit, or two consecutive waypoints are equal. The message names the field.
    """
    for index, drone in enumerate(scenario.drones):
        if isinstance(drone.flight, NearPass):
            _check_near_pass(scenario, f"drones[{index}].flight", drone.flight)
        elif isinstance(drone.flight, Waypoints):
            _check_waypoints(scenario, f"drones[{index}].flight", drone.flight)


def _check_near_pass(scenario: Scenario, field: str, record: NearPass) -> None:
    for name, vector in (("side", record.side), ("swing_m", record.swing_m)):
        if not np.any(vector):
            raise scenario_error(scenario, f"{field}.{name}", "a direction", "[0, 0, 0]")
    side, swing = (np.array(vector) / np.linalg.norm(vector) for vector in (record.side, record.swing_m))
    cosine = float(side @ swing)
    if abs(cosine) > _PERPENDICULAR:
        found = f"one at {np.degrees(np.arccos(np.clip(cosine, -1, 1))):.4g} degrees to it"
        remedy = "otherwise distance_m is not the smallest distance"
        raise scenario_error(scenario, f"{field}.side", "a direction perpendicular to swing_m", found, remedy)


def _check_waypoints(scenario: Scenario, field: str, record: Waypoints) -> None:
    # A fast drone could reach the next waypoint between two frames, where the limits are not checked.
    most_m_s = scenario.limits.max_speed_m_s
    if record.speed_m_s > most_m_s:
        expected = f"at most {most_m_s:g} m/s (limits.max_speed_m_s)"
        raise scenario_error(scenario, f"{field}.speed_m_s", expected, f"{record.speed_m_s:g}")
    for index, point_m in enumerate(record.points_m):
        if point_m == record.points_m[index - 1]:
            expected = "a point that differs from the previous one (the first point follows the last)"
            found, remedy = f"{list(point_m)} again", "to stand still at a point, set hover_s"
            raise scenario_error(scenario, f"{field}.points_m[{index}]", expected, found, remedy)


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
