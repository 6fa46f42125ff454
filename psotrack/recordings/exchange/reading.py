"""Reading of tracks in any of the formats, which is recognised by the path's ending and content."""

from __future__ import annotations

from pathlib import Path

from psotrack.errors import InputError, errors_name
from psotrack.recordings import Recording
from psotrack.recordings.exchange.formats import read_file, read_folder
from psotrack.trajectories import Trajectories


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
    with errors_name(path):
        return read_folder(path, recording) if path.is_dir() else read_file(path, recording)
