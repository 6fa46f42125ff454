"""Shared by the tests of sweeps: a very small sequence, whose program is compiled once."""

import json
import os
import time

import pandas as pd
from helpers import made_once

from psotrack.simulation import SimulationSettings, simulate
from psotrack.sweeps import sweep

#: Settings of all cells, which use one compiled program: the number of iterations is no shape.
SETTINGS = {
    "swarm.particles": 8,
    "swarm.kind": "joint",
    "score.kind": "hard",
    "init": "truth",
    "drones.size_m": [0.5, 0.5, 0.2],
    "silhouettes.reduction": 2,
}
_LINES = "\n".join(f"{name} = {json.dumps(value)}" for name, value in SETTINGS.items())
GRID = f"""
sequences = ["S01_D2_A"]
runs = {{runs}}
[settings]
{_LINES}
[grid]
swarm.iterations = {{iterations}}
"""

#: Compiled programs are stored per number of devices, so one device is set, with the suite's settings of XLA.
COMPILER = {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=1"}


def grid_file(folder, iterations, runs=1):
    """Write a grid with one cell per number of iterations."""
    path = folder / f"grid_{len(iterations)}_{runs}.toml"
    path.write_text(GRID.format(iterations=iterations, runs=runs))
    return path


def environment(root):
    """Environment of commands that use the cache in the small sequence's folder."""
    return os.environ | COMPILER | {"PSOTRACK_CACHE": str(root / "cache")}


def wait_until(happened):
    """Wait until `happened()` is true; the limit of five minutes is for tests that hang, not for slow machines."""
    end_s = time.monotonic() + 300
    while not happened():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def make_small_sequence(root):
    """A data folder with a sequence of two drones, and caches with its silhouettes and its compiled program."""
    simulate("S01_D2_A", root, SimulationSettings(num_frames=6, scale=0.25, onboard=False), jobs=1)
    swept = sweep(grid_file(root, [2]), root / "warm_results", data=root, cache=root / "cache", jobs=1)
    assert swept.count("finished") == 1, swept.errors


#: A fixture: the folder is made once per session, so that a run in a test takes seconds.
small_sequence = made_once("small_sequence", make_small_sequence)


def all_rows(results):
    """Rows of every finished cell, read without psotrack."""
    files = [path for path in (results / "cells").glob("*.parquet") if not path.name.startswith(".")]
    return pd.concat([pd.read_parquet(path) for path in files], ignore_index=True)


def stamps(results):
    """Inode and content of each finished cell's file; a use changes the file's time."""
    found = [path for path in (results / "cells").glob("*.parquet") if path.name[0] != "."]
    return {path.name: (path.stat().st_ino, path.read_bytes()) for path in found}
