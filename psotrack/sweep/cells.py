"""Cells: one combination of a grid each, and the key under which its results are kept."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from psotrack.errors import SettingsError
from psotrack.settings import TrackSettings
from psotrack.silhouettes import check_whole

#: Part of every key: to be raised whenever the same cell would give other rows.
SCHEMA = 1


class Perturbation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is done to a cell's input before it is tracked; 0 is nothing.

    Attributes:
        extrinsics_deg: every camera is turned about its own centre by so much, about an axis of chance.
        clock_frames: every camera is late by 0 to so many frames, parts of frames included.
        flipped: share of the full-size silhouettes' pixels that are the other way round.
        draw: which of the draws of chance it is.

    Raises:
        SettingsError: a value makes no sense.
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
    def by_chance(self) -> bool:
        """Whether anything of it is drawn."""
        return any((self.extrinsics_deg, self.clock_frames, self.flipped))


@dataclass(frozen=True)
class Cell:
    """One combination of a grid, to be run some times.

    Attributes:
        sequence: as the grid names it: a folder, or a name under the data's root.
        method: the name of its [methods.NAME] table; "" if there are none.
        cameras: names; or how many, drawn by `perturbation.draw`; None for all.
        frames: the first so many; None for all.
        perturbation: what is done to the input.
        settings: of every run, with seed 0 in place of its own.
        runs: how many.
        axes: what the grid varied: dotted names -> values, cameras as text.
        first_seed: of the first run.
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
        """Of the runs, in order."""
        return range(self.first_seed, self.first_seed + self.runs)

    @property
    def by_chance(self) -> bool:
        """Whether anything but the swarm is drawn."""
        return isinstance(self.cameras, int) or self.perturbation.by_chance


def key_of(cell: Cell, input_keys: Mapping[str, str]) -> str:
    """A name for what a cell's runs yield: 40 hexadecimal digits, of everything that decides a row but its seed.

    Not of `runs`, `first_seed` and `axes`: within a cell a row has its seed for a name, so that more runs of a finished
    cell only add rows. A sequence counts by its last name and its content, not by where it lies; a method counts by
    name too, because rows bear it.

    Args:
        cell: whose key it is.
        input_keys: digests of all that is read: silhouettes by camera, calibration, reference.
    """
    settings = msgspec.to_builtins(msgspec.structs.replace(cell.settings, seed=0))
    return digest_cell(cell, settings, input_keys)


def digest_cell(cell: Cell, settings: Mapping[str, Any], input_keys: Mapping[str, str]) -> str:
    """Digest of a cell's input and settings: 40 hexadecimal digits.

    Args:
        cell: the cell.
        settings: the cell's settings, as nested tables.
        input_keys: digests of everything that the cell reads.
    """
    made_of = {
        "schema": SCHEMA,
        "sequence": Path(cell.sequence).name,
        "method": cell.method,
        "cameras": cell.cameras,
        "frames": cell.frames,
        "perturbation": msgspec.to_builtins(cell.perturbation),
        "settings": settings,
        "input": dict(input_keys),
    }
    return hashlib.blake2b(msgspec.json.encode(made_of, order="deterministic"), digest_size=20).hexdigest()


def name_of(cell: Cell) -> str:
    """What a cell's failure is kept under, whether or not its input can be read."""
    return key_of(cell, {"sequence": cell.sequence})


def title(cell: Cell) -> str:
    """A cell in a line."""
    axes = (f"{name}={value}" for name, value in cell.axes.items())
    return " ".join(word for word in (Path(cell.sequence).name, cell.method, *axes) if word)
