"""Sweeps for commands, notebooks and scripts: run a grid, and return its results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from psotrack.support import Report, report_of, user_cache
from psotrack.sweep.cluster import Cluster, run_on_cluster
from psotrack.sweep.grid_files import Grid, read_grid
from psotrack.sweep.grid_files import grid as grid_of
from psotrack.sweep.runner import SweepOutcome, run_in_process


def sweep(
    grid: Grid | Path | str | Mapping[str, Any],
    out: Path | str,
    *,
    data: Path | str = "data",
    cache: Path | str | None = None,
    jobs: int | None = None,
    cluster: Cluster | str | None = None,
    progress: bool | Report = False,
) -> SweepOutcome:
    """Track with every combination of a grid's settings, and keep one row per run.

    Finished cells in `out` are not run again: the same call takes seconds the second time, and a call with a larger
    grid runs only the new cells. Other programs may work on the same folder at the same time.

    Args:
        grid: a grid, its TOML file, or a mapping with the same content.
        out: folder of the results.
        data: root folder of the sequences that the grid names.
        cache: folder of the stored silhouettes; None takes the user's cache folder.
        jobs: number of processes that make silhouettes; None is one per processor.
        cluster: a `Cluster`, "local" for a cluster on this machine, the address of a Dask scheduler, or None for this
            process. With a local cluster, scripts must make this call below `if __name__ == "__main__":`.
        progress: whether to show a progress bar for the cells; or a function that shows the progress.

    Returns:
        The outcome; its `rows()` are a pandas frame with the grid's cells and seeds, in the grid's order. Settings are
        columns with dots
        (`settings.swarm.particles`), and metrics have units in their names. `seconds.*`, `device.*`, `versions.*` and
        `commit` record the time and the origin of a row. `real_time_factor` is seconds of video per second of wall
        clock of a run's share of its batch, with stored silhouettes; `real_time_factor_running` is the same without
        compilation. `attrs["errors"]` lists failed cells by title.

    Raises:
        InputError: a sequence does not exist.
        SettingsError: a value of the grid is wrong.
        OutputError: the results cannot be written.

    Example:
        How the error falls with the number of particles:

            outcome = sweep(
                {"sequences": ["S02_D4_A"], "runs": 5, "grid": {"swarm.particles": [20, 50, 100]}},
                out="results", data="data", cache="cache", progress=True,
            )
            outcome.rows().groupby("settings.swarm.particles")["mean_error_m"].agg(["mean", "std"])
    """
    read = read_grid(Path(grid)) if isinstance(grid, Path | str) else grid
    read = read if isinstance(read, Grid) else grid_of(read)
    cache, report = user_cache() if cache is None else cache, report_of(progress)
    if cluster is None:
        return run_in_process(read, out, data=data, cache=cache, jobs=jobs, report=report)
    cluster = Cluster(cluster) if isinstance(cluster, str) else cluster
    return run_on_cluster(read, out, data=data, cache=cache, cluster=cluster, report=report)
