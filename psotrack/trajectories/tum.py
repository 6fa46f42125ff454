"""TUM files: one pose per line, `timestamp tx ty tz qx qy qz qw`, one file per drone; for the program evo.

The format is defined by the TUM RGB-D benchmark (Sturm et al., IROS 2012). It has neither frame numbers nor status.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psotrack.support import (
    atomic_write,
    check_file_name,
    first_repeat,
    first_true,
    read_numbers,
    refuse_to_overwrite,
)
from psotrack.trajectories.trajectories import Trajectories, timed_path

_HEADER = "# timestamp tx ty tz qx qy qz qw"
_UNKNOWN = "# orientation unknown: 0 0 0 1 in every line"


def write_tum(folder: Path | str, trajectories: Trajectories, *, force: bool = False) -> list[Path]:
    """Write `folder`/NAME.tum for each drone, with the frames in which the drone is seen.

    Numbers have the fewest digits that give the same number in the array's own precision. If an orientation of a drone
    is unknown in one of these frames, all its orientations are written as the identity, with a comment in the file.

    Args:
        folder: folder of the files.
        trajectories: the drones' poses.
        force: replace existing files.

    Returns:
        The paths of the files, one per drone.

    Raises:
        InputError: a drone's name cannot be the name of a file.
        OutputError: a file exists and `force` is not set, or it cannot be written; older files are unchanged.
    """
    names = [check_file_name(name, "drones") for name in trajectories.drones]
    paths = [Path(folder) / f"{name}.tum" for name in names]
    for path in paths:
        refuse_to_overwrite(path, force)
    for drone, path in enumerate(paths):
        with atomic_write(path) as temporary:
            temporary.write_text(tum_text(trajectories, drone), encoding="utf-8")
    return paths


def read_tum(path: Path | str) -> Trajectories:
    """Read one TUM file with its own times; frames are numbered by line, and the drone has the file's name.

    Orientations that are all the identity are unknown.

    Raises:
        InputError: the file cannot be read, a line is not a pose, or times do not increase. The message names file and
            line.
    """
    path = Path(path)
    read = read_numbers(path, 8, "8 finite numbers: timestamp tx ty tz qx qy qz qw")
    time_s, position_m, quaternion = read.values[:, 0], read.values[:, 1:4], read.values[:, 4:]
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    if (row := first_true(length[:, 0] == 0)) is not None:
        raise read.error(row, expected="a quaternion", found="0 0 0 0")
    if (row := first_repeat(time_s)) is not None:
        found = f"{time_s[row]} s after {time_s[row - 1]} s"
        raise read.error(row, expected="times that increase from line to line", found=found)
    return timed_path(path.stem, time_s, position_m, np.roll(quaternion / length, 1, axis=-1))


def tum_text(trajectories: Trajectories, drone: int) -> str:
    """The content of the file of one drone, by its index."""
    seen = trajectories.seen[:, drone]
    orientation = trajectories.orientation_wxyz
    known = orientation is not None and bool(np.isfinite(orientation[seen, drone]).all())
    columns = [trajectories.time_s[seen], *trajectories.position_m[seen, drone].T]
    if orientation is not None and known:
        columns += list(np.roll(orientation[seen, drone], -1, axis=-1).T)
    else:
        columns += list(np.tile([0, 0, 0, 1], (int(seen.sum()), 1)).T)
    words = [column.astype(str) for column in columns]
    lines = [_HEADER] + [_UNKNOWN] * (not known) + [" ".join(row) for row in zip(*words, strict=True)]
    return "".join(f"{line}\n" for line in lines)
