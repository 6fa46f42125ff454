"""The folder of a sweep's results: finished cells, failed cells, and the locks of the cells that processes work on.

    DIR/cells/KEY.parquet            one row per run of a finished cell
    DIR/cells/_NAME.error.json       why a cell failed at the last attempt
    DIR/cells/.KEY.lock              a process works on the cell (see `locks`)
    DIR/_errors/KEY.parquet          errors of the cell's runs, frame by frame
    DIR/_manifest.json               what was run, with which versions, on which machine, from which input

Programs that read DIR as one Parquet data set, such as `pandas.read_parquet`, skip names that begin with a dot or an
underscore, and so read exactly the rows of the finished cells.

A cell's file appears whole or not at all. KEY is made of everything that decides the cell's rows (see
`cells.cell_key`). NAME is made of the same without the content of the input: a cell whose input cannot be read has no
KEY.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from psotrack.errors import InputError
from psotrack.support import LARGEST, MODERATE, convert
from psotrack.sweep.locks import Locks
from psotrack.sweep.sealed_files import DamagedError, read_json, read_parquet, write_json, write_parquet

logger = logging.getLogger(__name__)

#: A temporary file that is older was left by a runner that was killed, seconds.
_LEFT_BEHIND_S = 3600.0

#: Remedy for a damaged file that a sweep makes anew.
_RUN_AGAIN = "run the same `psotrack sweep` again"


class _Failure(msgspec.Struct, frozen=True):
    """What must be in the record of a failed cell."""

    sequence: str
    method: str
    error: str


class _Grid(msgspec.Struct, frozen=True):
    settings: dict[str, Any]
    methods: dict[str, dict[str, Any]]
    axes: dict[str, Any]


class _Run(msgspec.Struct, frozen=True):
    grid: _Grid


class _Manifest(msgspec.Struct, frozen=True):
    """What must be in the manifest."""

    runs: list[_Run]
    inputs: dict[str, Any]


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
        self._locks = Locks()

    def finished_seeds(self, key: str) -> set[int]:
        """Seeds of a cell's finished runs; none, and a warning, if the cell's file is damaged."""
        rows = self._rows_if_whole(key)
        return set() if rows is None else set(rows["seed"].tolist())

    def lock(self, key: str, work: str = "") -> AbstractContextManager[bool]:
        """Try to lock a cell until the block ends; yields whether the cell is locked for this process.

        Args:
            key: the cell's key.
            work: description of the work, for `status`.
        """
        return self._locks.attempt(self.folder / "cells" / f".{key}.lock", work)

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
        """Store why a cell failed, and a description of the cell.

        Raises:
            OutputError: the file cannot be written.
        """
        write_json(self._failure_path(name), {"error": error, **cell})

    def remove_failure(self, name: str) -> None:
        """Remove the record of a cell's earlier failure, because the cell is finished."""
        self._failure_path(name).unlink(missing_ok=True)

    def failure(self, name: str) -> str | None:
        """Why a cell failed at the last attempt; None if it did not fail."""
        content = _read_if_present(self._failure_path(name), _Failure)
        return None if content is None else str(content["error"])

    def rows(self, seeds: Mapping[str, Collection[int]] | None = None) -> pd.DataFrame:
        """One row per run of the finished cells.

        Args:
            seeds: keys of the wanted cells, and the wanted seeds of each; None for all cells and seeds.

        Raises:
            InputError: there are no results.
        """
        if seeds is None:
            parts = _read_cells(self._cell_files("parquet"))
        else:
            tables = [(_read_cells([self._rows_path(key)]), wanted) for key, wanted in seeds.items()]
            parts = [table[table["seed"].isin(list(wanted))] for read, wanted in tables for table in read]
        if not parts:
            raise InputError(self.folder, expected="results of a sweep", found="no finished cell")
        return pd.concat(parts, ignore_index=True)

    def errors(self, key: str, seeds: Collection[int]) -> pd.DataFrame:
        """Errors of a cell's runs, frame by frame: rows of `evaluation.errors_over_time`, with a column `seed`.

        Args:
            key: the cell's key, as in the column `cell` of its rows.
            seeds: seeds of the wanted runs.

        Raises:
            InputError: there is no file of the cell's errors, or it has no errors of these runs.
        """
        errors = self._errors_if_present(key, ("seed", "frame", "drone", "error_m"))
        if errors is None:
            raise InputError(self._errors_path(key), expected="errors of a finished cell", found="no file")
        wanted = errors[errors["seed"].isin(list(seeds))].reset_index(drop=True)
        if wanted.empty and not errors.empty:
            path = self._errors_path(key)
            expected = f"errors of seeds {', '.join(map(str, seeds))}"
            raise InputError(path, expected=expected, found="none", remedy=_remove(self._rows_path(key)))
        return wanted

    def status(self) -> dict[str, Any]:
        """Numbers of finished, failed and locked cells, the errors, and the processes at work.

        Raises:
            InputError: there are no results.
        """
        if not (self.folder / "cells").is_dir():
            raise InputError(self.folder, expected="results of a sweep", found="none")
        read = (_read_if_present(path, _Failure) for path in self._cell_files("error.json"))
        failures = [failure for failure in read if failure is not None]
        locks = sorted((self.folder / "cells").glob(".*.lock"))
        at_work = [holder for path in locks if (holder := self._locks.holder(path))]
        return {
            "finished": len(self._cell_files("parquet")),
            "failed": len(failures),
            "claimed": len(at_work),
            "errors": [
                f"{failure['sequence']} {failure['method']}: {failure['error']}" for failure in failures
            ],
            "at_work": at_work,
        }

    def manifest(self) -> dict[str, Any]:
        """Content of the manifest: runs and inputs; both are empty before the first run."""
        content = _read_if_present(self.folder / "_manifest.json", _Manifest)
        return {"runs": [], "inputs": {}} if content is None else content

    def change_manifest(self, change: Callable[[dict[str, Any]], None]) -> None:
        """Change the manifest while no other runner does.

        Args:
            change: changes the manifest's content in place.

        Raises:
            OutputError: the file cannot be written.
        """
        path = self.folder / "_manifest.json"
        with self._locks.wait(self.folder / ".manifest.lock"):
            manifest = self.manifest()
            before = json.dumps(manifest)
            change(manifest)
            if json.dumps(manifest) != before:
                write_json(path, manifest)

    def tidy(self) -> None:
        """Remove half-written files of runners that were killed."""
        for folder in (self.folder, self.folder / "cells", self.folder / "_errors"):
            for path in (*folder.glob(".*.partial.*"), *folder.glob(".*.lock.[br]*")):
                with contextlib.suppress(OSError):
                    if time.time() - path.stat().st_mtime > _LEFT_BEHIND_S:
                        path.unlink()

    def _rows_if_whole(self, key: str) -> pd.DataFrame | None:
        """Rows of a cell as they are stored; None without such a file, and with a warning for a damaged file."""
        path = self._rows_path(key)
        try:
            return _read_table(path, "")
        except FileNotFoundError:
            return None
        except DamagedError:
            logger.warning("%s: damaged rows of a cell; a sweep runs the cell again", path)
            return None

    def _errors_if_present(self, key: str, columns: Collection[str] = ("seed",)) -> pd.DataFrame | None:
        path = self._errors_path(key)
        try:
            return _read_table(path, _remove(self._rows_path(key)), columns)
        except FileNotFoundError:
            return None

    def _rows_path(self, key: str) -> Path:
        return self.folder / "cells" / f"{key}.parquet"

    def _errors_path(self, key: str) -> Path:
        return self.folder / "_errors" / f"{key}.parquet"

    def _failure_path(self, name: str) -> Path:
        return self.folder / "cells" / f"_{name}.error.json"

    def _cell_files(self, suffix: str) -> list[Path]:
        """Files of all cells, without temporary files, whose names begin with a dot."""
        files = (self.folder / "cells").glob(f"*.{suffix}")
        return sorted(path for path in files if not path.name.startswith("."))


