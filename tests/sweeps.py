"""Shared by the tests of sweeps: a very small sequence, whose program is compiled once, and ways to run psotrack."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from helpers import make_once

#: All cells use one compiled program: the number of iterations is no shape.
GRID = """
sequences = ["S01_D2_A"]
runs = {runs}
[settings]
swarm.particles = 8
swarm.kind = "joint"
score.kind = "hard"
init = "truth"
drones.size_m = [0.5, 0.5, 0.2]
silhouettes.reduction = 2
[grid]
swarm.iterations = {iterations}
"""

#: Compiled programs are stored per number of devices, so one device is set, with the suite's settings of XLA.
COMPILER = {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=1"}


def grid_file(folder: Path, iterations: list[int], runs: int = 1) -> Path:
    """Write a grid with one cell per number of iterations."""
    path = folder / f"grid_{len(iterations)}_{runs}.toml"
    path.write_text(GRID.format(iterations=iterations, runs=runs))
    return path


def environment(root: Path) -> dict[str, str]:
    """Environment of commands that use the cache in the small sequence's folder."""
    return os.environ | COMPILER | {"PSOTRACK_CACHE": str(root / "cache")}


def python(root: Path, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
    """Run `python WORDS` with the caches in the small sequence's folder, and wait until it has ended.

    No test kills a process from outside: a process that is to be killed kills itself at a place in the program.
    """
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment(root) | more, check=False)


def psotrack(root: Path, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
    """Run `psotrack WORDS` with the caches in the small sequence's folder, and wait until it has ended."""
    return python(root, "-m", "psotrack", *words, **more)


def small_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a sequence of two drones, and caches with its silhouettes and its compiled program.

    The folder is made once per session, so that a run in a test takes seconds.
    """

    def make(root: Path) -> None:
        made = psotrack(
            root, "simulate", "S01_D2_A", "--out", root, "--scale", 0.25, "--frames", 6, "--no-onboard"
        )
        assert made.returncode == 0, made.stderr
        swept = psotrack(root, "sweep", grid_file(root, [2]), "--data", root, "--out", root / "warm_results")
        assert swept.returncode == 0, swept.stderr

    return make_once(tmp_path_factory, "small_sequence", make)


#: Names of settings that version 0.1 stored in columns and manifests, by today's name. `silhouettes.reduction` and
#: others are called the same.
OLDER_NAMES = {
    "swarm.particles": "particles",
    "swarm.iterations": "iterations",
    "swarm.kind": "swarm",
    "swarm.spread_m": "spread_m",
    "swarm.inertia": "inertia",
    "swarm.cognitive": "cognitive",
    "swarm.social": "social",
    "score.kind": "score",
    "score.windows": "windows",
    "score.occlusion": "claims",
    "score.vertex": "vertex",
    "drones.count": "drones",
    "drones.size_m": "drone_size_m",
    "drones.learn_sizes": "learn_sizes",
    "drones.body_offset_m": "body_offset_m",
    "motion.max_speed_m_s": "max_speed_m_s",
    "motion.jerk_density_m2_s5": "jerk_density_m2_s5",
    "motion.velocity_std_m_s": "velocity_std_m_s",
    "motion.acceleration_std_m_s2": "acceleration_std_m_s2",
    "motion.error_share": "error_share",
    "motion.error_time_s": "error_time_s",
    "status.min_fitness": "min_fitness",
    "status.min_cameras": "min_cameras",
    "status.max_coasting_s": "max_coasting_s",
    "identity.encounter_m": "encounter_m",
    "identity.resolve_swaps": "mend",
}


#: Settings that version 0.1 lacked.
NEW_NAMES = (
    "swarm.search",
    "status.min_cameras_to_begin",
    "status.max_coasting_std_m",
    "rate_hz",
    "silhouettes.background",
    "silhouettes.drone_px",
    "clocks",
    "errors.rig_deg",
    "errors.pixel_px",
)


def make_older(results: Path, older_keys: dict[str, str]) -> None:
    """Turn a folder of results into a folder as version 0.1 wrote it.

    Args:
        results: the folder.
        older_keys: today's keys of all finished cells -> keys of the same cells in version 0.1.
    """
    columns = {f"settings.{today}": f"settings.{older}" for today, older in OLDER_NAMES.items()}
    (results / "errors").mkdir()
    for key, older_key in older_keys.items():
        rows = pd.read_parquet(results / "cells" / f"{key}.parquet")
        rows = rows.drop(columns=[f"settings.{name}" for name in NEW_NAMES])
        rows = rows.rename(columns=columns).assign(**{"settings.refinements": 0, "cell": older_key})
        rows.to_parquet(results / "cells" / f"{older_key}.parquet", index=False)
        (results / "cells" / f"{key}.parquet").unlink()
        (results / "_errors" / f"{key}.parquet").rename(results / "errors" / f"{older_key}.parquet")
    (results / "_errors").rmdir()
    manifest = json.loads((results / "_manifest.json").read_text())
    # Version 0.1 wrote no digest.
    manifest.pop("digest", None)
    for run in manifest["runs"]:
        for part in ("settings", "axes"):
            values = run["grid"][part]
            run["grid"][part] = {OLDER_NAMES.get(name, name): value for name, value in values.items()}
    (results / "manifest.json").write_text(json.dumps(manifest))
    (results / "_manifest.json").unlink()


def all_rows(results: Path) -> pd.DataFrame:
    """Rows of every finished cell, read without psotrack."""
    files = [path for path in (results / "cells").glob("*.parquet") if not path.name.startswith(".")]
    return pd.concat([pd.read_parquet(path) for path in files], ignore_index=True)


def stamps(results: Path) -> dict[str, tuple[int, int]]:
    """Inode and modification time of each finished cell's file; clocks of file systems may be coarse."""
    found = [path for path in (results / "cells").glob("*.parquet") if path.name[0] != "."]
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in found}
