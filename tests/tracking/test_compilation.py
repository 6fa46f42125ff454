"""Compilations of the tracker: one per capacity of the slots and shape of the images, for all values of the inputs."""

import numpy as np
import pytest
from helpers import ROOM_M, ring_rig, silhouettes_in_memory, track_settings

from psotrack.foreground.silhouettes import Exposures
from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import RunInputs, StepwiseTracker, block, track_silhouettes, tracker_settings

pytestmark = pytest.mark.slow

SHAPE, REDUCTION, NUM_FRAMES = (30, 40), 8, 30
RIG = ring_rig(3)


def track(num_drones, *, seed=0, fps=25.0, **settings):
    """Track given drones in random silhouettes."""
    rng = np.random.default_rng(seed)
    coverage = rng.integers(0, 256, (NUM_FRAMES, len(RIG), *SHAPE)).astype(np.uint8)
    given = InitialState(
        rng.uniform([-1, -1, 0.5], [1, 1, 2.5], (num_drones, 3)),
        np.zeros((num_drones, 3)),
        np.full((num_drones, 3), 0.4 + 0.1 * seed),
        np.full(num_drones, 3.0),
    )
    effort = {"particles": 7, "iterations": 3, "seed": seed, "drones": num_drones}
    inputs = RunInputs(
        ROOM_M * (1 + 0.1 * seed), tracker_settings(track_settings(**(effort | settings))), given
    )
    ((tracks, _),) = track_silhouettes(
        RIG, silhouettes_in_memory(RIG, coverage, REDUCTION), [inputs], fps=fps
    )
    assert tracks.num_drones == num_drones


def compiled():
    """Number of programs of the tracker that this process has compiled so far."""
    return block._one_run._cache_size()


def test_a_new_number_of_drones_within_a_capacity_and_other_values_compile_nothing():
    before = compiled()
    track(3)
    # One block of 25 frames, and one that is filled up to 25: the same program.
    assert compiled() == before + 1
    track(4)
    track(3, seed=1, fps=30.0, iterations=9, max_speed_m_s=3.0, inertia=0.4, min_fitness=0.3)
    track(4, seed=2, iterations=0, cognitive=2.0, social=0.1, spread_m=0.2, max_coasting_s=2.0)
    assert compiled() == before + 1
    # The test can see a compilation: five drones need more slots.
    track(5)
    track(3, swarm="joint")
    assert compiled() == before + 3


def test_no_frame_waits_for_a_compilation():
    settings = tracker_settings(track_settings(particles=7, iterations=3))
    how = {"fps": 25.0, "bounds_m": ROOM_M, "reduction": REDUCTION, "shape": SHAPE, "most_drones": 4}
    tracker = StepwiseTracker(RIG, settings, **how)
    tracker.compile()
    before, zero = compiled(), np.zeros(len(RIG), np.float32)
    for frame in range(3):
        images = np.full((len(RIG), *SHAPE), 40 * frame, np.uint8)
        there = np.arange(len(RIG)) != frame
        tracker.step(2 * frame, 0.08 * frame, images, Exposures(zero, there, zero + 1, zero))
        tracker.look_ahead()
    assert compiled() == before
