"""Run the unfinished cells of a grid, one batch of runs per cell, and store their rows."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pandas as pd

from psotrack.errors import InputError, OutputError, PsotrackError
from psotrack.evaluation import Evaluation, errors_over_time, evaluate
from psotrack.pipeline import TrackedRecording, track_runs, with_real_time
from psotrack.settings import flatten
from psotrack.support import Report, drop_programs_if_many, html_block, html_table, no_progress
from psotrack.sweep.cells import Cell, cell_key, cell_name, describe, input_digest, title
from psotrack.sweep.grid_files import Grid
from psotrack.sweep.inputs import Input, Inputs, folder_of, source_of
from psotrack.sweep.locks import POLL_S
from psotrack.sweep.machine import provenance
from psotrack.sweep.manifest import note_input, note_run
from psotrack.sweep.store import Store
from psotrack.sweep.tables import DESCRIBING

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """Result of an attempt to run a cell.

    Attributes:
        cell: the cell.
        state: "finished" or "failed" in this attempt, "left" as an earlier run had finished the cell, or "busy" because
            another process works on the cell.
        key: key of the cell's rows; None where the input cannot be read.
        error: why the cell failed; "" if it did not fail.
    """

    cell: Cell
    state: Literal["finished", "failed", "left", "busy"]
    key: str | None
    error: str = ""


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


def run_in_process(
    grid: Grid,
    out: Path | str,
    *,
    data: Path | str,
    cache: Path | str,
    jobs: int | None = None,
    report: Report = no_progress,
) -> SweepOutcome:
    """Run the unfinished cells of a grid, one after the other. Several runners on one folder share the work.

    The function returns when every cell is finished or has failed. It waits for cells that other runners work on, and
    runs these cells when the other runners were killed.

    Args:
        grid: the cells to run.
        out: folder of the results (see `Store`).
        data: root folder of the sequences that the grid names.
        cache: folder of the stored silhouettes.
        jobs: number of processes that make silhouettes; None is one per processor.
        report: progress bar for the cells that are not finished.

    Raises:
        InputError: a sequence does not exist.
        OutputError: the results cannot be written.
    """
    store, inputs = open_store(grid, out, data, provenance()), Inputs(Path(data), Path(cache), jobs)
    results, waiting = sort_out(grid, inputs, store)
    with report("sweep", len(waiting)) as advance:
        while waiting:
            busy = []
            for cell in waiting:
                result = run_cell(cell, inputs, store)
                if result.state == "busy":
                    busy.append(cell)
                else:
                    results.append(result)
                    advance(1)
            if len(busy) == len(waiting):
                time.sleep(POLL_S)
            waiting = busy
    return outcome(grid, results, store)


def outcome(grid: Grid, results: Iterable[Result], store: Store) -> SweepOutcome:
    """Sort results into the order of the grid's cells."""
    order = {cell_name(cell): number for number, cell in enumerate(grid.cells())}
    return SweepOutcome(tuple(sorted(results, key=lambda result: order[cell_name(result.cell)])), store)


def open_store(grid: Grid, out: Path | str, data: Path | str, origin: Mapping[str, Any]) -> Store:
    """Open the folder of a grid's results, and record in the manifest that the grid is run.

    Args:
        grid: the grid.
        out: folder of the results.
        data: root folder of the sequences that the grid names.
        origin: versions, device, code and commit.

    Raises:
        InputError: a sequence does not exist.
        OutputError: the folder cannot be written.
    """
    for sequence in grid.sequences:
        folder_of(sequence, Path(data))
    store = Store(out)
    store.tidy()
    store.change_manifest(lambda manifest: note_run(manifest, grid, origin))
    return store


def sort_out(grid: Grid, inputs: Inputs, store: Store) -> tuple[list[Result], list[Cell]]:
    """Results of the cells that are finished or cannot be read, and the other cells, sorted by their input.

    The manifest notes the inputs of all cells, so that results of these inputs are those that count.
    """
    results, cells, noted = [], [], {}
    for cell in _by_input(grid.cells()):
        try:
            keys = inputs.keys_of(cell)
        except PsotrackError as error:
            results.append(store_failure(cell, None, error, store))
            continue
        noted[input_digest(keys)] = cell, keys
        result = _finished(cell, cell_key(cell, keys), store)
        if result is None:
            cells.append(cell)
        else:
            results.append(result)

    def note(manifest: dict[str, Any]) -> None:
        for cell, keys in noted.values():
            note_input(manifest, cell, keys)

    store.change_manifest(note)
    return results, cells


def _by_input(cells: Iterable[Cell]) -> list[Cell]:
    """Put cells with the same input next to each other; the order stays the grid's otherwise."""
    groups: dict[Any, list[Cell]] = {}
    for cell in cells:
        groups.setdefault((source_of(cell), cell.cameras, cell.perturbation), []).append(cell)
    return [cell for group in groups.values() for cell in group]


