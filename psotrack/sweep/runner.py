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
from psotrack.support import Report, drop_programs_if_many, no_progress
from psotrack.sweep.cells import Cell, cell_key, failure_name, title
from psotrack.sweep.grid_files import Grid, cameras_label
from psotrack.sweep.inputs import Input, Inputs, folder_of, input_digest, source_of
from psotrack.sweep.locks import POLL_S
from psotrack.sweep.machine import provenance
from psotrack.sweep.manifest import note_input, note_run
from psotrack.sweep.store import Store

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
    """Results of all cells, in the grid's order."""

    results: tuple[Result, ...]

    def count(self, state: str) -> int:
        """Number of cells whose result has a state."""
        return sum(result.state == state for result in self.results)

    @property
    def errors(self) -> list[str]:
        """One line per failed cell: the cell's title and why it failed."""
        return [f"{title(result.cell)}: {result.error}" for result in self.results if result.error]

    @property
    def seeds(self) -> dict[str, range]:
        """Seeds of the runs of each finished cell, by the cell's key."""
        finished = [result for result in self.results if result.state in ("finished", "left")]
        return {result.key: result.cell.seeds for result in finished if result.key is not None}


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
        report: progress bar for the cells.

    Raises:
        InputError: a sequence does not exist.
        OutputError: the results cannot be written.
    """
    store, inputs = open_store(grid, out, data, provenance()), Inputs(Path(data), Path(cache), jobs)
    results: list[Result] = []
    waiting = sort_by_input(grid.cells())
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
    return outcome(grid, results)


def outcome(grid: Grid, results: Iterable[Result]) -> SweepOutcome:
    """Sort results into the order of the grid's cells."""
    order = {failure_name(cell): number for number, cell in enumerate(grid.cells())}
    return SweepOutcome(tuple(sorted(results, key=lambda result: order[failure_name(result.cell)])))


def open_store(grid: Grid, out: Path | str, data: Path | str, origin: Mapping[str, Any]) -> Store:
    """Open the folder of a grid's results, and record in the manifest that the grid is run.

    Args:
        grid: the grid.
        out: folder of the results.
        data: root folder of the sequences that the grid names.
        origin: versions, device and commit.

    Raises:
        InputError: a sequence does not exist.
        OutputError: the folder cannot be written.
    """
    for sequence in grid.sequences:
        folder_of(sequence, Path(data))
    store = Store(Path(out))
    store.tidy()
    store.change_manifest(lambda manifest: note_run(manifest, grid, origin))
    return store


def sort_by_input(cells: Iterable[Cell]) -> list[Cell]:
    """Put cells with the same input next to each other; the order stays the grid's otherwise."""
    groups: dict[Any, list[Cell]] = {}
    for cell in cells:
        groups.setdefault((source_of(cell), cell.cameras, cell.perturbation), []).append(cell)
    return [cell for group in groups.values() for cell in group]


def find_finished(cell: Cell, inputs: Inputs, store: Store) -> Result | None:
    """Result of a cell that is finished already; None if runs are missing.

    Raises:
        PsotrackError: the cell's input cannot be read.
    """
    key = cell_key(cell, inputs.keys_of(cell))
    if not set(cell.seeds) <= store.finished_seeds(key):
        return None
    # The runner that finished the cell may have been killed before it removed the record of an earlier failure.
    store.remove_failure(failure_name(cell))
    return Result(cell, "left", key)


def run_cell(cell: Cell, inputs: Inputs, store: Store) -> Result:
    """Run a cell's missing runs, unless another process works on the cell; an error is stored as the cell's failure.

    Raises:
        OutputError: the results cannot be written.
    """
    key = None
    try:
        result = find_finished(cell, inputs, store)
        if result is not None:
            return result
        keys = inputs.keys_of(cell)
        key = cell_key(cell, keys)
        with store.lock(key, title(cell)) as locked:
            # Another process may have finished the cell just before this process locked it.
            missing = sorted(set(cell.seeds) - store.finished_seeds(key)) if locked else []
            given = inputs.read(cell) if missing else None
            if given is None:
                return Result(cell, "busy", key)
            store.change_manifest(lambda manifest: note_input(manifest, cell, keys))
            store.add(key, *_run_seeds(cell, key, missing, given, input_digest(keys)))
            store.remove_failure(failure_name(cell))
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
    store.add_failure(failure_name(cell), sentence, describe(cell) | where)
    logger.error("%s: %s", title(cell), sentence)
    return Result(cell, "failed", key, sentence)


