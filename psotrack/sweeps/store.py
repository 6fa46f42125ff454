"""The folder of a sweep's results: finished cells, failed cells, and the locks of the cells that processes work on.

    DIR/cells/KEY.parquet            one row per run of a finished cell
    DIR/cells/_NAME.error.json       why a cell failed at the last attempt
    DIR/cells/.KEY.lock              a process works on the cell (see `support.locks`)
    DIR/_runs/DIGEST.json            a grid that was run, with which versions, on which machine

Programs that read DIR as one Parquet data set, such as `pandas.read_parquet`, skip names that begin with a dot or an
underscore, and so read the rows of the finished cells.

A cell's file appears whole or not at all. KEY is NAME-INPUT: NAME is made of the combination of settings, INPUT of
what the cell reads and of the code (see `cells.cell_key`). Files of one NAME and different INPUT are results of a cell
from another recording or another version of psotrack: they stay, and only the one that was used last counts. Each use
sets the file's time of change.

A Parquet file has a digest of its own content, so that damage is noticed before the file is used. The digest stands in
the file's footer, under the key "psotrack.digest"; other programs read the file as any other. It is that of the whole
file with zeros in the place of the digest. Arrow itself ends the process at some damaged files.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import time
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from psotrack.errors import InputError, system_errors
from psotrack.support import Locks, atomic_write, digest_record, read_json, write_json
from psotrack.sweeps.tables import DESCRIBING, natural

logger = logging.getLogger(__name__)

_KEY = b"psotrack.digest"
#: The digest's place before the digest is known.
_EMPTY = b"0" * 64


def write_parquet(path: Path, table: pd.DataFrame) -> None:
    """Write a table as a Parquet file with a digest.

    Raises:
        OutputError: the file cannot be written.
    """
    rows, buffer = pa.Table.from_pandas(table, preserve_index=False), pa.BufferOutputStream()
    with pq.ParquetWriter(buffer, rows.schema) as writer:
        writer.write_table(rows)
        writer.add_key_value_metadata({_KEY: _EMPTY})
    content = buffer.getvalue().to_pybytes()
    before, _, after = _parts(content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(before + _digest(before, after) + after)


def read_parquet(path: Path) -> pd.DataFrame | None:
    """Read a table; None where there is no file.

    Raises:
        InputError: the file cannot be read, or was changed or cut short after it was written.
    """
    if not path.exists():
        return None
    with system_errors(path, "a file to read"):
        content = path.read_bytes()
    before, digest, after = _parts(content)
    if digest != _digest(before, after):
        raise InputError(
            path,
            expected="an undamaged file of a sweep",
            found="a file that was changed after it was written",
            remedy="run the same `psotrack sweep` again",
        )
    # In this thread alone: a thread of Arrow's that frees the content while the program ends aborts the program.
    with pq.ParquetFile(pa.BufferReader(content), pre_buffer=False) as file:
        return file.read(use_threads=False).to_pandas(use_threads=False)


def _parts(content: bytes) -> tuple[bytes, bytes, bytes]:
    """The bytes of a file before its digest, the digest, and the bytes after it."""
    # The footer is coded with Thrift: the key, then a byte for the field's type and one for the length of the value.
    start = content.rfind(_KEY) + len(_KEY) + 2
    end = start + len(_EMPTY)
    return content[:start], content[start:end], content[end:]


def _digest(before: bytes, after: bytes) -> bytes:
    return hashlib.sha256(before + _EMPTY + after).hexdigest().encode("ascii")


#: A temporary file that is older was left by a runner that was killed, seconds.
_LEFT_BEHIND_S = 3600.0


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

    def add(self, key: str, rows: pd.DataFrame) -> None:
        """Store rows, one per run, of a cell beside the rows of its other seeds. The caller holds the cell's lock.

        Raises:
            OutputError: the file cannot be written.
        """
        # A cell whose rows are damaged is run again as a whole.
        before = self._rows_if_whole(key)
        if before is not None:
            rows = pd.concat([before[~before["seed"].isin(rows["seed"])], rows], ignore_index=True)
        write_parquet(self._path(key), rows.sort_values("seed", kind="stable"))

    def use(self, key: str) -> None:
        """Let the rows of a finished cell count before those of the same cell from another input or code."""
        os.utime(self._path(key))

    def add_failure(self, name: str, error: str, cell: Mapping[str, Any]) -> None:
        """Store why a cell failed, and a description of the cell: at least its sequence and method.

        Raises:
            OutputError: the file cannot be written.
        """
        write_json(self._failure_path(name), {"error": error, **cell})

    def remove_failure(self, name: str) -> None:
        """Remove the record of a cell's earlier failure, because the cell is finished."""
        self._failure_path(name).unlink(missing_ok=True)

    def add_run(self, run: Mapping[str, Any]) -> None:
        """Store what is run: the grid, and where it comes from; once for each grid, version and machine.

        Raises:
            OutputError: the file cannot be written.
        """
        path = self.folder / "_runs" / f"{digest_record(run)[:20]}.json"
        if not path.exists():
            write_json(path, run)

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
            rows = read_parquet(self._path(key))
            if rows is not None:
                parts.append(rows if some is None else rows[rows["seed"].isin(list(some))])
        if not parts:
            raise InputError(self.folder, expected="results of a sweep", found="no finished cell")
        if seeds is None:
            parts.sort(key=_place_of_cell)
        return pd.concat(parts, ignore_index=True)

    def status(self) -> dict[str, Any]:
        """Numbers of finished, failed and locked cells, the errors, and the processes at work.

        Raises:
            InputError: there are no results.
        """
        if not self._cells.is_dir():
            raise InputError(self.folder, expected="results of a sweep", found="none")
        failures = []
        for path in sorted(self._cells.glob("_*.error.json")):
            failures.append(read_json(path, remedy=f"run the same `psotrack sweep` again after `rm {path}`"))
        holders = map(self._locks.holder, sorted(self._cells.glob(".*.lock")))
        at_work = [holder for holder in holders if holder]
        return {
            "finished": len(self._last_keys()),
            "failed": len(failures),
            "claimed": len(at_work),
            "errors": [
                f"{each.get('sequence')} {each.get('method')}: {each.get('error')}" for each in failures
            ],
            "at_work": at_work,
        }

    def tidy(self) -> None:
        """Remove half-written files of runners that were killed."""
        for folder in (self._cells, self.folder / "_runs"):
            for path in (*folder.glob(".*.partial.*"), *folder.glob(".*.lock.[br]*")):
                with contextlib.suppress(OSError):
                    if time.time() - path.stat().st_mtime > _LEFT_BEHIND_S:
                        path.unlink()

    def _last_keys(self) -> list[str]:
        """Keys of the finished cells; of several with one name the one that was used last."""
        files = [path for path in self._cells.glob("*.parquet") if not path.name.startswith(".")]
        files.sort(key=lambda path: (path.stat().st_mtime_ns, path.name))
        last = {path.stem.partition("-")[0]: path.stem for path in files}
        if len(last) < len(files):
            older = len(files) - len(last)
            logger.info("%s: %d cells of older input or code do not count", self.folder, older)
        return sorted(last.values())

    def _rows_if_whole(self, key: str) -> pd.DataFrame | None:
        """Rows of a cell as they are stored; None without such a file, and with a warning for a damaged file."""
        try:
            return read_parquet(self._path(key))
        except InputError:
            logger.warning("%s: damaged rows of a cell; a sweep runs the cell again", self._path(key))
            return None

    def _path(self, key: str) -> Path:
        return self._cells / f"{key}.parquet"

    def _failure_path(self, name: str) -> Path:
        return self._cells / f"_{name}.error.json"


def _place_of_cell(rows: pd.DataFrame) -> list[Any]:
    """What cells are sorted by: what describes them, in the order of the columns."""
    names = [str(name) for name in rows.columns if str(name).startswith(DESCRIBING)]
    return [natural(value) for value in rows[names].iloc[0]]