def _read_cells(paths: Iterable[Path]) -> list[pd.DataFrame]:
    """Rows of each cell; files that do not exist are left out."""
    parts = []
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            parts.append(_read_table(path, _RUN_AGAIN))
    return parts


def _read_table(path: Path, remedy: str, columns: Collection[str] = ("seed",)) -> pd.DataFrame:
    """A table of runs or of their errors, which must have some columns: names in `drone`, numbers in the others.

    Raises:
        DamagedError: the file is damaged, or is another table.
        FileNotFoundError: the file does not exist.
    """
    table = read_parquet(path, remedy)
    # A run without any drone has no errors, and their table has no columns but the seed.
    for name in columns if len(table) else ("seed",):
        if name not in table or not _fits(name, table[name]):
            found = "others" if name in table else "none"
            raise DamagedError(path, expected=f"values in the column {name}", found=found, remedy=remedy)
    size = table.select_dtypes("number").abs().max()
    for column, largest in size[size > LARGEST].items():
        found = f"{largest:g} in the column {column}"
        raise DamagedError(path, expected=MODERATE, found=found, remedy=remedy)
    return table


def _fits(name: str, values: pd.Series) -> bool:
    """Whether a column has names of drones, or numbers of 0 and more; only the error of a drone may be missing."""
    if name == "drone":
        return bool(values.notna().all())
    if not pd.api.types.is_numeric_dtype(values):
        return False
    numbers = (values.dropna() if name == "error_m" else values).to_numpy(np.float64, na_value=np.nan)
    return bool(((numbers >= 0) & (numbers <= LARGEST)).all())


def _read_if_present(path: Path, kind: type[msgspec.Struct]) -> dict[str, Any] | None:
    """The JSON object in a file, which is checked to be like `kind`; None if the file does not exist.

    Raises:
        DamagedError: the file is damaged.
    """
    try:
        content = read_json(path, _remove(path))
    except FileNotFoundError:
        return None

    def wrong(field: str, expected: str, found: str, remedy: str) -> DamagedError:
        return DamagedError(
            f"{path}, {field}", expected=expected, found=found, remedy=remedy or _remove(path)
        )

    convert(content, kind, wrong)
    return content


def _remove(path: Path) -> str:
    """Remedy for a damaged file that a sweep does not make anew as long as the file at a path is there."""
    return f"{_RUN_AGAIN} after `rm {path}`"
