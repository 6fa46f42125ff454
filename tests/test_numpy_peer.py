"""The NumPy fitness of the benchmark computes the same function as the tracker's fitness, also at its limits."""

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import draw_coverage, float32, ring_rig

from psotrack.foreground.silhouettes import summed_area_table
from psotrack.tracking.swarm import SoftIoU
from psotrack.tracking.swarm.fitness import joint_fitness, score_inputs

BENCHMARKS = Path(__file__).parent.parent / "experiments" / "benchmarks"
REDUCTION = 4
RIG = ring_rig(5)
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])


@pytest.fixture(scope="module")
def peers():
    """The module of the benchmark, which stands beside its script."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import _numpy_fitness
    finally:
        sys.path.remove(str(BENCHMARKS))
    return _numpy_fitness


def random_positions(seed):
    """Positions near the drones, at the border of the images, and far outside, where too few cameras see a drone."""
    rng = np.random.default_rng(seed)
    drones_m = np.array([[0.2, 0.1, 1.3], [-0.6, 0.4, 1.1]])
    near = drones_m + rng.normal(0, 0.1, (40, 2, 3))
    far = rng.uniform([-4, -4, -1], [4, 4, 5], (400, 2, 3))
    return drones_m, np.concatenate([near, far]).astype(np.float32)


@pytest.mark.parametrize("min_cameras", [2, 4])
@pytest.mark.slow
def test_the_numpy_fitness_is_the_tracker_s(peers, min_cameras):
    drones_m, position_m = random_positions(0)
    images = draw_coverage(RIG, drones_m, SIZE_M, REDUCTION)
    score = SoftIoU(min_cameras=min_cameras)
    inputs = score_inputs(
        *float32((RIG.cameras, SIZE_M)), summed_area_table(images), score, reduction=REDUCTION
    )
    expected = np.asarray(joint_fitness(inputs, position_m))
    peer = peers.NumpyFitness(RIG.cameras, SIZE_M, score, REDUCTION)
    found = peer(peer.tables(images), position_m)
    # The draw has drones that too few cameras see, and drones that all cameras see.
    assert (expected == 0).any()
    assert expected.max() > 0.3
    # float32 is compared with float64, so a camera with a weight at the limit may count in only one of the two.
    assert np.mean(np.abs(found - expected) > 1e-5) < 0.01
