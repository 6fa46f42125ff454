"""TUM files of one or more drones, with their own times; `psotrack.trajectories.tum` has the format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from psotrack.errors import InputError
from psotrack.recordings.exchange.timed_paths import TimedPath, known_orientations
from psotrack.trajectories.tum import read_tum


def read_tum_files(where: Path, files: Sequence[Path]) -> list[TimedPath]:
    """The paths in TUM files; each drone has the name of its file.

    Raises:
        InputError: there is no file, or a file cannot be read.
    """
    if not files:
        raise InputError(where, expected="a folder with TUM files", found="none")
    paths = []
    for file in files:
        read = read_tum(file)
        orientation = (
            None if read.orientation_wxyz is None else known_orientations(read.orientation_wxyz[:, 0])
        )
        paths.append(TimedPath(file.stem, read.time_s, read.position_m[:, 0], orientation))
    return paths
