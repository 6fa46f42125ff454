"""Run the unfinished cells of a grid, in this process or on a cluster: for programs, notebooks and the command line."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Generator, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from psotrack.errors import InputError, PsotrackError
from psotrack.support import POLL_S, Report, html_block, html_table, report_of, user_cache
from psotrack.sweeps.cells import Cell, cameras_label, cell_key, cell_name, title
from psotrack.sweeps.grid_files import Grid, read_grid
from psotrack.sweeps.grid_files import grid as grid_of
from psotrack.sweeps.inputs import Inputs, folder_of, provenance, source_of
from psotrack.sweeps.runner import Cluster, Result, finished_before, run_cell, run_on_cluster, store_failure
from psotrack.sweeps.store import Store
from psotrack.sweeps.tables import DESCRIBING


@dataclass(frozen=True)
class SweepOutcome:
    """Results of all cells, in the grid's order, and where they are stored."""

    results: tuple[Result, ...]
    store: Store

    def count(self, state: str) -> int:
        """Number of cells whose result has a state."""
        return sum(result.state == state for result in self.results)

    def to_dict(self) -> dict[str, int]:
        """Numbers of cells that were finished, that failed, and that an earlier run had finished."""
        return {state: self.count(state) for state in ("finished", "failed", "left")}

    def __str__(self) -> str:
        failed = self.count("failed")
        said = (
            f"{self.store.folder}: {self.count('finished')} cells finished now, {self.count('left')} before"
        )
        return f"{said}, {failed} failed (see {self.store.folder}/cells/*.error.json)" if failed else said

    def _repr_html_(self) -> str:
        """What a notebook shows: what differs between the rows, and their mean errors."""
        rows = self.rows()
        described = [name for name in map(str, rows) if name.startswith(DESCRIBING)]
        names = [name for name in described if rows[name].astype(str).nunique() > 1]
        names += ["seed", "mean_error_m", "missed_rate"]
        return html_block(f"{self}", html_table(names, rows[names].astype(str).to_numpy().tolist()))

    @property
    def errors(self) -> list[str]:
        """One line per failed cell: the cell's title and why it failed."""
        return [f"{title(result.cell)}: {result.error}" for result in self.results if result.error]

    def rows(self) -> pd.DataFrame:
        """Rows of the grid's cells and seeds only, in the grid's order; `attrs["errors"]` has the failed cells.

        Raises:
            InputError: every cell failed.
        """
        seeds = {each.key: each.cell.seeds for each in self.results if each.key and not each.error}
        if not seeds:
            found = f"that all failed: {self.errors[0]}"
            raise InputError(self.store.folder, expected="a cell that can be run", found=found)
        rows = self.store.rows(seeds)
        rows.attrs["errors"] = self.errors
        return rows


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
    grid runs only the new cells. Several programs may work on one folder at the same time: the function waits for cells
    that other programs work on, and runs these cells when the other programs were killed.

    Args:
        grid: a grid, its TOML file, or a mapping with the same content.
        out: folder of the results (see `Store`).
        data: root folder of the sequences that the grid names.
        cache: folder of the stored silhouettes, and of a cluster's compiled programs; None takes the user's cache
            folder.
        jobs: number of processes that make silhouettes; None is one per processor.
        cluster: a `Cluster`, "local" for a cluster on this machine, the address of a Dask scheduler, or None for this
            process. All workers must see `out`, `data` and `cache` under the same paths. With a local cluster, scripts
            must make this call below `if __name__ == "__main__":`.
        progress: whether to show a progress bar for the cells; or a function that shows the progress.

    Returns:
        The outcome; its `rows()` are a pandas frame with the grid's cells and seeds, in the grid's order. Settings are
        columns with dots (`settings.swarm.particles`), and metrics have units in their names. `seconds.*`, `device.*`,
        `versions.*` and `commit` record the time and the origin of a row. `real_time_factor` is seconds of video per
        second of wall clock of a run's part of its batch, with stored silhouettes; `real_time_factor_running` is the
        same without compilation. `attrs["errors"]` lists failed cells by title.

    Raises:
        InputError: a sequence does not exist, or there is no cluster at the address.
        SettingsError: a value of the grid is wrong.
        OutputError: the results cannot be written.

    Example:
        How the error falls with the number of particles:

            outcome = sweep(
                {"sequences": ["S02_D4_A"], "runs": 5, "grid": {"swarm.particles": [20, 50, 100]}},
                out="results", data="data", progress=True,
            )
            outcome.rows().groupby("settings.swarm.particles")["mean_error_m"].agg(["mean", "std"])
    """
    if not isinstance(grid, Grid):
        grid = read_grid(Path(grid)) if isinstance(grid, Path | str) else grid_of(grid)
    cluster = Cluster(cluster) if isinstance(cluster, str) else cluster
    cache = user_cache() if cache is None else cache
    for sequence in grid.sequences:
        folder_of(sequence, Path(data))
    origin = provenance()
    if cluster is not None:
        # Each row names the device on which it was made, which may differ from this one.
        origin = {name: value for name, value in origin.items() if name != "device"} | {"cluster": True}
    store, inputs = Store(out), Inputs(Path(data), Path(cache), jobs)
    store.tidy()
    content = {name: value for name, value in asdict(grid).items() if name != "where"}
    store.add_run({"grid": content, "cells": len(grid.cells()), **origin})
    results, cells = _sort_out(grid, inputs, store)
    if cluster is None:
        more = _run_here(cells, inputs, store)
    else:
        more = run_on_cluster(cluster, cells, inputs, store)
    with report_of(progress)("sweep", len(cells)) as advance, contextlib.closing(more):
        for result in more:
            results.append(result)
            advance(1)
    order = {cell_name(cell): number for number, cell in enumerate(grid.cells())}
    return SweepOutcome(tuple(sorted(results, key=lambda result: order[cell_name(result.cell)])), store)


def _run_here(cells: list[Cell], inputs: Inputs, store: Store) -> Generator[Result, None, None]:
    """Yield the result of each cell when it ends."""
    while cells:
        busy = []
        for cell in cells:
            result = run_cell(cell, inputs, store)
            if result.state == "busy":
                busy.append(cell)
            else:
                yield result
        if len(busy) == len(cells):
            time.sleep(POLL_S)
        cells = busy


def _sort_out(grid: Grid, inputs: Inputs, store: Store) -> tuple[list[Result], list[Cell]]:
    """Results of the cells that are finished or cannot be read, and the other cells, sorted by their input."""
    results, cells = [], []
    for cell in _by_input(grid.cells()):
        try:
            result = finished_before(cell, cell_key(cell, inputs.keys_of(cell)), store)
        except PsotrackError as error:
            result = store_failure(cell, None, error, store)
        if result is None:
            cells.append(cell)
        else:
            results.append(result)
    return results, cells


def _by_input(cells: Iterable[Cell]) -> list[Cell]:
    """Put cells with the same input next to each other; the order stays the grid's otherwise."""
    groups: dict[Any, list[Cell]] = {}
    for cell in cells:
        groups.setdefault((source_of(cell), cell.cameras, cell.perturbation), []).append(cell)
    return [cell for group in groups.values() for cell in group]


