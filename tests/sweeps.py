"""What the tests of sweeps share: a very small sequence, whose program is compiled once, and ways to run psotrack."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from helpers import make_once

#: One program for all cells, whatever the iterations.
GRID = """
sequences = ["S01_D2_A"]
runs = {runs}
[settings]
particles = 8
swarm = "joint"
score = "hard"
init = "truth"
drone_size_m = [0.5, 0.5, 0.2]
silhouettes.reduction = 2
[grid]
iterations = {iterations}
"""

#: Half the compiler's time, and none of it twice: programs are kept for a number of devices.
COMPILER = {
    "XLA_FLAGS": "--xla_force_host_platform_device_count=1",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
}


def grid_file(folder: Path, iterations: list[int], runs: int = 1) -> Path:
    """A grid of a cell per number of iterations."""
    path = folder / f"grid_{len(iterations)}_{runs}.toml"
    path.write_text(GRID.format(iterations=iterations, runs=runs))
    return path


def environment(root: Path) -> dict[str, str]:
    """Of commands that use the cache of the small sequence's folder."""
    return os.environ | COMPILER | {"PSOTRACK_CACHE": str(root / "cache")}


def python(root: Path, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
    """`python WORDS`, with the cache of the small sequence's folder, until it has ended.

    Whatever becomes of the test, no process is left to another one: there is nothing to wait for, and nothing to kill.
    What is to die dies by itself, at a place in the program; no clock says when.
    """
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment(root) | more, check=False)


def psotrack(root: Path, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
    """The same of `psotrack WORDS`."""
    return python(root, "-m", "psotrack", *words, **more)


def small_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a sequence of two drones, and a cache with its silhouettes and program; made once per session.

    Whoever tests sweeps does it after this, so that a run is seconds.
    """

    def make(root: Path) -> None:
        made = psotrack(
            root, "simulate", "S01_D2_A", "--out", root, "--scale", 0.25, "--frames", 6, "--no-onboard"
        )
        assert made.returncode == 0, made.stderr
        swept = psotrack(root, "sweep", grid_file(root, [2]), "--data", root, "--out", root / "warm_results")
        assert swept.returncode == 0, swept.stderr

    return make_once(tmp_path_factory, "small_sequence", make)


def all_rows(results: Path) -> pd.DataFrame:
    """Of every finished cell, read without psotrack."""
    files = [path for path in (results / "cells").glob("*.parquet") if not path.name.startswith(".")]
    return pd.concat([pd.read_parquet(path) for path in files], ignore_index=True)


def stamps(results: Path) -> dict[str, tuple[int, int]]:
    """Which file each finished cell is, and when it was written: some clocks of file systems tick slowly."""
    found = [path for path in (results / "cells").glob("*.parquet") if path.name[0] != "."]
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in found}
