"""Runs the cells of a grid that nobody has finished, one batch of runs per cell, and keeps their rows."""

from __future__ import annotations

import hashlib
import logging
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from psotrack.datasets.dpjait import read_sequence
from psotrack.errors import InputError, PsotrackError
from psotrack.evaluation import evaluate
from psotrack.pipeline import TrackedSequence, environment, track_runs
from psotrack.progress import Report, silent
from psotrack.sequence import Sequence
from psotrack.silhouettes import Silhouettes, compute
from psotrack.sweep.cells import Cell, key_of
from psotrack.sweep.grid import Grid, cameras_label
from psotrack.sweep.names import flat
from psotrack.sweep.perturbations import perturbed
from psotrack.sweep.store import Store

logger = logging.getLogger(__name__)

#: Folders of the data's root in which a sequence may lie.
HALVES = ("Simulated_Data", "Real_Data", ".")


@dataclass(frozen=True)
class Outcome:
    """What a runner did: numbers of cells.

    Attributes:
        finished: by this runner.
        failed: kept with their errors.
        left: finished before, or somebody else is at work on them.
    """

    finished: int
    failed: int
    left: int


@dataclass(frozen=True)
class _Input:
    """A sequence as a cell sees it, and digests of all that is read of it."""

    sequence: Sequence
    silhouettes: Silhouettes
    keys: dict[str, str]


def run(
    grid: Grid, out: Path, *, data: Path, cache: Path, jobs: int | None = None, report: Report = silent
) -> Outcome:
    """Run what is not finished, cell by cell. Several runners on one folder share the work.

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
    store, cells = Store(out), grid.cells()
    for cell in cells:
        folder_of(cell.sequence, data)
    done = {"finished": 0, "failed": 0, "left": 0}
    with report("sweep", len(cells)) as advance:
        for cell, given in _inputs(cells, data, cache, jobs):
            done[_run_cell(cell, given, store)] += 1
            advance(1)
    return Outcome(**done)


def folder_of(sequence: str, data: Path) -> Path:
    """The folder of a sequence that a grid names.

    Raises:
        InputError: there is none.
    """
    places = [Path(sequence), *(data / half / sequence for half in HALVES)]
    for place in places:
        if place.is_dir():
            return place
    raise InputError(
        data, expected=f"the sequence {sequence}", found="none", remedy="name the data's root with --data"
    )


def _inputs(
    cells: tuple[Cell, ...], data: Path, cache: Path, jobs: int | None
) -> Iterator[tuple[Cell, _Input | PsotrackError]]:
    """The cells and what each of them reads, or why that cannot be had. Cells of the same input follow each other."""
    groups: dict[Any, list[Cell]] = {}
    for cell in cells:
        of_input = (cell.sequence, cell.frames, cell.settings.silhouettes, cell.cameras, cell.perturbation)
        groups.setdefault(of_input, []).append(cell)
    for alike in groups.values():
        try:
            given: _Input | PsotrackError = _read(alike[0], data, cache, jobs)
        except PsotrackError as error:
            given = error
        for cell in alike:
            yield cell, given


def _read(cell: Cell, data: Path, cache: Path, jobs: int | None) -> _Input:
    sequence = read_sequence(folder_of(cell.sequence, data)).usable(None, cell.frames)
    if sequence.truth is None:
        raise InputError(sequence.folder, expected="a reference to compare with", found="none")
    silhouettes = compute(sequence, cell.settings.silhouettes, cache=cache, jobs=jobs)
    keys = dict(silhouettes.keys) | {
        "calibration": _digest(*vars(sequence.rig.cameras).values()),
        "reference": _digest(sequence.truth.position_m, sequence.truth.orientation_wxyz),
    }
    if Path(cell.settings.init).is_file():
        keys["init"] = _digest(np.frombuffer(Path(cell.settings.init).read_bytes(), np.uint8))
    return _Input(*perturbed(sequence, silhouettes, cell.perturbation, cell.cameras), keys)


def _digest(*arrays: Any) -> str:
    digest = hashlib.blake2b(digest_size=20)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes() if array is not None else b"none")
    return digest.hexdigest()


def _run_cell(cell: Cell, given: _Input | PsotrackError, store: Store) -> str:
    """Finish a cell: which of the numbers of `Outcome` it counts for."""
    if isinstance(given, PsotrackError):
        store.fail(_nameless(cell), str(given), _about(cell))
        logger.error("%s: %s", _title(cell), given)
        return "failed"
    key = key_of(cell, given.keys)
    with store.claim(key) as ours:
        missing = sorted(set(cell.seeds) - store.seeds_of(key))
        if not ours or not missing:
            return "left"
        try:
            store.add(key, pd.DataFrame(_rows(cell, missing, given)))
        except Exception as error:
            store.fail(
                key, f"{type(error).__name__}: {error}", _about(cell) | {"where": traceback.format_exc()}
            )
            logger.error("%s: %s", _title(cell), error)
            return "failed"
    return "finished"


def _rows(cell: Cell, seeds: list[int], given: _Input) -> list[dict[str, Any]]:
    """One row per run."""
    settings = [msgspec.structs.replace(cell.settings, seed=seed) for seed in seeds]
    began = time.perf_counter()
    results = track_runs(given.sequence, given.silhouettes, settings)
    total_s = time.perf_counter() - began
    about = _about(cell) | {"runs_in_batch": len(seeds), "seconds.batch": total_s}
    machine = {f"versions.{name}": value for name, value in environment()["versions"].items()}
    machine |= {f"device.{name}": value for name, value in environment()["device"].items()}
    return [
        about | {"seed": seed} | _figures(result, given.sequence) | machine
        for seed, result in zip(seeds, results, strict=True)
    ]


def _figures(result: TrackedSequence | InputError, sequence: Sequence) -> dict[str, Any]:
    """What evaluation says of a run. A run that finds no drones has missed all of them."""
    if isinstance(result, InputError):
        return {"missed_rate": 1.0, "note": str(result)}
    assert sequence.truth is not None
    errors = evaluate(result.trajectories, sequence.truth).to_dict()
    seconds = {f"seconds.{stage}": value for stage, value in result.record["seconds"].items()}
    return {key: value for key, value in errors.items() if np.isscalar(value)} | seconds


def _about(cell: Cell) -> dict[str, Any]:
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


def _title(cell: Cell) -> str:
    return " ".join(map(str, (cell.sequence, cell.method, *cell.axes.values())))


def _nameless(cell: Cell) -> str:
    """A key for a cell whose input cannot be read."""
    return key_of(cell, {})
