"""The benchmark of many runs, in small, on the CPU: its parts, equal tracks, and what it says without a GPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "experiments" / "benchmarks" / "many_runs.py"

pytestmark = pytest.mark.slow


def benchmark(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    # Scripts find the package of this checkout first, as the tests do.
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    environment = (environment or os.environ) | {"PYTHONPATH": paths}
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def check_parts(seconds: dict[str, float]) -> None:
    totals = ("not the swarm", "total")
    assert seconds["not the swarm"] == pytest.approx(seconds["total"] - seconds["swarm"])
    assert sum(value for name, value in seconds.items() if name not in totals) == pytest.approx(
        seconds["total"]
    )
    assert all(
        seconds[name] > 0 for name in ("blocks without iterations", "births", "camera errors", *totals)
    )


def test_without_a_gpu_a_line_says_what_to_do(tmp_path):
    # An empty list of visible devices hides a GPU from JAX.
    hidden = environment_without_jax_settings() | {"CUDA_VISIBLE_DEVICES": ""}
    done = benchmark("gpu", "--data", tmp_path / "data", **hidden)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("bench-gpu: no GPU is there")
    assert "gpu --device cpu --small" in line
    assert "'.[cuda]'" in line
    assert not (tmp_path / "data").exists()


def test_many_runs_and_one_run_are_timed_part_by_part(tmp_path):
    path = tmp_path / "figures.json"
    done = benchmark("batch", "--small", "--data", tmp_path / "data", "--json", path)
    assert done.returncode == 0, done.stderr
    figures = json.loads(path.read_text())
    assert figures["runs"] == 3
    assert figures["shape"][:2] == [12, 8]
    for name in ("one_s", "many_s"):
        check_parts(figures[name])
    assert figures["ratio"] == pytest.approx(figures["many_s"]["total"] / figures["one_s"]["total"])
    assert "all that is not the swarm takes" in done.stdout


def test_side_by_side_the_tracks_are_those_of_two_cores(tmp_path):
    """The figures of time say nothing here; the tracks must be the same."""
    path = tmp_path / "figures.json"
    words = ("gpu", "--device", "cpu", "--small", "--data", tmp_path / "data")
    done = benchmark(*words, "--json", path)
    assert done.returncode == 0, done.stderr
    figures = json.loads(path.read_text())
    (runs,) = figures["runs"]
    assert runs["other_identities"] == runs["other_statuses"] == 0
    # As `test_side_by_side`: a fraction of a silhouette's cell, whatever the rounding.
    assert runs["median_mm"] <= 0.5
    assert runs["runs"] > runs["cpu_runs"]
    check_parts(runs["seconds"])
    check_parts(runs["cpu_seconds"])
    assert runs["ratio"] == pytest.approx(3 / runs["seconds"]["total"] / (2 / runs["cpu_seconds"]["total"]))
    assert figures["grid"]["cells"] == 2
    assert 0 < figures["grid"]["swarm_s"] < figures["grid"]["total_s"]

    wrong = benchmark(*words, "--only", "S99")
    assert wrong.returncode == 2
    assert wrong.stderr.endswith("--only: expected some of S01_D2_A, grid, found S99\n")
