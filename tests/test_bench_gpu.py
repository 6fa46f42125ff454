"""The benchmark of a GPU: without one it says so in a line, and in small it runs on the CPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import environment_without_jax_settings

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "experiments" / "benchmarks" / "gpu.py"


def benchmark(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    # Scripts find the package of this checkout first, as the tests do.
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {"PYTHONPATH": paths} | environment
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def benchmark_in_small(*words: object) -> subprocess.CompletedProcess[str]:
    # With the suite's cache of compiled programs. The benchmark chooses its own number of devices, as it does where
    # XLA_FLAGS says nothing.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    return benchmark("--device", "cpu", "--small", *words, **environment)


@pytest.mark.slow
def test_without_a_gpu_a_line_says_what_to_do(tmp_path):
    # An empty list of visible devices hides a GPU from JAX.
    hidden = environment_without_jax_settings() | {"CUDA_VISIBLE_DEVICES": ""}
    done = benchmark("--data", tmp_path / "data", **hidden)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("bench-gpu: no GPU is there")
    assert "--device cpu --small" in line
    assert "'.[cuda]'" in line
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_in_small_it_runs_on_the_cpu(tmp_path):
    """The figures of time say nothing here; tracks and labels must be the same as on a GPU."""
    path = tmp_path / "figures.json"
    done = benchmark_in_small("--data", tmp_path / "data", "--json", path)
    assert done.returncode == 0, done.stderr
    figures = json.loads(path.read_text())
    (runs,) = figures["runs"]
    assert runs["other_identities"] == runs["other_statuses"] == 0
    # As `test_side_by_side`: a fraction of a silhouette's cell, whatever the rounding.
    assert runs["median_mm"] <= 0.5
    assert runs["runs"] > runs["cpu_runs"]
    assert 0 < runs["device_s"] < runs["track_s"] < runs["total_s"]
    assert runs["ratio"] == pytest.approx(3 / runs["total_s"] / (2 / runs["cpu_total_s"]))
    assert figures["grid"]["cells"] == 2
    assert 0 < figures["grid"]["device_s"] < figures["grid"]["total_s"]
    assert figures["mog2"]["same_labels"] >= 0.999
    assert np.isfinite(list(figures["mog2"]["frames_per_s"].values())).all()
    for name in ("ratio of throughputs", "distance of tracks", "another identity", "Table 5's grid", "MOG2"):
        assert name in done.stdout


@pytest.mark.slow
def test_a_part_alone_and_an_unknown_part(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    data = ("--data", tmp_path / "data")
    done = benchmark_in_small(*data, "--only", "mog2", "--repeats", "1", "--json", path)
    assert done.returncode == 0, done.stderr
    figures = json.loads(path.read_text())
    assert figures["runs"] == []
    assert "grid" not in figures
    assert figures["mog2"]["same_labels"] >= 0.999
    wrong = benchmark_in_small(*data, "--only", "S99")
    assert wrong.returncode == 2
    assert wrong.stderr.endswith("--only: expected some of S01_D2_A, grid, mog2, found S99\n")
