"""Sweeps through the command line, on a small simulated sequence: cells, rows, resuming, failures, tables."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

GRID = """
sequences = ["S02_D4_A"]
runs = 2
[settings]
particles = 8
silhouettes.reduction = 2
[methods.paper]
swarm = "joint"
score = "hard"
[methods.ours]
[grid]
iterations = [3, 6]
"""


def psotrack(root: Path, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "psotrack", *map(str, words)],
        capture_output=True,
        text=True,
        env=os.environ | {"PSOTRACK_CACHE": str(root / "cache")},
        check=False,
    )


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the small sequence, a grid and its results."""
    root = tmp_path_factory.mktemp("sweep")
    made = psotrack(
        root, "simulate", "S02_D4_A", "--out", root, "--scale", 0.35, "--frames", 12, "--no-onboard"
    )
    assert made.returncode == 0, made.stderr
    (root / "grid.toml").write_text(GRID)
    done = psotrack(root, "sweep", root / "grid.toml", "--data", root, "--out", root / "results")
    assert done.returncode == 0, done.stderr
    assert "4 cells finished now, 0 before" in done.stdout
    return root


@pytest.mark.slow
def test_one_row_per_cell_and_run(swept: Path) -> None:
    rows = pd.concat(pd.read_parquet(path) for path in (swept / "results" / "cells").glob("*.parquet"))
    combinations = set(zip(rows["method"], rows["settings.iterations"], rows["seed"], strict=True))
    assert combinations == {(m, i, s) for m in ("paper", "ours") for i in (3, 6) for s in (0, 1)}
    assert len(rows) == 8
    assert set(rows["settings.score"][rows["method"] == "paper"]) == {"hard"}
    assert (rows["mean_error_m"] < 0.2).all()
    assert {"seconds.track", "versions.jax", "device.kind", "perturbation.flipped"} <= set(rows.columns)


@pytest.mark.slow
def test_what_is_finished_is_not_run_again(swept: Path) -> None:
    cells = swept / "results" / "cells"
    before = {path: path.stat().st_mtime_ns for path in cells.iterdir()}
    again = psotrack(swept, "sweep", swept / "grid.toml", "--data", swept, "--out", swept / "results")
    assert "0 cells finished now, 4 before" in again.stdout
    assert {path: path.stat().st_mtime_ns for path in cells.iterdir()} == before


@pytest.mark.slow
def test_a_cell_that_fails_does_not_stop_the_others(swept: Path) -> None:
    (swept / "poor.toml").write_text(
        'sequences = ["S02_D4_A"]\n[settings]\nparticles = 8\niterations = 3\nsilhouettes.reduction = 2\n'
        '[grid]\ncameras = [["nowhere"], "all"]\n'
    )
    out = swept / "poor"
    result = psotrack(swept, "sweep", swept / "poor.toml", "--data", swept, "--out", out)
    assert result.returncode == 2
    assert "1 cells finished now" in result.stdout
    status = psotrack(swept, "sweep", "--status", out)
    assert "nowhere" in status.stdout
    assert "1 finished, 1 failed, 0 claimed" in status.stdout


@pytest.mark.slow
def test_a_table_of_the_results(swept: Path) -> None:
    words = ("table", swept / "results", "--rows", "iterations", "--columns", "method", "--format", "csv")
    table = psotrack(swept, *words)
    assert table.returncode == 0, table.stderr
    assert "paper" in table.stdout
    assert "ours" in table.stdout
    wrong = psotrack(swept, "table", swept / "results", "--value", "mean_eror_m")
    assert wrong.returncode == 2
    assert wrong.stderr.count("\n") == 1
    assert "mean_error_m" in wrong.stderr


def test_a_dry_run_shows_the_cells(tmp_path: Path) -> None:
    (tmp_path / "grid.toml").write_text(GRID)
    result = psotrack(tmp_path, "sweep", tmp_path / "grid.toml", "--dry-run")
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "4 cells, 8 runs"
    (tmp_path / "grid.toml").write_text(GRID.replace("iterations", "iteratons"))
    result = psotrack(tmp_path, "sweep", tmp_path / "grid.toml", "--dry-run")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "iterations" in result.stderr
