"""Scenarios of a few flights, and files of recorded flights, for tests of the simulator's flights."""

import itertools

import numpy as np

from psotrack.simulation import Scenario
from psotrack.simulation.scenarios import Crossing, Drone, Limits, NearPass, Orbit, Variation, Waypoints
from psotrack.trajectories import Trajectories, write_trajectories

ORBIT = Orbit(centre_m=(0.3, -0.2, 1.4), radius_m=(1.5, 1.1), period_s=6.3, phase_deg=20.0, rise_m=0.3)
#: Sinusoids with speed 2 m * 2 pi / 8 s = 1.571 m/s and acceleration 1.571 m/s * 2 pi / 8 s.
CROSSINGS = (
    Crossing(start_m=(-2.0, 0.0, 1.0), end_m=(2.0, 0.0, 1.0), period_s=8.0),
    Crossing(start_m=(0.0, -2.0, 1.5), end_m=(0.0, 2.0, 1.5), period_s=8.0),
)
NEAR = NearPass(other=1, distance_m=0.6, side=(0.0, 0.0, 1.0), swing_m=(1.0, 0.0, 0.0), period_s=4.0)
POINTS = Waypoints(points_m=((0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)), speed_m_s=0.5)
WIDE = Limits(
    max_speed_m_s=9.0,
    max_acceleration_m_s2=9.0,
    max_tilt_deg=60.0,
    min_distance_m=0.0,
    lower_m=(-9.0, -9.0, -9.0),
    upper_m=(9.0, 9.0, 9.0),
)


NO_VARIATION = Variation(phase_deg=0.0, centre_m=0.0, size=0.0, period=0.0, yaw_deg=0.0)


def make_scenario(*records, groups=(), limits=WIDE, variation=NO_VARIATION, num_frames=250):
    """Make a scenario from flights; by default with wide limits and without variation."""
    drones = tuple(
        Drone(flight=record, group=group)
        for record, group in itertools.zip_longest(records, groups, fillvalue="")
    )
    return Scenario(
        name="T",
        hall="laboratory",
        cameras="laboratory",
        num_frames=num_frames,
        drones=drones,
        limits=limits,
        variation=variation,
    )


def write_tracks(path, num_drones=1, count=8):
    """Tracks of some drones, each of which is at k, 2 k and 3 k metres after k / 10 seconds."""
    k = np.arange(count)
    position_m = np.repeat(np.stack([k, 2.0 * k, 3.0 * k], axis=-1)[:, None], num_drones, axis=1)
    names = ("a", "b", "c")[:num_drones]
    write_trajectories(path, Trajectories(k, k / 10, names, position_m))
    return path
