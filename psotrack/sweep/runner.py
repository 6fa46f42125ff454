"""Runs the cells of a grid that nobody has finished, one batch of runs per cell, and keeps their rows."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pandas as pd

from psotrack.errors import InputError, OutputError, PsotrackError
from psotrack.evaluation import errors_over_time, evaluate
from psotrack.pipeline import TrackedSequence, track_runs
from psotrack.support import Report, no_progress
from psotrack.sweep.cells import Cell, key_of, name_of, title
from psotrack.sweep.grid_files import Grid, cameras_label
from psotrack.sweep.inputs import Input, Inputs, digest_of, folder_of, source_of
from psotrack.sweep.locks import POLL_S
from psotrack.sweep.machine import provenance
from psotrack.sweep.manifest import note_input, note_run
from psotrack.sweep.names import flat
from psotrack.sweep.store import Store

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """What became of a cell.

    Attributes:
        cell: which.
        state: "left" was finished before, "busy" is somebody else at work on it.
        key: under which its rows are; None where the input cannot be read.
        error: why it failed; "" if it did not.
    """

    cell: Cell
    state: Literal["finished", "failed", "left", "busy"]
    key: str | None
    error: str = ""


@dataclass(frozen=True)
class SweepOutcome:
    """What a runner did, cell by cell, in the grid's order."""

    results: tuple[Result, ...]

    def count(self, state: str) -> int:
        """How many cells that became of."""
        return sum(result.state == state for result in self.results)

    @property
    def errors(self) -> list[str]:
        """Cells that failed, and why."""
        return [f"{title(result.cell)}: {result.error}" for result in self.results if result.error]

    @property
    def seeds(self) -> dict[str, range]:
        """Keys of the finished cells and the seeds of their runs."""
        finished = [result for result in self.results if result.state in ("finished", "left")]
        return {result.key: result.cell.seeds for result in finished if result.key is not None}


def run(
    grid: Grid, out: Path, *, data: Path, cache: Path, jobs: int | None = None, report: Report = no_progress
) -> SweepOutcome:
    """Run what is not finished, cell by cell. Several runners on one folder share the work.

    It ends when every cell is finished or has failed: it waits for those that others are at work on, and does them if
    the others die.

    Args:
        grid: what is to be run.
        out: folder of the results (see `Store`).
        data: root folder of sequences that the grid names.
        cache: folder of the stored silhouettes.
        jobs: processes for the silhouettes; None is one per processor.
        report: told of the cells.

    Raises:
        InputError: a sequence is not there.
        OutputError: the results cannot be written.
    """
    store, inputs = opened(grid, out, data, provenance()), Inputs(data, cache, jobs)
    results: list[Result] = []
    waiting = in_order(grid.cells())
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
    return outcome_of(grid, results)


def outcome_of(grid: Grid, results: Iterable[Result]) -> SweepOutcome:
    """Results in the order of the grid's cells."""
    order = {name_of(cell): number for number, cell in enumerate(grid.cells())}
    return SweepOutcome(tuple(sorted(results, key=lambda result: order[name_of(result.cell)])))


def opened(grid: Grid, out: Path, data: Path, origin: Mapping[str, Any]) -> Store:
    """The folder of a grid's results, which says that the grid is run.

    Args:
        grid: what is to be run.
        out: the folder.
        data: root folder of sequences that the grid names.
        origin: versions, device and commit.

    Raises:
        InputError: a sequence is not there.
        OutputError: the folder cannot be written.
    """
    for sequence in grid.sequences:
        folder_of(sequence, data)
    store = Store(out)
    store.tidy()
    store.change_manifest(lambda manifest: note_run(manifest, grid, origin))
    return store


def in_order(cells: Iterable[Cell]) -> list[Cell]:
    """Cells that read the same one after the other, and as the grid has them otherwise."""
    groups: dict[Any, list[Cell]] = {}
    for cell in cells:
        groups.setdefault((source_of(cell), cell.cameras, cell.perturbation), []).append(cell)
    return [cell for alike in groups.values() for cell in alike]


def finished_before(cell: Cell, inputs: Inputs, store: Store) -> Result | None:
    """What a finished cell's result is; None for one that is to be run.

    Raises:
        PsotrackError: its input cannot be read.
    """
    key = key_of(cell, inputs.keys_of(cell))
    if not set(cell.seeds) <= store.seeds_of(key):
        return None
    store.forgive(name_of(cell))  # it may have been finished by somebody who was killed just then
    return Result(cell, "left", key)


