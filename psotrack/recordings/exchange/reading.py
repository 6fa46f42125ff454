"""Reading of tracks in any of the formats, which is recognised by the path's ending and content."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, errors_name
from psotrack.recordings import Recording
from psotrack.recordings.exchange.c3d_files import read_c3d_tracks
from psotrack.recordings.exchange.json_files import read_json_tracks
from psotrack.recordings.exchange.kitti_files import POSES, read_kitti
from psotrack.recordings.exchange.mcap_files import read_mcap
from psotrack.recordings.exchange.mot_files import TRACKS, WORLD, read_mot_positions
from psotrack.recordings.exchange.number_lines import first_line, number_words
from psotrack.recordings.exchange.timed_paths import joined
from psotrack.recordings.exchange.tum_files import read_tum_files
from psotrack.trajectories import Trajectories, read_trajectories

_KINDS = (
    "tracks as .csv, .parquet, .json, .tum, .txt (TUM, KITTI or MOT), .c3d or .mcap, or a folder of TUM, KITTI, MOT or "
    "MCAP files"
)
#: Numbers per line of a TUM file and of a KITTI file; more than 6 with commas are MOT.
_TUM, _KITTI = 8, 12


def read_tracks(path: Path | str, *, recording: Recording | None = None) -> Trajectories:
    """Read tracks of psotrack or of another program, from a file or a folder.

    CSV and Parquet (see `read_trajectories`), JSON, TUM, KITTI, MOT 3D, C3D and MCAP are recognised by ending and
    content. Poses that have times only get the frame numbers of the recording's instants, if all their times are
    instants; a rate of their own, if all times are multiples of an interval; else they are interpolated at the
    instants, never across a missing sample.

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
    instant_s = None if recording is None else recording.timeline().time_s.astype(np.float64)
    with errors_name(path):
        read = _read_folder if path.is_dir() else _read_file
        return read(path, recording, instant_s)


def _read_folder(
    path: Path, recording: Recording | None, instant_s: Float[np.ndarray, "instants"] | None
) -> Trajectories:
    if (path / WORLD / TRACKS).is_file():
        return read_mot_positions(path / WORLD / TRACKS, recording)
    if any(path.glob("*.mcap")):
        return joined(path, read_mcap(path), instant_s)
    files = sorted(path.glob("*.tum"))
    if files:
        return joined(path, read_tum_files(path, files), instant_s)
    folder = path / POSES if (path / POSES).is_dir() else path
    files = [file for file in sorted(folder.glob("*.txt")) if not file.stem.endswith("times")]
    counts = {len(number_words(first_line(file))) for file in files}
    if counts == {_TUM}:
        return joined(path, read_tum_files(path, files), instant_s)
    if counts == {_KITTI}:
        return joined(path, [read_kitti(file, instant_s) for file in files], instant_s)
    found = "files of boxes alone" if (path / "trackers").is_dir() else "a folder without them"
    raise InputError(path, expected=_KINDS, found=found)


def _read_file(
    path: Path, recording: Recording | None, instant_s: Float[np.ndarray, "instants"] | None
) -> Trajectories:
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet", ".json", ".tum", ".txt", ".c3d", ".mcap"):
        raise InputError(path, expected=_KINDS, found=repr(path.name))
    if path.stat().st_size == 0:
        raise InputError(path, expected="tracks", found="an empty file")
    if suffix == ".json":
        return read_json_tracks(path)
    if suffix == ".c3d":
        return read_c3d_tracks(path, recording)
    if suffix == ".mcap":
        return joined(path, read_mcap(path), instant_s)
    if suffix == ".tum":
        return joined(path, read_tum_files(path, [path]), instant_s)
    if suffix == ".csv" and not _are_numbers(path):
        return read_trajectories(path, fps=None if recording is None else recording.fps)
    if suffix == ".parquet":
        return read_trajectories(path, fps=None if recording is None else recording.fps)
    return _read_text(path, recording, instant_s)


def _read_text(
    path: Path, recording: Recording | None, instant_s: Float[np.ndarray, "instants"] | None
) -> Trajectories:
    line = first_line(path)
    count = len(number_words(line))
    if "," not in line and count == _TUM:
        return joined(path, read_tum_files(path, [path]), instant_s)
    if "," not in line and count == _KITTI:
        return joined(path, [read_kitti(path, instant_s)], instant_s)
    if "," in line or count == 10:
        return read_mot_positions(path, recording)
    raise InputError(
        path,
        expected="8 numbers per line (TUM), 12 (KITTI), or 10 with commas (MOT)",
        found=repr(line[:80]) if line else "no line with numbers",
    )


def _are_numbers(path: Path) -> bool:
    """Whether the first line of a CSV file has numbers, as a MOT file, rather than names of columns."""
    words = number_words(first_line(path))
    try:
        return bool(words) and bool([float(word) for word in words])
    except ValueError:
        return False
