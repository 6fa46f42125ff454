"""What manifest.json says of a folder of results.

    runs      of each grid, version and machine: what was asked for, when first, when last
    inputs    what the column `input` of the rows stands for: a sequence, its frames, digests of its files

Many grids may be run into one folder, on many machines: nothing of what the manifest says of one is lost to another.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from psotrack.sweep.cells import Cell
from psotrack.sweep.grid_files import Grid
from psotrack.sweep.inputs import digest_of


def note_run(manifest: dict[str, Any], grid: Grid, origin: Mapping[str, Any]) -> None:
    """Say in a manifest that a grid is run now.

    Args:
        manifest: is changed.
        grid: as it was read.
        origin: versions, device and commit.
    """
    asked = {name: value for name, value in asdict(grid).items() if name != "where"}
    # As it will be read again, where tuples are lists.
    entry = json.loads(json.dumps({"grid": asked, "cells": len(grid.cells()), **origin}))
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    for run in manifest["runs"]:
        if {name: value for name, value in run.items() if name not in ("first", "last")} == entry:
            run["last"] = now
            return
    manifest["runs"].append(entry | {"first": now, "last": now})


def note_input(manifest: dict[str, Any], cell: Cell, keys: Mapping[str, str]) -> None:
    """Say in a manifest what a cell reads.

    Args:
        manifest: is changed.
        cell: that reads.
        keys: digests of all that it reads.
    """
    manifest["inputs"][digest_of(keys)] = {
        "sequence": Path(cell.sequence).name,
        "frames": cell.frames,
        "silhouettes": msgspec.to_builtins(cell.settings.silhouettes),
        "keys": dict(keys),
    }
