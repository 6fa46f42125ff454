"""Flights of a scenario for a seed: made from its records, varied at random until they keep the scenario's limits.

All formulas are written as sums of harmonics, so that the same random numbers apply to all of them: a change of phase,
size and period of each harmonic, and a change of the centre. Drones of one group have the same random numbers, except
for the heading.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float
from numpy.linalg import norm

from psotrack.errors import SettingsError
from psotrack.simulation.flights.motion import (
    DelayedFlight,
    Flight,
    HarmonicFlight,
    Heading,
    RelativeFlight,
    Times,
    WaypointFlight,
    recorded_flight,
)
from psotrack.simulation.scenarios import (
    Crossing,
    Drone,
    FlightFromFile,
    FlightRecord,
    FollowingFlight,
    Formation,
    Harmonics,
    NearPass,
    Orbit,
    Scenario,
    Variation,
    Vector,
    Waypoints,
    scenario_error,
)

#: Largest cosine of the angle between a near pass's side and its swing, which should be perpendicular. The relative
#: error of the distance is half of the cosine's square, which is negligible.
_PERPENDICULAR = 1e-6


def flying_order(scenario: Scenario) -> tuple[int, ...]:
    """Indices of the drones in an order in which each drone comes after the drone that its flight is relative to.

    Raises:
        SettingsError: a flight is relative to a drone that does not exist, or, along a chain, to itself.
    """
    count = len(scenario.drones)
    fields: dict[int, str] = {}
    before: dict[int, list[int]] = {index: [] for index in range(count)}
    for index, drone in enumerate(scenario.drones):
        for name in ("leader", "other"):
            number = getattr(drone.flight, name, None)
            if number is not None:
                fields[index] = f"drones[{index}].flight.{name}"
                before[index].append(number - 1)
                if number > count:
                    raise scenario_error(scenario, fields[index], f"a drone's number, 1 to {count}", number)
    try:
        return tuple(TopologicalSorter(before).static_order())
    except CycleError as error:
        # Each drone of the cycle is one that the next one follows.
        cycle = error.args[1][::-1]
        found = f"drones {' -> '.join(f'{index + 1}' for index in cycle)}"
        expected = "relative flights without a cycle"
        raise scenario_error(scenario, fields[cycle[-2]], expected, found) from None


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


#: Records of flights that are sums of harmonics.
HarmonicRecord = Harmonics | Orbit | Crossing | Formation | NearPass
Point = Vector | Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Draw:
    """Random numbers from -1 to 1 for one flight; the scenario's variation multiplies them.

    Attributes:
        phase: (harmonics,), changes of the phases.
        centre: (3,), change of the centre.
        size: (harmonics,), changes of the amplitudes.
        period: (harmonics,), changes of the periods.
        points: (points, 3), changes of the waypoints.
        yaw: change of the mean heading.
        sway_phase_rad: phase of the change of heading at time 0.
    """

    phase: Float[np.ndarray, "harmonics"]
    centre: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "harmonics"]
    period: Float[np.ndarray, "harmonics"]
    points: Float[np.ndarray, "points 3"]
    yaw: float = 0.0
    sway_phase_rad: float = 0.0


def draws(scenario: Scenario, rng: np.random.Generator) -> list[Draw]:
    """Random numbers for each drone; drones of one group have the same numbers, except for the heading."""
    drawn: dict[str | int, Draw] = {}
    result = []
    for index, drone in enumerate(scenario.drones):
        group = drone.group or index
        if group not in drawn:
            members = [other for other in scenario.drones if other.group == drone.group]
            drawn[group] = _draw(members if drone.group else [drone], rng)
        yaw, phase_rad = float(rng.uniform(-1, 1)), float(rng.uniform(0, 2 * np.pi))
        result.append(replace(drawn[group], yaw=yaw, sway_phase_rad=phase_rad))
    return result


def _draw(drones: Sequence[Drone], rng: np.random.Generator) -> Draw:
    """Random numbers for drones of one group, enough for the flight with the most harmonics or waypoints."""
    harmonics = max(_num_harmonics(drone.flight) for drone in drones)
    points = max(len(getattr(drone.flight, "points_m", ())) for drone in drones)
    shapes: tuple[Any, ...] = (harmonics, 3, harmonics, harmonics, (points, 3))
    return Draw(*(rng.uniform(-1, 1, shape) for shape in shapes))


def _num_harmonics(record: FlightRecord) -> int:
    if isinstance(record, FlightFromFile | FollowingFlight):
        return 0
    # A flight through waypoints uses one number: the change of its period.
    return 1 if isinstance(record, Waypoints) else len(_harmonics(record)[1])


def make(scenario: Scenario, drawn: Sequence[Draw], recorded: Mapping[int, Flight]) -> tuple[Flight, ...]:
    """Make the flight of each drone, changed by its random numbers.

    Args:
        scenario: the scenario.
        drawn: random numbers of each drone.
        recorded: recorded flights by the index of their drone; these flights do not change.

    Raises:
        SettingsError: a flight is relative to a drone that does not exist or, along a chain, to itself.
    """
    made: dict[int, Flight] = {}
    for index in flying_order(scenario):
        drone, draw = scenario.drones[index], drawn[index]
        heading = make_heading(drone, scenario.variation, draw.yaw, draw.sway_phase_rad)
        match drone.flight:
            case FlightFromFile():
                made[index] = recorded[index]
            case FollowingFlight(leader=leader, delay_s=delay_s):
                made[index] = DelayedFlight(made[leader - 1], delay_s, heading)
            case Formation(leader=other) | NearPass(other=other) as record:
                # Offset and distance that the scenario gives are not varied.
                unmoved = replace(draw, centre=np.zeros(3))
                offset = _harmonic_flight(record, unmoved, scenario.variation, heading)
                made[index] = RelativeFlight(made[other - 1], offset, heading)
            case Waypoints() as record:
                made[index] = _waypoint_flight(record, draw, scenario.variation, heading)
            case record:
                made[index] = _harmonic_flight(record, draw, scenario.variation, heading)
    return tuple(made[index] for index in range(len(scenario.drones)))


def make_heading(
    drone: Drone, variation: Variation, yaw: float = 0.0, sway_phase_rad: float = 0.0
) -> Heading:
    """Heading of a drone over time, changed by its random numbers (see `Draw`)."""
    return Heading(
        float(np.radians(drone.yaw_deg + yaw * variation.yaw_deg)),
        float(np.radians(drone.yaw_sway_deg)),
        2 * np.pi / drone.yaw_period_s,
        sway_phase_rad,
    )


def _harmonic_flight(
    record: HarmonicRecord, draw: Draw, variation: Variation, heading: Heading
) -> HarmonicFlight:
    centre_m, terms = _harmonics(record)
    count = len(terms)
    amplitude_m, phase_deg = (np.array([term[i] for term in terms], float).reshape(-1, 3) for i in (0, 2))
    period_s = np.array([term[1] for term in terms], float)
    return HarmonicFlight(
        centre_m=np.array(centre_m, float) + draw.centre * variation.centre_m,
        amplitude_m=amplitude_m * (1 + variation.size * draw.size[:count])[:, None],
        angular_rad_s=2 * np.pi / (period_s * (1 + variation.period * draw.period[:count])),
        # All axes of a harmonic get the same change of phase, so that an orbit stays an orbit.
        phase_rad=np.radians(phase_deg + (variation.phase_deg * draw.phase[:count])[:, None]),
        heading=heading,
    )


def _waypoint_flight(record: Waypoints, draw: Draw, variation: Variation, heading: Heading) -> WaypointFlight:
    points_m = np.array(record.points_m, np.float64)
    points_m = points_m + draw.points[: len(points_m)] * variation.centre_m
    leg_m = np.linalg.norm(np.roll(points_m, -1, axis=0) - points_m, axis=-1)
    slower = float(1 + variation.period * draw.period[0])
    return WaypointFlight(points_m, leg_m / record.speed_m_s * slower, record.hover_s * slower, heading)


def _harmonics(record: HarmonicRecord) -> tuple[Point, list[tuple[Point, float, Point]]]:
    """Centre, and amplitude, period and phases of each term; of a formation or near pass, from the other drone."""
    match record:
        case Harmonics():
            return record.centre_m, [(one.amplitude_m, one.period_s, one.phase_deg) for one in record.terms]
        case Orbit():
            across = 180.0 if record.clockwise else 0.0
            phases_deg = (record.phase_deg + 90.0, record.phase_deg + across, 0.0)
            about = (*record.radius_m, 0.0), record.period_s, phases_deg
            rise = (0.0, 0.0, record.rise_m), record.rise_period_s, (0.0, 0.0, record.rise_phase_deg)
            return record.centre_m, [about, rise]
        case Crossing():
            start, end = np.array(record.start_m), np.array(record.end_m)
            to_and_fro = (end - start) / 2, record.period_s, (record.phase_deg - 90.0,) * 3
            return (start + end) / 2, [to_and_fro]
        case Formation():
            return record.offset_m, []
        case NearPass():
            side = np.array(record.side) / np.linalg.norm(record.side)
            swing = record.swing_m, record.period_s, (record.phase_deg,) * 3
            return side * record.distance_m, [swing]


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


def excess(flights: tuple[Flight, ...], scenario: Scenario, time_s: Times) -> Excess | None:
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


#: Of a limit: the number of the first drone, the excess, the limit in words, the values and their unit.
_Measured = tuple[int, Float[np.ndarray, "drones times"], str, np.ndarray, str]


def _measured(flights: tuple[Flight, ...], scenario: Scenario, time_s: Times) -> Iterator[_Measured]:
    """Yield how far the flights exceed each limit."""
    limits = scenario.limits
    position_m = np.stack([flight.position_m(time_s) for flight in flights])
    outside_m = np.maximum(limits.lower_m - position_m, position_m - limits.upper_m).max(axis=-1)
    bounds = f"{list(limits.lower_m)} (limits.lower_m) to {list(limits.upper_m)} (limits.upper_m)"
    yield 0, outside_m, f"positions from {bounds}", position_m, ""
    measures: dict[str, tuple[str, Callable[[Flight], Times]]] = {
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


def frame_times_s(scenario: Scenario, num_frames: int) -> Times:
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
    still = Variation(phase_deg=0, centre_m=0, size=0, period=0, yaw_deg=0)
    flights = make(msgspec.structs.replace(scenario, variation=still), draws(scenario, rng), recorded)
    raise _refusal(scenario, excess(flights, scenario, time_s), excesses)


def _refusal(scenario: Scenario, nominal: Excess | None, varied: list[Excess]) -> SettingsError:
    """Error that names the limit that the flights violate without variation, or else the most frequent violation."""
    if nominal:
        return scenario_error(scenario, nominal.field, nominal.limit, nominal.found)
    (field, limit), times = Counter((found.field, found.limit) for found in varied).most_common(1)[0]
    example = next(found for found in varied if (found.field, found.limit) == (field, limit))
    remedy = f"{times} of {len(varied)} variations broke this limit: lower variation, or leave more room"
    return scenario_error(scenario, field, limit, example.found, remedy)


def _recorded(scenario: Scenario, time_s: Times) -> dict[int, Flight]:
    """Recorded flights by the index of their drone, read once and checked to cover all frames."""
    recorded: dict[int, Flight] = {}
    for index, drone in enumerate(scenario.drones):
        if isinstance(drone.flight, FlightFromFile):
            flight = recorded_flight(drone.flight, make_heading(drone, scenario.variation))
            flight.check(time_s)
            recorded[index] = flight
    return recorded
