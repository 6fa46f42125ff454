"""What cells read: sequences and silhouettes, and the digests of it all that make a cell's key."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.datasets.dpjait import read_sequence
from psotrack.errors import InputError, PsotrackError
from psotrack.methods import detection_files_of
from psotrack.recordings import Sequence
from psotrack.silhouettes import Silhouettes, SilhouetteSettings, compute
from psotrack.silhouettes import key_of as silhouettes_key_of
from psotrack.sweep.cells import Cell
from psotrack.sweep.locks import claimed
from psotrack.sweep.perturbations import perturbed

#: Folders of the data's root in which a sequence may lie.
HALVES = ("Simulated_Data", "Real_Data", ".")

#: What decides which silhouettes a cell needs; None where it needs none.
Source = tuple[str, int | None, SilhouetteSettings | None]


@dataclass(frozen=True)
class Input:
    """A sequence as a cell sees it."""

    sequence: Sequence
    silhouettes: Silhouettes | None


@dataclass
class Inputs:
    """The inputs of cells, each looked for once; of silhouettes the last are remembered.

    Attributes:
        data: root folder of the sequences that grids name.
        cache: folder of the stored silhouettes.
        jobs: processes for the silhouettes; None is one per processor.
    """

    data: Path
    cache: Path
    jobs: int | None = None
    _sources: dict[Source, tuple[Sequence, dict[str, str]]] = field(default_factory=dict)
    _last: tuple[Any, Input | PsotrackError] | None = None

    def keys_of(self, cell: Cell) -> dict[str, str]:
        """Digests of all that a cell reads: silhouettes by camera, calibration, reference, detections.

        Raises:
            InputError: it cannot be read.
            SettingsError: there are not so many frames.
        """
        sequence, keys = self._source(cell)
        keys = dict(keys)
        if Path(cell.settings.init).is_file():
            keys["init"] = _digest_of_file(Path(cell.settings.init))
        if cell.settings.reads_detections:
            files = detection_files_of(sequence, cell.settings.detections)
            keys |= {f"detections of {name}": _digest_of_file(path) for name, path in files.items()}
        return keys

    def sequence_of(self, cell: Cell) -> Sequence:
        """A cell's sequence, with all cameras.

        Raises:
            InputError: it cannot be read.
            SettingsError: there are not so many frames.
        """
        return self._source(cell)[0]

    def read(self, cell: Cell) -> Input | None:
        """What a cell reads; None as long as somebody else makes the silhouettes.

        Raises:
            PsotrackError: that cannot be had.
        """
        wanted, last = (source_of(cell), cell.cameras, cell.perturbation), self._last
        if last is None or last[0] != wanted:
            given = self._made(cell)
            if given is None:
                return None
            last = self._last = wanted, given
        if isinstance(last[1], PsotrackError):
            raise last[1]
        return last[1]

    def _made(self, cell: Cell) -> Input | PsotrackError | None:
        """What a cell reads, or why that cannot be had; None as long as somebody else makes the silhouettes."""
        sequence = self.sequence_of(cell)
        try:
            if not cell.settings.needs_silhouettes:
                return Input(*perturbed(sequence, None, cell.perturbation, cell.cameras))
            with claimed(self.claim_of(cell), f"silhouettes of {cell.sequence}") as ours:
                if not ours:
                    return None
                silhouettes = compute(sequence, cell.settings.silhouettes, cache=self.cache, jobs=self.jobs)
            return Input(*perturbed(sequence, silhouettes, cell.perturbation, cell.cameras))
        except PsotrackError as error:
            return error

    def claim_of(self, cell: Cell) -> Path:
        """By which those who need a cell's silhouettes agree who makes them."""
        return self.cache / f"{digest_of(self._source(cell)[1])}.claim"

    def _source(self, cell: Cell) -> tuple[Sequence, dict[str, str]]:
        """A cell's sequence with all cameras, and digests of it."""
        source = source_of(cell)
        if source not in self._sources:
            sequence = read_sequence(folder_of(cell.sequence, self.data)).usable(None, cell.frames)
            if sequence.truth is None:
                raise InputError(sequence.folder, expected="a reference to compare with", found="none")
            keys = {}
            if cell.settings.needs_silhouettes:
                with ThreadPoolExecutor() as threads:
                    key_of = partial(silhouettes_key_of, settings=cell.settings.silhouettes)
                    of_videos = threads.map(key_of, sequence.videos.values())
                    keys = dict(zip(sequence.videos, of_videos, strict=True))
            keys |= {
                "calibration": _digest(*vars(sequence.rig.cameras).values()),
                "reference": _digest(sequence.truth.position_m, sequence.truth.orientation_wxyz),
            }
            self._sources[source] = sequence, keys
        return self._sources[source]


def source_of(cell: Cell) -> Source:
    """What decides which silhouettes a cell needs."""
    settings = cell.settings
    return cell.sequence, cell.frames, settings.silhouettes if settings.needs_silhouettes else None


def folder_of(sequence: str, data: Path) -> Path:
    """The folder of a sequence that a grid names.

    Raises:
        InputError: there is none.
    """
    places = [Path(sequence), *(data / half / sequence for half in HALVES)]
    for place in places:
        if place.is_dir():
            return place
    raise InputError(
        data, expected=f"the sequence {sequence}", found="none", remedy="name the data's root with --data"
    )


def digest_of(keys: Mapping[str, str]) -> str:
    """One name for all that a cell reads."""
    lines = [f"{name} {keys[name]}" for name in sorted(keys)]
    return hashlib.blake2b("\n".join(lines).encode(), digest_size=20).hexdigest()


def _digest(*arrays: Any) -> str:
    digest = hashlib.blake2b(digest_size=20)
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes() if array is not None else b"none")
    return digest.hexdigest()


def _digest_of_file(path: Path) -> str:
    return _digest(np.frombuffer(path.read_bytes(), np.uint8))
