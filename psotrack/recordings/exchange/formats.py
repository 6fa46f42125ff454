"""The formats of tracks: what each can hold, how it is written, and how a file or a folder of it is read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from psotrack.errors import InputError, errors_name
from psotrack.recordings import Recording
from psotrack.recordings.exchange.c3d_files import read_c3d_tracks, write_c3d_tracks
from psotrack.recordings.exchange.camera_boxes import Footage
from psotrack.recordings.exchange.json_files import read_json_tracks, write_json_tracks
from psotrack.recordings.exchange.kitti_files import POSES, read_kitti, write_kitti
from psotrack.recordings.exchange.mcap_files import read_mcap, write_mcap
from psotrack.recordings.exchange.mot_files import TRACKS, WORLD, read_mot_positions, write_mot
from psotrack.recordings.exchange.timed_paths import joined, on_clock, timed_path
from psotrack.support import Report, are_numbers, check_kind, first_line, number_words
from psotrack.trajectories import Trajectories, read_trajectories, write_trajectories
from psotrack.trajectories.tum import read_tum, tum_text, write_tum

#: What some formats cannot hold, as messages name it: quantities of `Trajectories`, and what is no such quantity.
PHRASES = {
    "orientations": "orientation_wxyz",
    "covariances": "covariance_m2",
    "covariances without constant errors": "relative_covariance_m2",
    "velocities": "velocity_m_s",
    "fitness": "fitness",
    "numbers of cameras": "num_cameras",
}
NAMES, TIMES, STATUS = "names of drones", "times", "status"
_POSES = frozenset({NAMES, TIMES, "orientations"})
_ALL = frozenset({NAMES, TIMES, *PHRASES, STATUS})
#: Numbers per line of a TUM file and of a KITTI file; more than 6 with commas are MOT.
_TUM, _KITTI = 8, 12
#: Writes tracks to a path, and returns what is missing in it as noun phrases.
Write = Callable[[Path, Trajectories, Footage | None, Report], list[str]]
Read = Callable[[Path, Recording | None], Trajectories]


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks.

    Attributes:
        holds: which quantities the format holds.
        write: writes a file, or a folder where the path has none of the endings.
        suffixes: endings of a file's name; none where the format is always a folder.
        entries: names, or patterns of names, of what a folder of the format contains: a folder with anything else is
            not replaced. None where the format is always a file.
        is_of_one: whether a file holds one drone only, and its name is the drone's.
        needs_all: whether drones that are never seen are written, too.
    """

    holds: frozenset[str]
    write: Write
    suffixes: tuple[str, ...] = ()
    entries: tuple[str, ...] = ()
    is_of_one: bool = False
    needs_all: bool = False


def _write_tum(path: Path, tracks: Trajectories, footage: Footage | None, report: Report) -> list[str]:
    if path.suffix in FORMATS["tum"].suffixes:
        path.write_text(tum_text(tracks, 0), encoding="utf-8")
    else:
        write_tum(path, tracks)
    return []


def _write_table(path: Path, tracks: Trajectories, footage: Footage | None, report: Report) -> list[str]:
    write_trajectories(path, tracks)
    return []


#: The formats by name.
FORMATS = {
    "tum": TrackFormat(_POSES, _write_tum, (".tum", ".txt"), ("*.tum",), is_of_one=True),
    "kitti": TrackFormat(_POSES, write_kitti, entries=("poses", "sequences")),
    "mot": TrackFormat(frozenset(), write_mot, (".txt",), ("3d", "gt", "trackers")),
    "c3d": TrackFormat(frozenset({NAMES}), write_c3d_tracks, (".c3d",), needs_all=True),
    "mcap": TrackFormat(_POSES | {"covariances"}, write_mcap, (".mcap",)),
    "csv": TrackFormat(_ALL, _write_table, (".csv",), needs_all=True),
    "parquet": TrackFormat(_ALL, _write_table, (".parquet",), needs_all=True),
    "json": TrackFormat(_ALL, write_json_tracks, (".json",), needs_all=True),
}


