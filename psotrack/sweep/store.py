"""The folder of a sweep's results: what is finished, what failed, and who is at work on what.

    DIR/manifest.json            the grid, versions, the machine
    DIR/cells/KEY.parquet        one row per run of a finished cell
    DIR/cells/KEY.error.json     why a cell failed
    DIR/cells/KEY.claim          somebody is at work on it

A cell appears whole or not at all. Several runners, on one machine or on many, share a folder: each claims a cell
before it runs it. A claim is kept alive by its runner; one that nobody has touched for a while is of a runner that was
killed, and anybody may take it over.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from psotrack.errors import InputError
from psotrack.files import written_whole

#: A claim is touched so often; not touched for so long, it is nobody's.
HEARTBEAT_S, STALE_S = 5.0, 30.0


@dataclass(frozen=True)
class Store:
    """Results in a folder, which is made when the first is written."""

    folder: Path

    def seeds_of(self, key: str) -> set[int]:
        """The seeds of a cell's finished runs."""
        path = self._path(key, "parquet")
        return set(pd.read_parquet(path, columns=["seed"])["seed"]) if path.exists() else set()

    def error_of(self, key: str) -> str | None:
        """Why a cell failed when it was last tried; None if it did not."""
        try:
            return str(json.loads(self._path(key, "error.json").read_text(encoding="utf-8"))["error"])
        except FileNotFoundError:
            return None

    def is_claimed(self, key: str) -> bool:
        """Whether a living runner is at work on a cell, as far as one can see."""
        try:
            return time.time() - self._path(key, "claim").stat().st_mtime < STALE_S
        except FileNotFoundError:
            return False

    def add(self, key: str, rows: pd.DataFrame) -> None:
        """Keep the rows of a cell, beside those of its other seeds; what is said of an earlier failure goes.

        To be called by whoever has claimed the cell.
        """
        path = self._path(key, "parquet")
        if path.exists():
            before = pd.read_parquet(path)
            rows = pd.concat([before[~before["seed"].isin(rows["seed"])], rows], ignore_index=True)
        with written_whole(path) as temporary:
            rows.sort_values("seed").to_parquet(temporary, index=False)
        self._path(key, "error.json").unlink(missing_ok=True)

    def fail(self, key: str, error: str, about: Mapping[str, Any]) -> None:
        """Keep why a cell failed, and what it was."""
        with written_whole(self._path(key, "error.json")) as temporary:
            temporary.write_text(json.dumps({"error": error, **about}, indent=2) + "\n", encoding="utf-8")

    def write_manifest(self, manifest: Mapping[str, Any]) -> None:
        """Keep what the results depend on."""
        with written_whole(self.folder / "manifest.json") as temporary:
            temporary.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")

    def rows(self) -> pd.DataFrame:
        """One row per run of every finished cell.

        Raises:
            InputError: there are no results.
        """
        parts = [pd.read_parquet(path) for path in sorted((self.folder / "cells").glob("*.parquet"))]
        if not parts:
            raise InputError(self.folder, expected="results of a sweep", found="no finished cell")
        return pd.concat(parts, ignore_index=True)

    def status(self) -> dict[str, Any]:
        """How many cells are finished, failed and being worked at, and what the failures say."""
        cells = self.folder / "cells"
        if not cells.is_dir():
            raise InputError(self.folder, expected="results of a sweep", found="none")
        errors = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(cells.glob("*.error.json"))]
        claims = [path.name.removesuffix(".claim") for path in cells.glob("*.claim")]
        return {
            "finished": len(list(cells.glob("*.parquet"))),
            "failed": len(errors),
            "claimed": sum(self.is_claimed(key) for key in claims),
            "errors": [f"{error['sequence']} {error['method']}: {error['error']}" for error in errors],
        }

    @contextlib.contextmanager
    def claim(self, key: str) -> Iterator[bool]:
        """Whether a cell is ours until the block ends; it is not where somebody else is at work on it."""
        if not self._take(key):
            yield False
            return
        ended = threading.Event()
        beating = threading.Thread(target=self._keep_alive, args=(key, ended), daemon=True)
        beating.start()
        try:
            yield True
        finally:
            ended.set()
            beating.join()
            self._path(key, "claim").unlink(missing_ok=True)

    def _path(self, key: str, suffix: str) -> Path:
        return self.folder / "cells" / f"{key}.{suffix}"

    def _take(self, key: str) -> bool:
        """Whether the claim on a cell is ours now."""
        path = self._path(key, "claim")
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not self.is_claimed(key):
            # Of all who see that a claim is stale one alone can move it away.
            aside = path.with_name(f".{key}.{secrets.token_hex(4)}.stale")
            with contextlib.suppress(FileNotFoundError):
                os.rename(path, aside)
                aside.unlink()
        try:
            with path.open("x", encoding="utf-8") as file:
                json.dump({"host": socket.gethostname(), "process": os.getpid()}, file)
        except FileExistsError:
            return False
        return True

    def _keep_alive(self, key: str, ended: threading.Event) -> None:
        while not ended.wait(HEARTBEAT_S):
            with contextlib.suppress(FileNotFoundError):
                os.utime(self._path(key, "claim"))
