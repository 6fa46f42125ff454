"""The folder of a sweep's results: what is finished, what failed, and who is at work on what.

    DIR/manifest.json            what was run, by which versions, on which machine, from which input
    DIR/cells/KEY.parquet        one row per run of a finished cell
    DIR/errors/KEY.parquet       its errors, frame by frame
    DIR/cells/NAME.error.json    why a cell failed when it was last tried
    DIR/cells/KEY.claim          somebody is at work on it (see `locks`)

A cell appears whole or not at all. KEY is made of everything that decides its rows (see `cells.key_of`), NAME of all
but the input: a cell whose input cannot be read has no key, and must yet be found again.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from psotrack.errors import InputError
from psotrack.support import atomic_write
from psotrack.sweep.locks import claimed, owner_of, waited_for

#: What was being written so long ago was left by a runner that was killed.
_LEFT_BEHIND_S = 3600.0


@dataclass(frozen=True)
class Store:
    """Results in a folder, which is made when the first is written."""

    folder: Path

    def seeds_of(self, key: str) -> set[int]:
        """The seeds of a cell's finished runs."""
        path = self._path(key, "parquet")
        return set(pd.read_parquet(path, columns=["seed"])["seed"].tolist()) if path.exists() else set()

    def claim(self, key: str, what: str = "") -> AbstractContextManager[bool]:
        """Whether a cell is ours until the block ends; it is not where somebody else is at work on it."""
        return claimed(self._path(key, "claim"), what)

    def add(self, key: str, rows: pd.DataFrame, errors: pd.DataFrame) -> None:
        """Keep the rows of a cell, beside those of its other seeds. To be called by whoever has claimed the cell.

        Args:
            key: of the cell.
            rows: one per run.
            errors: one row per frame and drone of every run, with a column `seed`.

        Raises:
            OutputError: they cannot be written.
        """
        # The rows last: they are what makes a cell finished.
        for path, new in ((self._errors(key), errors), (self._path(key, "parquet"), rows)):
            if path.exists():
                before = pd.read_parquet(path)
                new = pd.concat([before[~before["seed"].isin(rows["seed"])], new], ignore_index=True)
            with atomic_write(path) as temporary:
                new.sort_values("seed", kind="stable").to_parquet(temporary, index=False)

    def fail(self, name: str, error: str, about: Mapping[str, Any]) -> None:
        """Keep why a cell failed, and what it was.

        Raises:
            OutputError: that cannot be written.
        """
        with atomic_write(self._path(name, "error.json")) as temporary:
            temporary.write_text(json.dumps({"error": error, **about}, indent=2) + "\n", encoding="utf-8")

    def forgive(self, name: str) -> None:
        """What is said of a cell's earlier failure goes: it is finished."""
        self._path(name, "error.json").unlink(missing_ok=True)

    def error_of(self, name: str) -> str | None:
        """Why a cell failed when it was last tried; None if it did not."""
        try:
            return str(_read(self._path(name, "error.json"))["error"])
        except FileNotFoundError:
            return None

    def rows(self, seeds: Mapping[str, Collection[int]] | None = None) -> pd.DataFrame:
        """One row per run of every finished cell; or of those of these keys, and of these seeds.

        Raises:
            InputError: there are no results.
        """
        if seeds is None:
            parts = [pd.read_parquet(path) for path in self._files("parquet")]
        else:
            finished = [(self._path(key, "parquet"), of_key) for key, of_key in seeds.items()]
            tables = [(pd.read_parquet(path), of_key) for path, of_key in finished if path.exists()]
            parts = [table[table["seed"].isin(list(of_key))] for table, of_key in tables]
        if not parts:
            raise InputError(self.folder, expected="results of a sweep", found="no finished cell")
        return pd.concat(parts, ignore_index=True)

    def errors(self, key: str, seeds: Collection[int]) -> pd.DataFrame:
        """Errors of a cell's runs, frame by frame: rows of `evaluation.errors_over_time`, with a column `seed`.

        Args:
            key: of the cell, as the column `cell` of its rows has it.
            seeds: of its runs.

        Raises:
            InputError: they are not there.
        """
        path = self._errors(key)
        if not path.exists():
            raise InputError(path, expected="errors of a finished cell", found="no file")
        errors = pd.read_parquet(path)
        return errors[errors["seed"].isin(list(seeds))].reset_index(drop=True)

    def status(self) -> dict[str, Any]:
        """How many cells are finished, failed and being worked at, by whom, and what the failures say.

        Raises:
            InputError: there are no results.
        """
        if not (self.folder / "cells").is_dir():
            raise InputError(self.folder, expected="results of a sweep", found="none")
        errors = [error for path in self._files("error.json") if (error := _read_if_there(path))]
        owners = [owner for path in self._files("claim") if (owner := owner_of(path))]
        return {
            "finished": len(self._files("parquet")),
            "failed": len(errors),
            "claimed": len(owners),
            "errors": [f"{error['sequence']} {error['method']}: {error['error']}" for error in errors],
            "at_work": [
                f"process {owner.process} on {owner.host} since {owner.since}: {owner.what}"
                for owner in owners
            ],
        }

    def manifest(self) -> dict[str, Any]:
        """What was run, and from what; empty lists and tables before the first run."""
        return _read_if_there(self.folder / "manifest.json") or {"runs": [], "inputs": {}}

    def change_manifest(self, change: Callable[[dict[str, Any]], None]) -> None:
        """Let `change` change what the manifest says; one runner at a time.

        Raises:
            OutputError: it cannot be written.
        """
        path = self.folder / "manifest.json"
        with waited_for(path.with_name(".manifest.claim")):
            manifest = self.manifest()
            before = json.dumps(manifest)
            change(manifest)
            if json.dumps(manifest) != before:
                with atomic_write(path) as temporary:
                    temporary.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")

    def tidy(self) -> None:
        """Remove what runners left half written when they were killed."""
        for folder in (self.folder, self.folder / "cells", self.folder / "errors"):
            for path in (*folder.glob(".*.partial.*"), *folder.glob(".*.stale")):
                with contextlib.suppress(OSError):
                    if time.time() - path.stat().st_mtime > _LEFT_BEHIND_S:
                        path.unlink()

    def _errors(self, key: str) -> Path:
        return self.folder / "errors" / f"{key}.parquet"

    def _path(self, key: str, suffix: str) -> Path:
        return self.folder / "cells" / f"{key}.{suffix}"

    def _files(self, suffix: str) -> list[Path]:
        """Of all cells; not those that are being written, whose names begin with a dot."""
        files = (self.folder / "cells").glob(f"*.{suffix}")
        return sorted(path for path in files if not path.name.startswith("."))


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def _read_if_there(path: Path) -> dict[str, Any] | None:
    try:
        return _read(path)
    except FileNotFoundError:
        return None