@dataclass(frozen=True)
class SweepPlan:
    """What a sweep would run of a grid; its text is what `psotrack sweep --dry-run` prints.

    Attributes:
        cells: what describes each cell.
        finished: number of cells that are finished.
        runs: number of runs that are not finished, of cells whose input can be read.
        faults: why the input of a cell cannot be read, for each such cell.
    """

    cells: tuple[dict[str, Any], ...]
    finished: int
    runs: int
    faults: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All numbers and words, fit for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        cells = (
            f"{number:4} " + " ".join(f"{name}={value}" for name, value in cell.items())
            for number, cell in enumerate(self.cells)
        )
        faults = (f"cannot be read: {fault}" for fault in dict.fromkeys(self.faults))
        unread = f", {len(self.faults)} cannot be read" if self.faults else ""
        to_run = f"{len(self.cells) - self.finished - len(self.faults)} to run ({self.runs} runs)"
        return "\n".join(
            [*cells, *faults, f"{len(self.cells)} cells: {self.finished} finished{unread}, {to_run}"]
        )


def plan(grid: Grid, inputs: Inputs, store: Store) -> SweepPlan:
    """What a sweep would run, without running a cell.

    Args:
        grid: the grid.
        inputs: inputs of the cells.
        store: stored results; its folder need not exist.
    """
    listed, missing, faults = [], [], []
    for cell in grid.cells():
        about = {"sequence": cell.sequence, "method": cell.method, "cameras": cameras_label(cell.cameras)}
        listed.append({**about, "runs": cell.runs, **cell.axes})
        try:
            key = cell_key(cell, inputs.keys_of(cell))
        except PsotrackError as error:
            faults.append(f"{error}")
        else:
            missing.append(len(set(cell.seeds) - store.finished_seeds(key)))
    return SweepPlan(tuple(listed), missing.count(0), sum(missing), tuple(faults))
