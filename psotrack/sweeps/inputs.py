"""Inputs of cells, sequences and silhouettes; their digests, which are part of a cell's key; the origin of results."""

from __future__ import annotations

import platform
import subprocess
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.errors import InputError, PsotrackError
from psotrack.foreground.silhouettes import Silhouettes, SilhouetteSettings, compute, stored_silhouettes
from psotrack.pipeline import check_detections, detection_files_of, environment, usable_for
from psotrack.recordings import Recording
from psotrack.recordings.datasets import open_recording
from psotrack.settings import YOLO
from psotrack.support import Locks, PluginKind, digest_file, digest_record, plain, plugin_source, processors
from psotrack.sweeps.cells import Cell, input_digest, perturb
from psotrack.trajectories import Trajectories, resample

_PACKAGE = Path(__file__).parents[1]
#: Rooms and modules that compute no part of a row, by the beginnings of their paths in the package.
COMPUTES_NO_ROW = (
    *("__main__", "api", "cli/", "demo", "inside_out/", "live/", "show/", "simulation/"),
    *("sweeps/grid_files", "sweeps/grid_runs", "sweeps/tables"),
)


@cache
def code_digest() -> str:
    """Digest of the source of everything that computes a row of results.

    A change of one of these files changes the key of every cell, so that its rows are computed again.
    """
    files = {path.relative_to(_PACKAGE).as_posix(): path for path in _PACKAGE.rglob("*.py")}
    kept = {name: path for name, path in files.items() if not name.startswith(COMPUTES_NO_ROW)}
    return digest_record({name: path.read_text(encoding="utf-8") for name, path in kept.items()})


def provenance() -> dict[str, Any]:
    """Versions, device, code and commit, as nested tables for JSON."""
    this = environment()
    device = this["device"] | {"processor": _processor(), "processors": processors()}
    return {"versions": this["versions"], "device": device, "code": code_digest(), "commit": commit()}


