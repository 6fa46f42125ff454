"""Flights from formulas: positions as sums of harmonics, attitudes as the acceleration demands.

A multirotor pushes along its body's z axis only, so that axis points along a + g (Mellinger and Kumar, "Minimum snap
trajectory generation and control for quadrotors", 2011; drag is left out); the heading is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.simulation.scenarios import Drone, Limits, Scenario

GRAVITY_M_S2 = 9.81
#: Seeds are tried in turn until limits hold; a scenario that fails this often cannot keep them.
NUM_ATTEMPTS = 400


@dataclass(frozen=True)
class Flight:
    """A flight whose derivatives are known exactly at any time.

    Attributes:
        centre_m: (3,).
        amplitude_m: (harmonics, 3).
        angular_rad_s: (harmonics,), angular frequencies.
        phase_rad: (harmonics, 3).
        yaw_rad: heading, sway amplitude, sway angular frequency (rad/s), sway phase.
    """

    centre_m: Float[np.ndarray, "3"]
    amplitude_m: Float[np.ndarray, "harmonics 3"]
    angular_rad_s: Float[np.ndarray, "harmonics"]
    phase_rad: Float[np.ndarray, "harmonics 3"]
    yaw_rad: tuple[float, float, float, float]

    def _derivative(self, time_s: Float[np.ndarray, "times"], order: int) -> Float[np.ndarray, "times 3"]:
        w = self.angular_rad_s[:, None]
        # The n-th derivative of sin is sin a quarter turn per order ahead.
        angle = w * time_s[:, None, None] + self.phase_rad + order * np.pi / 2
        return (self.amplitude_m * w**order * np.sin(angle)).sum(axis=1)

    def position_m(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """(times, 3), world, metres."""
        return self.centre_m + self._derivative(time_s, 0)

    def velocity_m_s(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """(times, 3), world."""
        return self._derivative(time_s, 1)

    def acceleration_m_s2(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3"]:
        """(times, 3), world, gravity not included."""
        return self._derivative(time_s, 2)

    def rotation(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 3 3"]:
        """(times, 3, 3), body to world: z along a + g, x as near to the heading as that allows."""
        thrust = self.acceleration_m_s2(time_s) + np.array([0.0, 0.0, GRAVITY_M_S2])
        body_z = thrust / np.linalg.norm(thrust, axis=-1, keepdims=True)
        heading, sway, angular, phase = self.yaw_rad
        yaw = heading + sway * np.sin(angular * time_s + phase)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
        body_y = np.cross(body_z, ahead)
        body_y /= np.linalg.norm(body_y, axis=-1, keepdims=True)
        return np.stack([np.cross(body_y, body_z), body_y, body_z], axis=-1)

    def orientation_wxyz(self, time_s: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times 4"]:
        """(times, 4), unit quaternions body to world, with a sign that does not jump from one time to the next."""
        xyzw = Rotation.from_matrix(self.rotation(time_s)).as_quat()
        wxyz = xyzw[:, [3, 0, 1, 2]]
        flips = np.sign((wxyz[1:] * wxyz[:-1]).sum(axis=-1))
        return wxyz * np.cumprod(np.concatenate([[1.0], flips]))[:, None]


def frame_times_s(scenario: Scenario, num_frames: int) -> Float[np.ndarray, "frames"]:
    """(frames,), the middle of each frame's exposure."""
    return np.arange(num_frames) / scenario.fps


def plan(scenario: Scenario, seed: int) -> tuple[Flight, ...]:
    """One flight per drone, varied by the seed, all within the scenario's limits for its whole length.

    Raises:
        SettingsError: no variation keeps the limits.
    """
    reasons: dict[str, int] = {}
    for attempt in range(NUM_ATTEMPTS):
        rng = np.random.default_rng([seed, attempt])
        flights = tuple(_vary(drone, scenario, rng) for drone in scenario.drones)
        reason = broken_limit(flights, scenario)
        if not reason:
            return flights
        reasons[reason] = reasons.get(reason, 0) + 1
    raise SettingsError(
        f"scenario {scenario.name}",
        expected="flights within its limits",
        found=f"none in {NUM_ATTEMPTS} tries ({', '.join(f'{k}: {n}' for k, n in reasons.items())})",
        remedy="loosen the limits or move the flights apart",
    )


def _vary(drone: Drone, scenario: Scenario, rng: np.random.Generator) -> Flight:
    amplitude = np.array([h.amplitude_m for h in drone.harmonics], np.float64)
    period = np.array([h.period_s for h in drone.harmonics], np.float64)
    phase = np.radians([h.phase_deg for h in drone.harmonics])
    # One shift of phase per harmonic: its axes keep their relation, an orbit stays an orbit.
    phase = phase + np.radians(rng.uniform(-1, 1, (len(phase), 1)) * scenario.variation_deg)
    return Flight(
        centre_m=np.array(drone.centre_m) + rng.uniform(-1, 1, 3) * scenario.variation_m,
        amplitude_m=amplitude * rng.uniform(0.94, 1.06, (len(amplitude), 1)),
        angular_rad_s=2 * np.pi / (period * rng.uniform(0.96, 1.04, len(period))),
        phase_rad=phase,
        yaw_rad=(
            float(np.radians(drone.yaw_deg) + rng.uniform(-1, 1) * np.pi / 4),
            float(np.radians(drone.yaw_sway_deg)),
            2 * np.pi / drone.yaw_period_s,
            float(rng.uniform(0, 2 * np.pi)),
        ),
    )


def broken_limit(flights: tuple[Flight, ...], scenario: Scenario) -> str:
    """The first limit that the flights break at any frame, or an empty text."""
    time_s = frame_times_s(scenario, scenario.num_frames)
    limits: Limits = scenario.limits
    position = np.stack([flight.position_m(time_s) for flight in flights])
    speed = np.stack([np.linalg.norm(flight.velocity_m_s(time_s), axis=-1) for flight in flights])
    acceleration = np.stack([np.linalg.norm(flight.acceleration_m_s2(time_s), axis=-1) for flight in flights])
    tilt_cos = np.stack([flight.rotation(time_s)[:, 2, 2] for flight in flights])
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    apart = apart[np.triu_indices(len(flights), 1)]
    checks = {
        "bounds": bool(np.all((position >= limits.lower_m) & (position <= limits.upper_m))),
        "speed": bool(np.all(speed <= limits.max_speed_m_s)),
        "acceleration": bool(np.all(acceleration <= limits.max_acceleration_m_s2)),
        "tilt": bool(np.all(tilt_cos >= np.cos(np.radians(limits.max_tilt_deg)))),
        "distance": bool(np.all(apart >= limits.min_distance_m)),
    }
    return next((name for name, kept in checks.items() if not kept), "")
