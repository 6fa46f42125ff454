"""Cells, the combinations of a grid, and the key under which the results of a cell are stored."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import check_whole
from psotrack.settings import TrackSettings

#: Part of every key. Raise it when the same cell would give other rows.
SCHEMA = 1


class Perturbation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Errors that are added to a cell's input before tracking; 0 adds no error.

    Attributes:
        extrinsics_deg: angle by which every camera is turned about its own centre, around a random axis, degrees.
        clock_frames: largest delay of a camera, frames; each camera gets a random delay from 0 to this, with fractions.
        flipped: share of the full-size silhouettes' pixels that are inverted.
        draw: number of the random draw, from 0.

    Raises:
        SettingsError: a value is out of range.
    """

    extrinsics_deg: float = 0.0
    clock_frames: float = 0.0
    flipped: float = 0.0
    draw: int = 0

    def __post_init__(self) -> None:
        for name, most in (("extrinsics_deg", 180), ("clock_frames", math.inf), ("flipped", 1)):
            value = getattr(self, name)
            if not (0 <= value <= most and math.isfinite(value)):
                expected = f"a number from 0 to {most}" if math.isfinite(most) else "a number of at least 0"
                raise SettingsError(name, expected=expected, found=f"{value:g}")
        check_whole("draw", self.draw, lowest=0)

    @property
    def is_random(self) -> bool:
        """Whether the perturbation uses random numbers."""
        return any((self.extrinsics_deg, self.clock_frames, self.flipped))


@dataclass(frozen=True)
class Cell:
    """One combination of a grid.

    Attributes:
        sequence: the sequence, as the grid names it: a folder, or a name under the data's root.
        method: name of the cell's table [methods.NAME]; "" if the grid has no such tables.
        cameras: names of the cameras; or their number, for a random choice by `perturbation.draw`; None for all.
        frames: number of frames, from the first on; None for all frames.
        perturbation: errors that are added to the input.
        settings: settings of every run; the seed is 0, and each run replaces it by its own.
        runs: number of runs.
        axes: values that the grid varies, by dotted name; cameras as text.
        first_seed: seed of the first run.
    """

    sequence: str
    method: str
    cameras: tuple[str, ...] | int | None
    frames: int | None
    perturbation: Perturbation
    settings: TrackSettings
    runs: int
    axes: Mapping[str, Any]
    first_seed: int = 0

    @property
    def seeds(self) -> range:
        """Seeds of the runs, in order."""
        return range(self.first_seed, self.first_seed + self.runs)

    @property
    def is_random(self) -> bool:
        """Whether the cell's input depends on random numbers."""
        return isinstance(self.cameras, int) or self.perturbation.is_random


def cell_key(cell: Cell, input_keys: Mapping[str, str]) -> str:
    """Key of a cell's results: a digest, 40 hexadecimal digits, of everything except the seed that decides a row.

    `runs`, `first_seed` and `axes` are not part of the key. Rows of a cell are distinguished by their seeds, so more
    runs of a finished cell only add rows. The key contains the name of the sequence's folder and the sequence's
    content, but not the folder's place. It contains the method's name, because rows have a column with this name.

    Args:
        cell: the cell.
        input_keys: digests of everything that the cell reads, by name (see `Inputs.keys_of`).
    """
    made_of = {
        "schema": SCHEMA,
        "sequence": Path(cell.sequence).name,
        "method": cell.method,
        "cameras": cell.cameras,
        "frames": cell.frames,
        "perturbation": msgspec.to_builtins(cell.perturbation),
        "settings": msgspec.to_builtins(msgspec.structs.replace(cell.settings, seed=0)),
        "input": dict(input_keys),
    }
    return hashlib.blake2b(msgspec.json.encode(made_of, order="deterministic"), digest_size=20).hexdigest()


def failure_name(cell: Cell) -> str:
    """Name under which a cell's failure is stored; it does not depend on whether the cell's input can be read."""
    return cell_key(cell, {"sequence": cell.sequence})


def title(cell: Cell) -> str:
    """Description of a cell in one line."""
    axes = (f"{name}={value}" for name, value in cell.axes.items())
    return " ".join(word for word in (Path(cell.sequence).name, cell.method, *axes) if word)
