"""KITTI odometry: poses/NAME.txt with the 12 numbers of a pose per line, and sequences/NAME/times.txt with its times.

A line is the first three rows of the 4 x 4 matrix [R | t] that turns body coordinates into world coordinates, row by
row (Geiger et al., CVPR 2012). The format has no gaps and no unknown rotation. Frames in which a drone is not seen have
no line, and the times say which frames the lines are; an unknown orientation is the identity in every line.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.recordings import Recording
from psotrack.recordings.exchange.camera_boxes import Footage
from psotrack.recordings.exchange.timed_paths import timed_path
from psotrack.support import Report, check_file_name, first_repeat, first_true, read_numbers
from psotrack.trajectories import Trajectories

POSES, SEQUENCES, TIMES = "poses", "sequences", "times.txt"
#: Largest difference of R R' from the identity: KITTI's own files have 7 digits.
_ROTATION = 1e-4


def write_kitti(
    folder: Path, trajectories: Trajectories, footage: Footage | None, report: Report
) -> list[str]:
    """Write the poses and times of each drone into a new folder; nothing is missing in it.

    Raises:
        InputError: a drone's name cannot be the name of a file.
    """
    for drone, name in enumerate(trajectories.drones):
        check_file_name(name, "drones")
        seen = trajectories.seen[:, drone]
        poses = np.zeros((int(seen.sum()), 3, 4))
        poses[:, :, :3] = _rotations(trajectories, drone)
        poses[:, :, 3] = trajectories.position_m[seen, drone]
        _write(folder / POSES / f"{name}.txt", poses.reshape(-1, 12))
        _write(folder / SEQUENCES / name / TIMES, trajectories.time_s[seen].astype(float)[:, None])
    return []


def find_times(file: Path) -> Path | None:
    """The file with the times of a file of poses: KITTI's own place, NAME_times.txt beside the file, or times.txt."""
    candidates = (
        file.parent.parent / SEQUENCES / file.stem / TIMES,
        file.with_name(f"{file.stem}_{TIMES}"),
        file.with_name(TIMES),
    )
    return next((path for path in candidates if path.is_file()), None)


def read_kitti(file: Path, recording: Recording | None) -> Trajectories:
    """The path in a file of poses. Without a file of times, line k is instant k of the recording.

    Args:
        file: file of poses; the drone has its name.
        recording: the recording, or None if none is known.

    Raises:
        InputError: a file cannot be read, a line is no pose, or poses and times differ in number; there are no times
            and no recording, or a recording of another length.
    """
    read = read_numbers(file, 12, "12 finite numbers: the rows of [R | t]")
    poses = read.values.reshape(-1, 3, 4)
    R = poses[:, :, :3]
    off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    if (row := first_true((off > _ROTATION) | (np.linalg.det(R) < 0))) is not None:
        raise read.error(row, expected="a rotation matrix", found="another matrix")
    orientation = Rotation.from_matrix(R).as_quat(scalar_first=True, canonical=True)
    return timed_path(file.stem, _times(file, len(poses), recording), poses[:, :, 3], orientation)


def _times(file: Path, count: int, recording: Recording | None) -> Float[np.ndarray, "rows"]:
    beside = find_times(file)
    if beside is not None:
        read = read_numbers(beside, 1, "one time in seconds per line")
        time_s = read.values[:, 0]
        if len(time_s) != count:
            expected = f"{count} times, as many as {file.name} has poses"
            raise InputError(beside, expected=expected, found=f"{len(time_s)}")
        if (row := first_repeat(time_s)) is not None:
            raise read.error(
                row, expected="times that increase from line to line", found=f"{time_s[row]:g} s"
            )
        return time_s
    if recording is None:
        raise InputError(
            file,
            expected=f"a file of times, {SEQUENCES}/{file.stem}/{TIMES}",
            found="none",
            remedy="name SEQ, too",
        )
    instant_s = recording.timeline().time_s
    if len(instant_s) != count:
        raise InputError(
            file,
            expected=f"{len(instant_s)} poses, one for each instant of the recording, or a file of times",
            found=f"{count} poses",
        )
    return instant_s


def _rotations(trajectories: Trajectories, drone: int) -> Float[np.ndarray, "rows 3 3"]:
    """Rotations of a drone where it is seen; the identity everywhere if one of these frames has no orientation."""
    seen = trajectories.seen[:, drone]
    orientation = trajectories.orientation_wxyz
    if orientation is None or not np.isfinite(orientation[seen, drone]).all():
        return np.broadcast_to(np.eye(3), (int(seen.sum()), 3, 3))
    return Rotation.from_quat(orientation[seen, drone].astype(float), scalar_first=True).as_matrix()


def _write(path: Path, rows: Float[np.ndarray, "rows columns"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [" ".join(map(repr, row)) + "\n" for row in rows.tolist()]
    path.write_text("".join(lines), encoding="ascii")
