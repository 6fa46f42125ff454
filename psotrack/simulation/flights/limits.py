"""Whether flights keep to the limits of their scenario, and where and when they do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.simulation.flights.motion import Flight
from psotrack.simulation.scenarios import Limits, NearPass, Scenario


@dataclass(frozen=True)
class Excess:
    """A limit that a flight breaks, where it does so most.

    Attributes:
        field: the flight's, in the scenario.
        limit: what was expected; the same text for the same limit of the same drone.
        found: the value, and when.
        time_s: when.
    """

    field: str
    limit: str
    found: str
    time_s: float


def excess(
    flights: tuple[Flight, ...], scenario: Scenario, time_s: Float[np.ndarray, "times"]
) -> Excess | None:
    """The first limit that the flights break at any of the times, or None.

    In the order: bounds, speed, acceleration, tilt, distance. Drones that a near pass brings together are held to
    its distance by its formula, not here.
    """
    limits = scenario.limits
    position_m = np.stack([flight.position_m(time_s) for flight in flights])
    outside_m = np.maximum(limits.lower_m - position_m, position_m - limits.upper_m).max(axis=-1)
    # What overflows is NaN, which is not above any limit.
    if not outside_m.max() <= 0:
        drone, at = _worst(outside_m)
        x, y, z = position_m[drone, at]
        lower, upper = list(limits.lower_m), list(limits.upper_m)
        limit = f"positions from {lower} (limits.lower_m) to {upper} (limits.upper_m)"
        return _excess(drone, limit, f"[{x:.3f}, {y:.3f}, {z:.3f}]", time_s[at])
    return _too_wild(flights, limits, time_s) or _too_near(position_m, scenario, time_s)


def _too_wild(
    flights: tuple[Flight, ...], limits: Limits, time_s: Float[np.ndarray, "times"]
) -> Excess | None:
    for name, unit, measure in (
        ("max_speed_m_s", "m/s", _speed_m_s),
        ("max_acceleration_m_s2", "m/s2", _acceleration_m_s2),
        ("max_tilt_deg", "degrees of tilt", _tilt_deg),
    ):
        value = np.stack([measure(flight, time_s) for flight in flights])
        most = getattr(limits, name)
        if not value.max() <= most:
            drone, at = _worst(value)
            limit = f"at most {most:g} {unit} (limits.{name})"
            return _excess(drone, limit, f"{value[drone, at]:.4g} {unit}", time_s[at])
    return None


def _speed_m_s(flight: Flight, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    return np.linalg.norm(flight.velocity_m_s(time_s), axis=-1)


def _acceleration_m_s2(flight: Flight, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    return np.linalg.norm(flight.acceleration_m_s2(time_s), axis=-1)


def _tilt_deg(flight: Flight, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    return np.degrees(np.arccos(np.clip(flight.rotation(time_s)[:, 2, 2], -1, 1)))


def _too_near(
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