def describe(cell: Cell) -> dict[str, Any]:
    """Description of a cell as a flat table, whose names have dots."""
    settings = msgspec.to_builtins(msgspec.structs.replace(cell.settings, seed=0))
    del settings["seed"]
    return {
        "sequence": Path(cell.sequence).name,
        "method": cell.method,
        "cameras": cameras_label(cell.cameras),
        "frames": cell.frames,
        **{f"perturbation.{name}": value for name, value in msgspec.to_builtins(cell.perturbation).items()},
        **{f"settings.{name}": value for name, value in flatten(settings)},
    }


def _run_seeds(
    cell: Cell, key: str, seeds: list[int], given: Input, input_name: str
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Track and evaluate with each seed: one row per run, and the errors of every run's frames."""
    # Cells with other shapes need other programs.
    drop_programs_if_many()
    settings = [msgspec.structs.replace(cell.settings, seed=seed) for seed in seeds]
    began = time.perf_counter()
    results = track_runs(given.recording, given.silhouettes, settings)
    total_s = time.perf_counter() - began
    of_cell = describe(cell) | {"frames": given.recording.num_frames, "num_cameras": len(given.recording.rig)}
    of_batch = {"runs_in_batch": len(seeds), "seconds.batch": total_s}
    origin = {"cell": key, "input": input_name} | dict(flatten(provenance()))
    runs = list(zip(seeds, results, strict=True))
    figures = [_figures(result, given, total_s / len(seeds)) for result in results]
    rows = [
        of_cell | {"seed": seed} | of_batch | of_run | origin
        for seed, of_run in zip(seeds, figures, strict=True)
    ]
    return pd.DataFrame(rows), pd.concat([_errors(seed, result, given) for seed, result in runs])


def _figures(result: TrackedRecording | InputError, given: Input, wall_s: float) -> dict[str, Any]:
    """Evaluation and duration of a run. A run that finds no drones has missed all drones.

    Args:
        result: result of the run.
        given: input of the run.
        wall_s: the run's share of the seconds of wall clock of all runs.
    """
    # All runs have the same columns, so that programs can read all cells as one data set.
    if isinstance(result, InputError):
        metrics = [field.name for field in fields(Evaluation) if field.name not in ("frames", "per_drone")]
        return dict.fromkeys(metrics, np.nan) | {"missed_rate": 1.0, "note": str(result)}
    assert given.recording.truth is not None
    errors = evaluate(result.trajectories, given.recording.truth).to_dict()
    del errors["per_drone"]
    figures = {"note": ""} | {name: np.nan if value is None else value for name, value in errors.items()}
    seconds = result.record["seconds"]
    figures |= {f"seconds.{stage}": value for stage, value in seconds.items()}
    # A sweep reads stored silhouettes and starts once for all cells, so neither is in the seconds of a run.
    timed = with_real_time(result.record, wall_s)
    figures |= {name: timed[name] for name in ("real_time_factor", "real_time_factor_running")}
    return figures | {"track_ms_per_frame": 1e3 * seconds["track"] / given.recording.num_frames}


def _errors(seed: int, result: TrackedRecording | InputError, given: Input) -> pd.DataFrame:
    """Errors of a run's frames; no rows for a run that finds no drones."""
    if isinstance(result, InputError):
        return pd.DataFrame({"seed": pd.Series(dtype=int)})
    assert given.recording.truth is not None
    errors = errors_over_time(result.trajectories, given.recording.truth)
    return errors.assign(seed=seed, error_m=errors["error_m"].astype(np.float32))