@cache
def commit(package: Path = _PACKAGE) -> str:
    """Commit of the package, with "-dirty" after changes; "" if the package is not in a git checkout of its own."""
    try:
        # An installed package may be inside the checkout of another project, whose commit says nothing.
        _git(package, "ls-files", "--error-unmatch", "__init__.py")
        return _git(package, "describe", "--always", "--dirty", "--exclude=*", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(folder: Path, *words: str) -> str:
    command = ["git", "--no-optional-locks", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


@cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


#: Folders below the data's root in which a sequence is looked for.
HALVES = ("Simulated_Data", "Real_Data", ".")

#: Sequence, number of frames, settings of the silhouettes and folder of the detections that a cell needs, and whether
#: each camera needs a video; None if it needs no silhouettes, or no folder.
Source = tuple[str, int | None, SilhouetteSettings | None, str | None, bool]


@dataclass(frozen=True)
class Input:
    """A recording after a cell's perturbation, and its silhouettes; None for a method that reads no silhouettes."""

    recording: Recording
    silhouettes: Silhouettes | None

    def reference(self, rate_hz: float | None) -> Trajectories:
        """The reference at the instants at which the recording is tracked, and at no others.

        Args:
            rate_hz: instants per second of a run; None is the recording's own rate.
        """
        truth, instant = self.recording.truth, np.arange(self.recording.at_rate(rate_hz).num_frames)
        assert truth is not None
        if rate_hz is None:
            return truth.at_frames(np.intersect1d(truth.frame, instant))
        return resample(truth, instant, self.recording.timeline(rate_hz).time_s)


@dataclass
class Inputs:
    """Reads the inputs of cells. Each sequence is read once; the silhouettes of the last cell stay in memory.

    Attributes:
        data: root folder of the sequences that grids name.
        cache: folder of the stored silhouettes.
        jobs: number of processes that make silhouettes; None is one per processor.
        locks: the locks that this runner takes on silhouettes.
    """

    data: Path
    cache: Path
    jobs: int | None = None
    locks: Locks = field(default_factory=Locks)
    _sources: dict[Source, tuple[Recording, dict[str, str]]] = field(default_factory=dict)
    _last: tuple[Any, Input | PsotrackError] | None = None

    def keys_of(self, cell: Cell) -> dict[str, str]:
        """Digests of everything on which a cell's rows depend besides its combination: what it reads, and the code.

        That is the content of videos and what silhouettes are made of, or detections; lenses and poses of the cameras;
        the times of their frames and rows; the reference, the room's bounds and the first positions.

        Raises:
            InputError: a file cannot be read.
            SettingsError: the sequence has fewer frames than the cell needs.
        """
        recording, keys = self._source(cell)
        settings, keys = cell.settings, {**keys, "code": code_digest()}
        named: dict[PluginKind, str] = {
            "method": settings.method,
            "search": settings.swarm.search,
            "score": settings.score.kind,
            "background": settings.silhouettes.background,
        }
        for kind, name in named.items():
            source = plugin_source(kind, name)
            if source is not None:
                keys[f"{kind} {name}"] = digest_file(source)
        if Path(settings.init).is_file():
            keys["init"] = digest_file(Path(settings.init))
        if settings.reads_detections:
            files = detection_files_of(recording, settings.detections)
            keys |= {f"detections of {name}": digest_file(path) for name, path in files.items()}
        return keys

    def recording_of(self, cell: Cell) -> Recording:
        """Recording of a cell, with all cameras.

        Raises:
            InputError: the sequence cannot be read, or has no reference.
            SettingsError: the sequence has fewer frames than the cell needs.
        """
        return self._source(cell)[0]

    def read(self, cell: Cell) -> Input | None:
        """Input of a cell; None as long as another process makes the silhouettes.

        Raises:
            PsotrackError: the input cannot be read or made.
        """
        wanted = (source_of(cell), cell.cameras, cell.perturbation)
        if self._last is None or self._last[0] != wanted:
            given = self._make(cell)
            if given is None:
                return None
            self._last = wanted, given
        if isinstance(self._last[1], PsotrackError):
            raise self._last[1]
        return self._last[1]

    def _make(self, cell: Cell) -> Input | PsotrackError | None:
        """Input of a cell, or the error of making it; None as long as another process makes the silhouettes."""
        recording, silhouettes = self.recording_of(cell), None
        try:
            if cell.settings.needs_silhouettes:
                with self.locks.attempt(self.silhouettes_lock(cell)) as locked:
                    if not locked:
                        return None
                    silhouettes = compute(
                        recording,
                        cell.settings.silhouettes,
                        cache=self.cache,
                        jobs=self.jobs,
                        all_videos=cell.settings.needs_each_video,
                    )
            return Input(*perturb(recording, silhouettes, cell.perturbation, cell.cameras))
        except PsotrackError as error:
            return error

    def silhouettes_lock(self, cell: Cell) -> Path:
        """Path of the lock that one process holds while it makes a cell's silhouettes."""
        return self.cache / f".{input_digest(self._source(cell)[1])}.lock"

    def _source(self, cell: Cell) -> tuple[Recording, dict[str, str]]:
        """Recording of a cell, with all cameras, and digests of its content."""
        source = source_of(cell)
        if source not in self._sources:
            opened = open_recording(folder_of(cell.sequence, self.data))
            check_detections(opened, cell.settings)
            recording = usable_for(opened, cell.settings, num_frames=cell.frames)
            if recording.truth is None:
                raise InputError(recording.folder, expected="a reference to compare with", found="none")
            keys = {}
            if cell.settings.needs_silhouettes:
                stored = stored_silhouettes(recording, cell.settings.silhouettes, self.cache)
                keys = {f"silhouettes of {name}": each.key for name, each in stored.items()}
            read = {
                "cameras": recording.rig,
                "times": recording.timeline(),
                "reference": recording.truth,
                "bounds": recording.bounds_m,
            }
            keys |= {name: digest_record(_plain(value)) for name, value in read.items()}
            self._sources[source] = recording, keys
        return self._sources[source]


def source_of(cell: Cell) -> Source:
    """What a cell needs of the data: see `Source`."""
    settings = cell.settings
    silhouettes = settings.silhouettes if settings.needs_silhouettes else None
    folder = settings.detections if settings.reads_detections and settings.detections != YOLO else None
    return cell.sequence, cell.frames, silhouettes, folder, settings.needs_each_video


def folder_of(sequence: str, data: Path) -> Path:
    """Folder, or `recording.toml`, of a sequence that a grid names.

    Raises:
        InputError: there is no such folder or file.
    """
    places = [Path(sequence), *(data / half / sequence for half in HALVES)]
    for place in places:
        if place.exists():
            return place
    raise InputError(
        data, expected=f"the sequence {sequence}", found="none", remedy="name the data's root with --data"
    )


def _plain(value: Any) -> Any:
    """A record of arrays as plain data."""
    if is_dataclass(value):
        return {each.name: _plain(getattr(value, each.name)) for each in fields(value)}
    return plain(value)
