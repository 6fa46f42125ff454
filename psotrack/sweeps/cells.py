"""Cells, the combinations of a grid, and the key under which the results of a cell are stored.

A key is NAME-INPUT. NAME is a digest of the combination alone. INPUT is a digest of everything that the cell reads and
of the code that computes its rows, so that rows of another recording or of another tracker have another key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from psotrack.settings import TrackSettings, flatten
from psotrack.support import Share, check_types, digest_record

#: Number of hexadecimal digits of a digest in names.
_DIGITS = 20


class Perturbation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Errors that are added to a cell's input before tracking; 0 adds no error.

    Attributes:
        extrinsics_deg: angle by which every camera is turned about its own centre, around a random axis, degrees.
        clock_frames: largest delay of a camera, frames; each camera gets a random delay from 0 to this, with fractions.
        flipped: fraction of the full-size silhouettes' pixels that are inverted.
        draw: number of the random draw, from 0.

    Raises:
        SettingsError: a value is out of range.
    """

    extrinsics_deg: Annotated[float, msgspec.Meta(ge=0, le=180)] = 0.0
    clock_frames: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 0.0
    flipped: Share = 0.0
    draw: Annotated[int, msgspec.Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        check_types(self)

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


def input_digest(keys: Mapping[str, str]) -> str:
    """One digest of the digests of everything on which a cell's rows depend besides its combination."""
    return digest_record(keys)[:_DIGITS]


def cell_name(cell: Cell) -> str:
    """Digest of a cell's combination: of everything that a grid says of the cell, except its seeds.

    `runs`, `first_seed` and `axes` are not part of it: rows of a cell are distinguished by their seeds, so more runs of
    a finished cell only add rows. The place of the sequence's folder is not part of it either. The method's name is,
    because rows have a column with this name.
    """
    return digest_record(
        {
            "sequence": Path(cell.sequence).name,
            "method": cell.method,
            "cameras": cell.cameras,
            "frames": cell.frames,
            "perturbation": cell.perturbation,
            "settings": msgspec.structs.replace(cell.settings, seed=0),
        }
    )[:_DIGITS]


def cell_key(cell: Cell, input_keys: Mapping[str, str]) -> str:
    """Key of a cell's results: a digest of everything except the seed that decides a row.

    Args:
        cell: the cell.
        input_keys: digests of everything that the cell reads, and of the code, by name (see `Inputs.keys_of`).
    """
    return f"{cell_name(cell)}-{input_digest(input_keys)}"


def cameras_label(cameras: tuple[str, ...] | int | None) -> str:
    """Text for a cell's cameras: `all`, their number such as `4`, or names such as `cam1+cam2`."""
    if cameras is None:
        return "all"
    return str(cameras) if isinstance(cameras, int) else "+".join(cameras)


def describe(cell: Cell) -> dict[str, Any]:
    """Description of a cell as a flat table, whose names have dots."""
    settings = msgspec.to_builtins(cell.settings)
    del settings["seed"]
    return {
        "sequence": Path(cell.sequence).name,
        "method": cell.method,
        "cameras": cameras_label(cell.cameras),
        "frames": cell.frames,
        **{f"perturbation.{name}": value for name, value in msgspec.to_builtins(cell.perturbation).items()},
        **{f"settings.{name}": value for name, value in flatten(settings)},
    }


def title(cell: Cell) -> str:
    """Description of a cell in one line."""
    axes = (f"{name}={value}" for name, value in cell.axes.items())
    return " ".join(word for word in (Path(cell.sequence).name, cell.method, *axes) if word)