def run_cell(cell: Cell, inputs: Inputs, store: Store) -> Result:
    """Finish a cell, unless it is finished or somebody else is at work on it. What goes wrong is kept with it.

    Raises:
        OutputError: the results cannot be written.
    """
    key = None
    try:
        result = finished_before(cell, inputs, store)
        if result is not None:
            return result
        keys = inputs.keys_of(cell)
        key = key_of(cell, keys)
        with store.claim(key, title(cell)) as ours:
            # Somebody may have finished it just before it was ours.
            missing = sorted(set(cell.seeds) - store.seeds_of(key)) if ours else []
            given = inputs.read(cell) if missing else None
            if given is None:
                return Result(cell, "busy", key)
            store.change_manifest(lambda manifest: note_input(manifest, cell, keys))
            store.add(key, *_outcomes(cell, key, missing, given, digest_of(keys)))
            store.forgive(name_of(cell))
        return Result(cell, "finished", key)
    except OutputError:
        raise
    except Exception as error:
        return failed(cell, key, error, store)


def failed(cell: Cell, key: str | None, error: Exception, store: Store) -> Result:
    """Keep why a cell failed."""
    said = isinstance(error, PsotrackError)
    sentence = f"{error}" if said else f"{type(error).__name__}: {error}"
    where = {} if said else {"where": "".join(traceback.format_exception(error))}
    store.fail(name_of(cell), sentence, about(cell) | where)
    logger.error("%s: %s", title(cell), sentence)
    return Result(cell, "failed", key, sentence)


def about(cell: Cell) -> dict[str, Any]:
    """What a cell is, flat: names with dots."""
    settings = msgspec.to_builtins(msgspec.structs.replace(cell.settings, seed=0))
    del settings["seed"]
    return {
        "sequence": Path(cell.sequence).name,
        "method": cell.method,
        "cameras": cameras_label(cell.cameras),
        "frames": cell.frames,
        **{f"perturbation.{name}": value for name, value in msgspec.to_builtins(cell.perturbation).items()},
        **{f"settings.{name}": value for name, value in flat(settings)},
    }


def _outcomes(
    cell: Cell, key: str, seeds: list[int], given: Input, input_digest: str
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """One row per run, and the errors of every run's frames."""
    settings = [msgspec.structs.replace(cell.settings, seed=seed) for seed in seeds]
    began = time.perf_counter()
    results = track_runs(given.sequence, given.silhouettes, settings)
    total_s = time.perf_counter() - began
    of_cell = about(cell) | {"frames": given.sequence.num_frames, "num_cameras": len(given.sequence.rig)}
    of_batch = {"runs_in_batch": len(seeds), "seconds.batch": total_s}
    origin = {"cell": key, "input": input_digest} | dict(flat(provenance()))
    runs = list(zip(seeds, results, strict=True))
    rows = [of_cell | {"seed": seed} | of_batch | _figures(result, given) | origin for seed, result in runs]
    return pd.DataFrame(rows), pd.concat([_errors(seed, result, given) for seed, result in runs])


def _figures(result: TrackedSequence | InputError, given: Input) -> dict[str, Any]:
    """What evaluation says of a run. A run that finds no drones has missed all of them."""
    if isinstance(result, InputError):
        return {"missed_rate": 1.0, "note": str(result)}
    assert given.sequence.truth is not None
    errors = evaluate(result.trajectories, given.sequence.truth).to_dict()
    seconds = result.record["seconds"]
    figures = {key: value for key, value in errors.items() if np.isscalar(value)}
    figures |= {f"seconds.{stage}": value for stage, value in seconds.items()}
    return figures | {"track_ms_per_frame": 1e3 * seconds["track"] / given.sequence.num_frames}


def _errors(seed: int, result: TrackedSequence | InputError, given: Input) -> pd.DataFrame:
    """Errors of a run's frames; of a run that finds no drones there are none."""
    if isinstance(result, InputError):
        return pd.DataFrame({"seed": pd.Series(dtype=int)})
    assert given.sequence.truth is not None
    errors = errors_over_time(result.trajectories, given.sequence.truth)
    return errors.assign(seed=seed, error_m=errors["error_m"].astype(np.float32))
