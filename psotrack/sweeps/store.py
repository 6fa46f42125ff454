"""The folder of a sweep's results: finished cells, failed cells, and the locks of the cells that processes work on.

    DIR/cells/KEY.parquet            one row per run of a finished cell
    DIR/cells/_NAME.error.json       why a cell failed at the last attempt
    DIR/cells/.KEY.lock              a process works on the cell (see `locks`)
    DIR/_errors/KEY.parquet          errors of the cell's runs, frame by frame
    DIR/_manifest.json               what was run, with which versions, on which machine, from which input

Programs that read DIR as one Parquet data set, such as `pandas.read_parquet`, skip names that begin with a dot or an
underscore, and so read exactly the rows of the finished cells.

A cell's file appears whole or not at all. KEY is NAME-INPUT: NAME is made of the combination of settings, INPUT of
what the cell reads and of the code (see `cells.cell_key`). Files of one NAME and different INPUT are results of a cell
from another recording or another version of psotrack: they stay, and only the one that was used last counts.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pandas as pd

from psotrack.errors import InputError
from psotrack.sweeps.locks import Locks
from psotrack.sweeps.sealed_files import DamagedError, read_json, read_parquet, write_json, write_parquet
from psotrack.sweeps.tables import DESCRIBING, natural

logger = logging.getLogger(__name__)

#: A temporary file that is older was left by a runner that was killed, seconds.
_LEFT_BEHIND_S = 3600.0

#: Remedy for a damaged file that a sweep makes anew.
_RUN_AGAIN = "run the same `psotrack sweep` again"


def is_results_folder(path: Path | str) -> bool:
    """Whether a path is a folder of results of a sweep."""
    return (Path(path) / "cells").is_dir()


class Store:
    """Results in a folder, which the first writer makes.

    Attributes:
        folder: the folder.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._cells = self.folder / "cells"
        self._locks = Locks()

    def finished_seeds(self, key: str) -> set[int]:
        """Seeds of a cell's finished runs; none, and a warning, if the cell's file is damaged."""
        rows = self._rows_if_whole(key)
        return set() if rows is None else set(rows["seed"].tolist())

    def lock(self, key: str) -> AbstractContextManager[bool]:
        """Try to lock a cell until the block ends; yields whether the cell is locked for this process."""
        return self._locks.attempt(self._cells / f".{key}.lock")

    def add(self, key: str, rows: pd.DataFrame, errors: pd.DataFrame) -> None:
        """Store rows of a cell beside the rows of its other seeds. The caller holds the cell's lock.

        Args:
            key: the cell's key.
            rows: one row per run.
            errors: one row per frame and drone of every run, with a column `seed`.

        Raises:
            DamagedError: the errors of other seeds are damaged, whose rows are whole.
            OutputError: the files cannot be written.
        """
        # A cell whose rows are damaged is run again as a whole.
        before_rows = self._rows_if_whole(key)
        before_errors = None if before_rows is None else self._errors_if_present(key)
        # The rows come last, because a cell with rows counts as finished.
        for path, before, new in (
            (self._errors_path(key), before_errors, errors),
            (self._rows_path(key), before_rows, rows),
        ):
            if before is not None:
                new = pd.concat([before[~before["seed"].isin(rows["seed"])], new], ignore_index=True)
            write_parquet(path, new.sort_values("seed", kind="stable"))

    def add_failure(self, name: str, error: str, cell: Mapping[str, Any]) -> None:
        """Store why a cell failed, and a description of the cell: at least its sequence and method.

        Raises:
            OutputError: the file cannot be written.
        """
        write_json(self._failure_path(name), {"error": error, **cell})

    def remove_failure(self, name: str) -> None:
        """Remove the record of a cell's earlier failure, because the cell is finished."""
        self._failure_path(name).unlink(missing_ok=True)

    def rows(self, seeds: Mapping[str, Collection[int]] | None = None) -> pd.DataFrame:
        """One row per run of the finished cells.

        Args:
            seeds: keys of the wanted cells, and the wanted seeds of each, in this order; None for all cells and seeds,
                sorted by their settings, without results of other inputs or code than those that were used last.

        Raises:
            InputError: there are no results.
        """
        wanted = dict.fromkeys(self._last_keys()) if seeds is None else seeds
        parts = []
        for key, some in wanted.items():
            with contextlib.suppress(FileNotFoundError):
                rows = read_parquet(self._rows_path(key), _RUN_AGAIN)
                parts.append(rows if some is None else rows[rows["seed"].isin(list(some))])
        if not parts:
            raise InputError(self.folder, expected="results of a sweep", found="no finished cell")
        if seeds is None:
            parts.sort(key=_place_of_cell)
        return pd.concat(parts, ignore_index=True)

    def errors(self, key: str, seeds: Collection[int]) -> pd.DataFrame:
        """Errors of a cell's runs, frame by frame: rows of `evaluation.errors_over_time`, with a column `seed`.

        Args:
            key: the cell's key, as in the column `cell` of its rows.
            seeds: seeds of the wanted runs.

        Raises:
            InputError: there is no file of the cell's errors, or it has no errors of these runs.
        """
        errors, path = self._errors_if_present(key), self._errors_path(key)
        if errors is None:
            raise InputError(path, expected="errors of a finished cell", found="no file")
        wanted = errors[errors["seed"].isin(list(seeds))].reset_index(drop=True)
        if wanted.empty and not errors.empty:
            expected = f"errors of seeds {', '.join(map(str, seeds))}"
            raise InputError(path, expected=expected, found="none", remedy=_remove(self._rows_path(key)))
        return wanted

    def status(self) -> dict[str, Any]:
        """Numbers of finished, failed and locked cells, the errors, and the processes at work.

        Raises:
            InputError: there are no results.
        """
        if not is_results_folder(self.folder):
            raise InputError(self.folder, expected="results of a sweep", found="none")
        failures = []
        for path in sorted(self._cells.glob("_*.error.json")):
            with contextlib.suppress(FileNotFoundError):
                failures.append(read_json(path, _remove(path)))
        holders = map(self._locks.holder, sorted(self._cells.glob(".*.lock")))
        at_work = [holder for holder in holders if holder]
        return {
            "finished": len(self._last_keys()),
            "failed": len(failures),
            "claimed": len(at_work),
            "errors": [f"{each['sequence']} {each['method']}: {each['error']}" for each in failures],
            "at_work": at_work,
        }

    def manifest(self) -> dict[str, Any]:
        """Content of the manifest: runs and inputs; both are empty before the first run.

        Raises:
            DamagedError: the file is damaged.
        """
        path = self.folder / "_manifest.json"
        try:
            return read_json(path, _remove(path))
        except FileNotFoundError:
            return {"runs": [], "inputs": {}}

    def change_manifest(self, change: Callable[[dict[str, Any]], None]) -> None:
        """Change the manifest while no other runner does.

        Args:
            change: changes the manifest's content in place.

        Raises:
            DamagedError: the file is damaged.
            OutputError: the file cannot be written.
        """
        with self._locks.wait(self.folder / ".manifest.lock"):
            manifest = self.manifest()
            before = json.dumps(manifest)
            change(manifest)
            if json.dumps(manifest) != before:
                write_json(self.folder / "_manifest.json", manifest)

    def tidy(self) -> None:
        """Remove half-written files of runners that were killed."""
        for folder in (self.folder, self._cells, self.folder / "_errors"):
            for path in (*folder.glob(".*.partial.*"), *folder.glob(".*.lock.[br]*")):
                with contextlib.suppress(OSError):
                    if time.time() - path.stat().st_mtime > _LEFT_BEHIND_S:
                        path.unlink()

    def _last_keys(self) -> list[str]:
        """Keys of the finished cells; of several with one name the one whose input was used last."""
        files = [path for path in self._cells.glob("*.parquet") if not path.name.startswith(".")]
        used = {name: number for number, name in enumerate(self.manifest()["inputs"])}
        keys = sorted((path.stem for path in files), key=lambda key: (used.get(_input_of(key), -1), key))
        last = {key.partition("-")[0]: key for key in keys}
        if len(last) < len(keys):
            logger.info(
                "%s: %d cells of older input or code do not count", self.folder, len(keys) - len(last)
            )
        return list(last.values())

    def _rows_if_whole(self, key: str) -> pd.DataFrame | None:
        """Rows of a cell as they are stored; None without such a file, and with a warning for a damaged file."""
        path = self._rows_path(key)
        try:
            return read_parquet(path, "")
        except FileNotFoundError:
            return None
        except DamagedError:
            logger.warning("%s: damaged rows of a cell; a sweep runs the cell again", path)
            return None

    def _errors_if_present(self, key: str) -> pd.DataFrame | None:
        try:
            return read_parquet(self._errors_path(key), _remove(self._rows_path(key)))
        except FileNotFoundError:
            return None

    def _rows_path(self, key: str) -> Path:
        return self._cells / f"{key}.parquet"

    def _errors_path(self, key: str) -> Path:
        return self.folder / "_errors" / f"{key}.parquet"

    def _failure_path(self, name: str) -> Path:
        return self._cells / f"_{name}.error.json"


def _input_of(key: str) -> str:
    """The part of a key that is made of what the cell reads and of the code."""
    return key.partition("-")[2]


def _place_of_cell(rows: pd.DataFrame) -> list[Any]:
    """What cells are sorted by: what describes them, in the order of the columns."""
    names = [str(name) for name in rows.columns if str(name).startswith(DESCRIBING)]
    return [natural(value) for value in rows[names].iloc[0]]


def _remove(path: Path) -> str:
    """Remedy for a damaged file that a sweep does not make anew as long as the file at a path is there."""
    return f"{_RUN_AGAIN} after `rm {path}`"
