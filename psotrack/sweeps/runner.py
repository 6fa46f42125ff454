"""Run a cell of a grid: its missing runs as one batch, whose rows are stored."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import msgspec
import numpy as np
import pandas as pd

from psotrack.errors import InputError, OutputError, PsotrackError
from psotrack.evaluation import Evaluation, evaluate
from psotrack.pipeline import TrackedRecording, track_runs, with_real_time
from psotrack.settings import flatten
from psotrack.support import drop_programs_if_many
from psotrack.sweeps.cells import Cell, cell_key, cell_name, describe, input_digest, title
from psotrack.sweeps.inputs import Input, Inputs
from psotrack.sweeps.machine import provenance
from psotrack.sweeps.store import Store

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


def finished_before(cell: Cell, key: str, store: Store) -> Result | None:
    """Result of a cell that is finished already; None if runs are missing."""
    if not set(cell.seeds) <= store.finished_seeds(key):
        return None
    # The runner that finished the cell may have been killed before it removed the record of an earlier failure.
    store.remove_failure(cell_name(cell))
    store.use(key)
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
            result = finished_before(cell, key, store)
            if result is not None:
                return result
            given = inputs.read(cell) if locked else None
            if given is None:
                return Result(cell, "busy", key)
            missing = sorted(set(cell.seeds) - store.finished_seeds(key))
            origin = {"cell": key, "input": input_digest(keys)} | dict(flatten(provenance()))
            store.add(key, _run_seeds(cell, missing, given, origin))
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


def _run_seeds(cell: Cell, seeds: list[int], given: Input, origin: Mapping[str, Any]) -> pd.DataFrame:
    """Track and evaluate with each seed: one row per run."""
    # Cells with other shapes need other programs.
    drop_programs_if_many()
    settings = [msgspec.structs.replace(cell.settings, seed=seed) for seed in seeds]
    began = time.perf_counter()
    results = track_runs(given.recording, given.silhouettes, settings)
    total_s = time.perf_counter() - began
    reference = given.reference(cell.settings.rate_hz)
    of_cell = describe(cell) | {"frames": given.recording.num_frames, "num_cameras": len(given.recording.rig)}
    of_batch = {"runs_in_batch": len(seeds), "seconds.batch": total_s}
    rows = []
    for seed, result in zip(seeds, results, strict=True):
        of_run: dict[str, Any] = dict.fromkeys(_METRICS, np.nan) | {"missed_rate": 1.0}
        # A run that finds no drones has missed all drones. All runs have the same columns, so that programs can read
        # all cells as one data set.
        if isinstance(result, InputError):
            of_run["note"] = str(result)
        else:
            evaluation = evaluate(result.trajectories, reference).to_dict()
            of_run |= {name: evaluation[name] for name in _METRICS if evaluation[name] is not None}
            of_run |= {"note": ""} | _times(result, total_s / len(seeds))
        rows.append(of_cell | {"seed": seed} | of_batch | of_run | dict(origin))
    return pd.DataFrame(rows)


#: Figures of the evaluation that are columns of the rows.
_METRICS = [each.name for each in fields(Evaluation) if each.name not in ("frames", "per_drone")]


def _times(result: TrackedRecording, wall_s: float) -> dict[str, float]:
    """How long a run took.

    Args:
        result: result of the run.
        wall_s: the run's part of the seconds of wall clock of all runs.
    """
    seconds = result.record["seconds"]
    # A sweep reads stored silhouettes and starts once for all cells, so neither is in the seconds of a run.
    timed = with_real_time(result.record, wall_s)
    return {
        **{f"seconds.{stage}": value for stage, value in seconds.items()},
        **{name: timed[name] for name in ("real_time_factor", "real_time_factor_running")},
        "track_ms_per_frame": 1e3 * seconds["track"] / result.trajectories.num_frames,
    }
