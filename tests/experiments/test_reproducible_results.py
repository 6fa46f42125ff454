"""Results on data like S02_D4_A with the paper's swarm (joint, 100 particles x 70 iterations), from videos to errors.

Images have half the size and the flight takes two seconds. Silhouettes have half the usual reduction, so that drones
are as many cells wide as at full size.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from psotrack.evaluation import Evaluation, evaluate
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.pipeline import track_recording
from psotrack.recordings import Recording
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import SwarmSettings, TrackSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.trajectories import Trajectories, write_trajectories

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Lab:
    """A simulated sequence and the cache folder of its silhouettes."""

    sequence: Recording
    cache: Path

    def track(self, seed: int = 0) -> Trajectories:
        settings = TrackSettings(
            seed=seed,
            silhouettes=SilhouetteSettings(reduction=2, working_reduction=1),
            swarm=SwarmSettings(kind="joint", particles=100, iterations=70),
        )
        return track_recording(self.sequence, settings, cache=self.cache, jobs=1).trajectories

    def evaluate(self, trajectories: Trajectories) -> Evaluation:
        assert self.sequence.truth is not None
        return evaluate(trajectories, self.sequence.truth)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, optimised: None) -> Lab:
    root = tmp_path_factory.mktemp("lab")
    folder = simulate(
        "S02_D4_A",
        root,
        SimulationSettings(num_frames=50, scale=0.5, seed=0, masks=False, onboard=False),
        jobs=1,
    )
    return Lab(read_sequence(folder).usable(), root / "cache")


@pytest.fixture(scope="module")
def tracked(lab: Lab) -> Trajectories:
    return lab.track()


def test_error_is_within_the_documented_limit(lab: Lab, tracked: Trajectories) -> None:
    """At most 0.025 m, the limit at full size (the paper has 0.068 m); no identity swaps, misses or false tracks."""
    evaluation = lab.evaluate(tracked)
    assert evaluation.mean_error_m <= 0.025
    assert evaluation.id_switches == 0
    assert evaluation.missed_rate == 0
    assert tracked.num_drones == 4


def test_one_seed_gives_identical_tracks(lab: Lab, tracked: Trajectories, tmp_path: Path) -> None:
    write_trajectories(tmp_path / "first.csv", tracked)
    write_trajectories(tmp_path / "again.csv", lab.track())
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "first.csv").read_bytes()


def test_other_seeds_give_nearly_the_same_tracks(lab: Lab, tracked: Trajectories) -> None:
    """The swarm finds the same maximum with every seed; seeds differ only by how far the swarm has converged."""
    other = lab.track(seed=1)
    apart_m = np.linalg.norm(other.position_m - tracked.position_m, axis=-1)
    assert apart_m.max() > 0
    # Measured at full size over 250 frames: mean 0.0008 m, 99 % below 0.007 m, largest 0.022 m where the score has two
    # neighbouring maxima. A cell of the silhouettes is about 0.01 m at the drones.
    assert apart_m.mean() < 0.002
    assert apart_m.max() < 0.03
