"""TUM files: one pose per line, `timestamp tx ty tz qx qy qz qw`, one file per drone; for the program evo.

The format is defined by the TUM RGB-D benchmark (Sturm et al., IROS 2012). It has neither frame numbers nor status.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.support import (
    LEAST_STEP_S,
    atomic_write,
    check_file_name,
    is_moderate,
    read_text,
    refuse_to_overwrite,
)
from psotrack.trajectories.trajectories import Trajectories

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
    folder = Path(folder)
    for name in trajectories.drones:
        check_file_name(name, "drones")
    paths = [folder / f"{name}.tum" for name in trajectories.drones]
    for path in paths:
        refuse_to_overwrite(path, force)
    for drone, path in enumerate(paths):
        with atomic_write(path) as temporary:
            temporary.write_text(tum_text(trajectories, drone), encoding="utf-8")
    return paths


def read_tum(path: Path | str) -> Trajectories:
    """Read one TUM file with its own times; frames are numbered by line, and the drone has the file's name.

    Raises:
        InputError: the file cannot be read, a line is not a pose, or times do not increase. The message names file and
            line.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    poses: list[list[float]] = []
    for place, values in _poses(path, lines):
        if poses and values[0] - poses[-1][0] < LEAST_STEP_S:
            expected = "times that increase from line to line"
            raise InputError(place, expected=expected, found=f"{values[0]} s after {poses[-1][0]} s")
        poses.append(values)
    if not poses:
        raise InputError(path, expected="at least one pose", found="none")
    table = np.array(poses)
    orientation_wxyz = np.roll(_unit(table[:, 4:]), 1, axis=-1)[:, None]
    return Trajectories(
        frame=np.arange(len(table)),
        time_s=table[:, 0],
        drones=(path.stem,),
        position_m=table[:, None, 1:4],
        orientation_wxyz=None if _UNKNOWN in lines else orientation_wxyz,
    )


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


def _poses(path: Path, lines: list[str]) -> Iterator[tuple[str, list[float]]]:
    """Yield place and numbers of each line with a pose."""
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.startswith("#"):
            place = f"{path}, line {number}"
            yield place, _numbers(place, line)


def _unit(quaternions: Float[np.ndarray, "rows 4"]) -> Float[np.ndarray, "rows 4"]:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def _numbers(place: str, line: str) -> list[float]:
    expected = "8 finite numbers: timestamp tx ty tz qx qy qz qw"
    try:
        values = [float(word) for word in line.split()]
    except ValueError as error:
        raise InputError(place, expected=expected, found=f"{error}") from None
    if len(values) != 8 or not all(map(is_moderate, values)):
        raise InputError(place, expected=expected, found=repr(line.strip()))
    if not np.linalg.norm(values[4:]):
        found = " ".join(f"{value:g}" for value in values[4:])
        raise InputError(place, expected="a quaternion", found=found)
    return values
