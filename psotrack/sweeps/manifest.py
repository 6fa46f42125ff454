"""The manifest of a folder of results: which grids were run, on which machines, from which inputs.

    runs      one entry per grid, version and machine: the grid, and when it was first and last run
    inputs    for each value of the rows' column `input`: the sequence, its frames, digests of its files and of
              the code; what was used last comes last

Several grids may be run into one folder, on several machines; each has its own entry.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from psotrack.sweeps.cells import Cell, input_digest
from psotrack.sweeps.grid_files import Grid


def note_run(manifest: dict[str, Any], grid: Grid, origin: Mapping[str, Any]) -> None:
    """Record in a manifest that a grid is run.

    Args:
        manifest: content of the manifest, changed in place.
        grid: the grid.
        origin: versions, device, code and commit.
    """
    content = {name: value for name, value in asdict(grid).items() if name != "where"}
    # The entry must compare equal to one that was read from JSON, where tuples are lists.
    entry = json.loads(json.dumps({"grid": content, "cells": len(grid.cells()), **origin}))
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    for run in manifest["runs"]:
        if {name: value for name, value in run.items() if name not in ("first", "last")} == entry:
            run["last"] = now
            return
    manifest["runs"].append(entry | {"first": now, "last": now})


def note_input(manifest: dict[str, Any], cell: Cell, keys: Mapping[str, str]) -> None:
    """Record in a manifest what a cell reads, after everything that was recorded before.

    Args:
        manifest: content of the manifest, changed in place.
        cell: the cell.
        keys: digests of everything that the cell reads.
    """
    name = input_digest(keys)
    manifest["inputs"].pop(name, None)
    manifest["inputs"][name] = {
        "sequence": Path(cell.sequence).name,
        "frames": cell.frames,
        "silhouettes": msgspec.to_builtins(cell.settings.silhouettes),
        "keys": dict(keys),
    }
