"""Flights of a few frames for the tests of evaluation."""

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.trajectories import UNASSIGNED, Trajectories

# Two frames per second: frames 0 and 1 are the first second, in which identity is fixed.
FPS = 2.0
# Sums of a handful of float64 numbers of a few metres.
ROUNDING = 1e-12

seeds = st.integers(0, 2**32 - 1)


def on_x_axis(*tracks, frame=None, **others) -> Trajectories:
    """Drones that fly along the x axis: one list of x in metres per drone, None where it is not known."""
    x_m = np.array([[np.nan if x is None else x for x in track] for track in tracks], float).T
    frame = np.arange(len(x_m)) if frame is None else np.array(frame)
    position_m = np.stack([x_m, 0 * x_m, 0 * x_m], axis=-1)
    names = tuple(f"d{number}" for number in range(len(tracks)))
    return Trajectories(frame=frame, time_s=frame / FPS, drones=names, position_m=position_m, **others)


#: Two drones that stand still, 10 m apart.
TRUTH = on_x_axis([0] * 5, [10] * 5)


def random_flights(
    seed: int, num_frames: int = 7, num_drones: int = 3, num_estimates: int = 4, missing: float = 0.15
):
    """An estimate and a reference in a room of a metre, so that drones are often nearer to another's estimate."""
    rng = np.random.default_rng(seed)

    def flights(drones: int, prefix: str) -> Trajectories:
        position_m = rng.uniform(-0.5, 0.5, (num_frames, drones, 3))
        position_m[rng.random((num_frames, drones)) < missing] = np.nan
        frame = np.arange(num_frames)
        return Trajectories(frame, frame / FPS, tuple(f"{prefix}{d}" for d in range(drones)), position_m)

    ref = flights(num_drones, "true")
    # One known position, so that there is always something to judge.
    ref.position_m[0, 0] = 0.0
    orientation_wxyz = Rotation.random(num_frames * num_drones, rng=rng).as_quat(scalar_first=True)
    return flights(num_estimates, "est"), replace(
        ref, orientation_wxyz=orientation_wxyz.reshape(num_frames, num_drones, 4)
    )


def pairings(num_drones: int, num_estimates: int):
    """All ways to give each drone an estimate of its own, or none."""
    choices = [*range(num_estimates), *[UNASSIGNED] * num_drones]
    return set(itertools.permutations(choices, num_drones))
