"""Compilations of the tracker: one per `Program` and shapes of the inputs, for all values of the inputs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ROOM_M, float32, ring_rig, track_settings

from psotrack.tracking import tracker
from psotrack.tracking.parameters import tracker_params, tracker_program, tracker_settings


def run(*, num_frames=5, num_drones=2, seed=0, size_m=0.4, focal=1.0, **settings):
    """Track two chunks of random silhouettes, and wait for the result."""
    rng = np.random.default_rng(seed)
    position_m, velocity_m_s = rng.uniform(-1, 1, (num_drones, 3)), np.zeros((num_drones, 3))
    settings = tracker_settings(
        track_settings(**({"particles": 7, "iterations": 3, "seed": seed} | settings))
    )
    program, sizes_m = tracker_program(settings, 8), np.full((num_drones, 3), size_m)
    params = tracker_params(settings, sizes_m, fps=25.0 + seed, bounds_m=ROOM_M * (1 + 0.1 * seed))
    starts = tracker.no_track_starts(num_drones)
    cameras = float32(ring_rig(3).cameras)
    cameras = replace(cameras, K=cameras.K * focal)
    state = tracker.init(jax.random.key(seed), *float32((position_m, velocity_m_s)), params)
    coverage = rng.integers(0, 256, (num_frames, 3, 30, 40)).astype(np.uint8)
    state, _ = tracker.track(state, coverage, cameras, params, program, starts)
    # The state of the second chunk is already on the device.
    return jax.block_until_ready(
        tracker.track(state, jnp.asarray(coverage), cameras, params, program, starts)
    )


@pytest.fixture
def compiled(caplog):
    """Function that returns the names of the programs that were compiled since its last call."""
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):

        def since_last():
            lines = [record.getMessage() for record in caplog.records]
            caplog.clear()
            return [line.split()[1] for line in lines if line.startswith("Compiling ")]

        yield since_last


@pytest.mark.slow
def test_other_values_of_the_inputs_compile_nothing(compiled):
    run()
    assert any("track" in name for name in compiled())
    run(seed=1, size_m=0.7, focal=1.1, iterations=9, max_speed_m_s=3.0, inertia=0.4, min_fitness=0.3)
    run(seed=2, iterations=0, cognitive=2.0, social=0.1, spread_m=0.2, min_cameras=1, max_coasting_s=2.0)
    run(seed=3, jerk_density_m2_s5=5.0, error_share=0.1, error_time_s=1.0)
    assert compiled() == []


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"num_frames": 6, "num_drones": 3}, {"swarm": "joint"}])
def test_another_shape_or_program_compiles_once(compiled, change):
    """Another number of frames and drones, or another swarm, compiles once; so the test above can see a compilation."""
    run()
    compiled()
    run(**change)
    assert sum("track" in name for name in compiled()) == 1
    run(**change, seed=1)
    assert compiled() == []
