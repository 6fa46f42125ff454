"""Checks of a scenario's flights before they are made: leaders of relative flights, near passes, waypoints."""

from __future__ import annotations

import numpy as np

from psotrack.simulation.scenarios import (
    FlightRecord,
    FollowingFlight,
    Formation,
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