def read_tracks(path: Path | str, *, recording: Recording | None = None) -> Trajectories:
    """Read tracks of psotrack or of another program, from a file or a folder.

    CSV and Parquet (see `read_trajectories`), JSON, TUM, KITTI, MOT 3D, C3D and MCAP are recognised by ending and
    content. Times decide: tracks get the frame numbers of the recording's instants, if all their times are instants; a
    rate of their own, if all times are multiples of an interval; else they are interpolated at the instants, never
    across a missing sample. A warning says where frame numbers in the file say something else.

    Args:
        path: file or folder.
        recording: the recording that was tracked; None if unknown. Without it, files that have neither times nor a rate
            cannot be read.

    Raises:
        InputError: there is no such file, its format is unknown, or it cannot be read.
        SettingsError: the libraries for MCAP are not installed.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, expected="a file or folder of tracks", found="no such file or folder")
    check_kind(path, "tracks")
    read = _read_folder if path.is_dir() else _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(path, expected=_KINDS, found=repr(path.name))
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(path, expected="tracks", found="an empty file")
    with errors_name(path):
        return read(path, recording)


def _read_folder(path: Path, recording: Recording | None) -> Trajectories:
    """Read a folder of TUM, KITTI or MCAP files, or the one that an export to MOT wrote."""
    if (path / WORLD / TRACKS).is_file():
        return read_mot_positions(path / WORLD / TRACKS, recording)
    if any(path.glob("*.mcap")):
        return read_mcap(path, recording)
    if files := sorted(path.glob("*.tum")):
        return _read_tum(path, files, recording)
    folder = path / POSES if (path / POSES).is_dir() else path
    files = [file for file in sorted(folder.glob("*.txt")) if not file.stem.endswith("times")]
    counts = {len(number_words(first_line(file))) for file in files}
    if counts == {_TUM}:
        return _read_tum(path, files, recording)
    if counts == {_KITTI}:
        return joined(path, [read_kitti(file, recording) for file in files], recording)
    found = "files of boxes alone" if (path / "trackers").is_dir() else "a folder without them"
    raise InputError(path, expected=_KINDS, found=found)


def _read_tum(where: Path, files: Sequence[Path], recording: Recording | None) -> Trajectories:
    paths = []
    for file in files:
        read = read_tum(file)
        turns = None if read.orientation_wxyz is None else read.orientation_wxyz[:, 0]
        paths.append(timed_path(file.stem, read.time_s, read.position_m[:, 0], turns))
    return joined(where, paths, recording)


def _read_table(path: Path, recording: Recording | None) -> Trajectories:
    read = read_trajectories(path, fps=None if recording is None else recording.fps)
    return on_clock(path, read, recording)


def _read_csv(path: Path, recording: Recording | None) -> Trajectories:
    """Read a table with names of columns, or lines of numbers without, as in a MOT file."""
    read = _read_text if are_numbers(number_words(first_line(path))) else _read_table
    return read(path, recording)


def _read_text(path: Path, recording: Recording | None) -> Trajectories:
    line = first_line(path)
    count = len(number_words(line))
    if "," in line or count == 10:
        return read_mot_positions(path, recording)
    if count == _TUM:
        return _read_tum(path, [path], recording)
    if count == _KITTI:
        return joined(path, [read_kitti(path, recording)], recording)
    raise InputError(
        path,
        expected="8 numbers per line (TUM), 12 (KITTI), or 10 with commas (MOT)",
        found=repr(line[:80]) if line else "no line with numbers",
    )


#: How a file is read, by its ending.
_READERS: dict[str, Read] = {
    ".csv": _read_csv,
    ".parquet": _read_table,
    ".json": lambda path, recording: on_clock(path, read_json_tracks(path), recording),
    ".tum": lambda path, recording: _read_tum(path, [path], recording),
    ".txt": _read_text,
    ".c3d": read_c3d_tracks,
    ".mcap": read_mcap,
}
_KINDS = (
    f"tracks as {', '.join(_READERS)} (.txt: TUM, KITTI or MOT), or a folder of TUM, KITTI, MOT or MCAP files"
)
