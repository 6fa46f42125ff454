"""What a grid has still to run: a count of the cells, and their time if they take as long as the finished ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import pandas as pd

from psotrack.errors import InputError, PsotrackError
from psotrack.sweep.cells import Cell, cameras_label, cell_key
from psotrack.sweep.grid_files import Grid
from psotrack.sweep.inputs import Inputs
from psotrack.sweep.store import Store


@dataclass(frozen=True)
class Estimate:
    """What a sweep would run.

    Attributes:
        cells: number of cells of the grid.
        finished: number of cells that are finished.
        unread: number of cells whose input cannot be read.
        runs: number of runs of the other cells that are not finished.
        run_s: median time of a finished run in the folder of results, without compiling, seconds; None if there is
            none.
        faults: why inputs cannot be read, each reason once.
    """

    cells: int
    finished: int
    unread: int
    runs: int
    run_s: float | None
    faults: tuple[str, ...]

    @property
    def total_s(self) -> float | None:
        """Time of all runs, if each takes as long as a finished one, seconds; None if that is not known."""
        return None if self.run_s is None else self.runs * self.run_s

    def to_dict(self) -> dict[str, Any]:
        """All numbers, fit for JSON."""
        return asdict(self) | {"total_s": self.total_s}

    def __str__(self) -> str:
        unread = f", {self.unread} cannot be read" if self.unread else ""
        to_run = self.cells - self.finished - self.unread
        said = f"{self.cells} cells: {self.finished} finished{unread}, {to_run} to run ({self.runs} runs)"
        if not self.runs:
            return said
        if self.total_s is None:
            return f"{said}; how long they take is known when a cell is finished"
        return f"{said}, about {_in_words(self.total_s)} at {self.run_s:.2g} s per run, as the finished runs"


@dataclass(frozen=True)
class SweepPlan:
    """The cells of a grid, and what a sweep would run of them; its text is what `psotrack sweep --dry-run` prints.

    Attributes:
        cells: what describes each cell.
        estimate: what is still to run.
    """

    cells: tuple[dict[str, Any], ...]
    estimate: Estimate

    def to_dict(self) -> dict[str, Any]:
        """The cells and the estimate, fit for JSON."""
        return {"cells": list(self.cells), "estimate": self.estimate.to_dict()}

    def __str__(self) -> str:
        cells = (
            f"{number:4} " + " ".join(f"{name}={value}" for name, value in cell.items())
            for number, cell in enumerate(self.cells)
        )
        faults = (f"cannot be read: {fault}" for fault in self.estimate.faults)
        return "\n".join([*cells, *faults, f"{self.estimate}"])


def plan(grid: Grid, inputs: Inputs, store: Store | None) -> SweepPlan:
    """What a sweep would run, without running a cell.

    Args:
        grid: the grid.
        inputs: inputs of the cells.
        store: stored results; None for no results.
    """
    cells = grid.cells()
    listed = (
        {
            "sequence": cell.sequence,
            "method": cell.method,
            "cameras": cameras_label(cell.cameras),
            "runs": cell.runs,
            **cell.axes,
        }
        for cell in cells
    )
    return SweepPlan(tuple(listed), estimate(cells, inputs, store))


def estimate(cells: Iterable[Cell], inputs: Inputs, store: Store | None) -> Estimate:
    """Count the cells that are not finished.

    Args:
        cells: cells of a grid.
        inputs: inputs of the cells.
        store: stored results; None for no results.
    """
    missing, faults = [], []
    for cell in cells:
        try:
            key = cell_key(cell, inputs.keys_of(cell))
        except PsotrackError as error:
            faults.append(f"{error}")
        else:
            missing.append(len(set(cell.seeds) - (store.finished_seeds(key) if store else set())))
    count, reasons = len(missing) + len(faults), tuple(dict.fromkeys(faults))
    return Estimate(count, missing.count(0), len(faults), sum(missing), _run_s(store), reasons)


def _run_s(store: Store | None) -> float | None:
    """Median time of a finished run, seconds; the times of compiling and of silhouettes are not in it."""
    try:
        rows = store.rows() if store else pd.DataFrame()
    except InputError:
        return None
    if "seconds.batch" not in rows:
        return None
    per_run_s = rows["seconds.batch"] / rows["runs_in_batch"] - rows["seconds.compile"].fillna(0)
    return float(per_run_s.median())


def _in_words(seconds: float) -> str:
    """A time with few digits, because the estimate is rough."""
    for limit, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / unit_s:.0f} {unit}"
    return f"{seconds / 86400:.0f} days"