def _finished(cell: Cell, key: str, store: Store) -> Result | None:
    """Result of a cell that is finished already; None if runs are missing."""
    if not set(cell.seeds) <= store.finished_seeds(key):
        return None
    # The runner that finished the cell may have been killed before it removed the record of an earlier failure.
    store.remove_failure(cell_name(cell))
    return Result(cell, "left", key)


def run_cell(cell: Cell, inputs: Inputs, store: Store) -> Result:
    """Run a cell's missing runs, unless another process works on the cell; an error is stored as the cell's failure.

    Raises:
        OutputError: the results cannot be written.
    """
    key = None
    try:
        keys = inputs.keys_of(cell)
        key = cell_key(cell, keys)
        with store.lock(key) as locked:
            # Another process may have finished the cell meanwhile.
            result = _finished(cell, key, store)
            if result is not None:
                return result
            given = inputs.read(cell) if locked else None
            if given is None:
                return Result(cell, "busy", key)
            missing = sorted(set(cell.seeds) - store.finished_seeds(key))
            origin = {"cell": key, "input": input_digest(keys)} | dict(flatten(provenance()))
            store.add(key, *_run_seeds(cell, missing, given, origin))
            store.remove_failure(cell_name(cell))
        return Result(cell, "finished", key)
    except OutputError:
        raise
    except Exception as error:
        return store_failure(cell, key, error, store)


def store_failure(cell: Cell, key: str | None, error: Exception, store: Store) -> Result:
    """Store why a cell failed; an error that psotrack does not expect is stored with its traceback."""
    expected = isinstance(error, PsotrackError)
    sentence = f"{error}" if expected else f"{type(error).__name__}: {error}"
    where = {} if expected else {"where": "".join(traceback.format_exception(error))}
    store.add_failure(cell_name(cell), sentence, describe(cell) | where)
    logger.error("%s: %s", title(cell), sentence)
    return Result(cell, "failed", key, sentence)


def _run_seeds(
    cell: Cell, seeds: list[int], given: Input, origin: Mapping[str, Any]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Track and evaluate with each seed: one row per run, and the errors of every run's frames."""
    # Cells with other shapes need other programs.
    drop_programs_if_many()
    settings = [msgspec.structs.replace(cell.settings, seed=seed) for seed in seeds]
    began = time.perf_counter()
    results = track_runs(given.recording, given.silhouettes, settings)
    total_s = time.perf_counter() - began
    reference = given.reference(cell.settings.rate_hz)
    of_cell = describe(cell) | {"frames": given.recording.num_frames, "num_cameras": len(given.recording.rig)}
    of_batch = {"runs_in_batch": len(seeds), "seconds.batch": total_s}
    rows, errors = [], []
    for seed, result in zip(seeds, results, strict=True):
        of_run: dict[str, Any] = dict.fromkeys(_METRICS, np.nan) | {"missed_rate": 1.0}
        errors_of_run = pd.DataFrame({"seed": pd.Series(dtype=int)})
        # A run that finds no drones has missed all drones. All runs have the same columns, so that programs can read
        # all cells as one data set.
        if isinstance(result, InputError):
            of_run["note"] = str(result)
        else:
            evaluation = evaluate(result.trajectories, reference).to_dict()
            of_run |= {name: evaluation[name] for name in _METRICS if evaluation[name] is not None}
            of_run |= {"note": ""} | _times(result, total_s / len(seeds))
            errors_of_run = errors_over_time(result.trajectories, reference).assign(seed=seed)
            errors_of_run["error_m"] = errors_of_run["error_m"].astype(np.float32)
        rows.append(of_cell | {"seed": seed} | of_batch | of_run | dict(origin))
        errors.append(errors_of_run)
    return pd.DataFrame(rows), pd.concat(errors)


#: Figures of the evaluation that are columns of the rows.
_METRICS = [each.name for each in fields(Evaluation) if each.name not in ("frames", "per_drone")]


def _times(result: TrackedRecording, wall_s: float) -> dict[str, float]:
    """How long a run took.

    Args:
        result: result of the run.
        wall_s: the run's share of the seconds of wall clock of all runs.
    """
    seconds = result.record["seconds"]
    # A sweep reads stored silhouettes and starts once for all cells, so neither is in the seconds of a run.
    timed = with_real_time(result.record, wall_s)
    return {
        **{f"seconds.{stage}": value for stage, value in seconds.items()},
        **{name: timed[name] for name in ("real_time_factor", "real_time_factor_running")},
        "track_ms_per_frame": 1e3 * seconds["track"] / result.trajectories.num_frames,
    }
