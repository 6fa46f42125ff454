"""Files of a reference, in any of the formats that a `recording.toml` may name."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.recordings import Reference, Timeline
from psotrack.recordings.datasets._poses import read_poses
from psotrack.recordings.mocap import marker_bodies, read_c3d
from psotrack.support import first_line
from psotrack.trajectories import Trajectories, merged, read_trajectories, resample
from psotrack.trajectories.tum import read_tum

_logger = logging.getLogger(__name__)
#: Ending of a pose file's name that states its rate, such as `dron1_pos_25`.
_RATE = re.compile(r"_(?:pos|cam)_(?P<rate>\d+(?:\.\d+)?)$")
#: Names of drones in the dataset; `drone_1` is `dron1`.
_DRONE = re.compile(r"drone?_?(?=\d+$)", re.IGNORECASE)
_SUFFIXES = (".csv", ".parquet", ".tum", ".txt", ".c3d")


#: Labels of the markers of each drone, as the user says.
Bodies = Mapping[str, Sequence[str]]


def read_reference(
    files: Sequence[Path], timeline: Timeline, bodies: Bodies | None = None, offset_s: float = 0.0
) -> Reference:
    """The reference that is in some files; each file is read once.

    Args:
        files: C3D files, TUM files, pose files of the dataset, or files of tracks.
        timeline: the recording's instants. Their rate is that of pose files whose name does not end in the rate, such
            as `dron1_pos_25.csv`, and of tracks without times.
        bodies: labels of the markers of each drone in the C3D file; None or empty: by the labels.
        offset_s: time on the recording's clock at which the files' clock shows 0, seconds.

    Raises:
        InputError: a file cannot be read, or a drone has two files.
    """
    time_s = timeline.time_s
    found = _read_files(files, timeline.rate_hz, bodies)
    truth = _at_times(found, np.arange(len(time_s)), time_s, later_s=-offset_s)
    if not truth.seen.any():
        begin_s = min(each.time_s[0] for each in found) + offset_s
        end_s = max(each.time_s[-1] for each in found) + offset_s
        _logger.warning(
            "the reference says nothing about the recording, which lasts from %.3f to %.3f s: it lasts from %.3f to "
            "%.3f s on the recording's clock; see [reference] time_offset_s",
            time_s[0], time_s[-1], begin_s, end_s,
        )  # fmt: skip
    for path, each in zip(files, found, strict=True):
        if unit := timeline.unit_of(each.time_s):
            _logger.warning("%s: its times look like %s: write seconds", path, unit)
    own = finest = max(found, key=lambda each: each.num_frames)
    if len(found) > 1:
        own = _at_times(found, finest.frame, finest.time_s, later_s=0.0)
    own = replace(own, time_s=own.time_s + offset_s)
    return Reference(truth, own, tuple(files), bodies or {}, offset_s)


def _read_files(paths: Sequence[Path], fps: float, bodies: Bodies | None) -> list[Trajectories]:
    """The reference of each file, at its own rate and with its own clock."""
    recorded = [path for path in paths if path.suffix.lower() == ".c3d"]
    if bodies and len(recorded) != 1:
        found_files = ", ".join(path.name for path in recorded) or "none"
        raise InputError(
            f"bodies {', '.join(bodies)}", expected="one C3D file that holds their markers", found=found_files
        )
    found = [_read(path, fps, bodies) for path in paths]
    places: dict[str, Path] = {}
    for path, reference in zip(paths, found, strict=True):
        for drone in reference.drones:
            if drone in places:
                raise InputError(
                    path, expected="one file per drone", found=f"{drone} in {places[drone]} as well"
                )
            places[drone] = path
    return found


def _at_times(
    references: Sequence[Trajectories],
    frame: Int[np.ndarray, "frames"],
    time_s: Float[np.ndarray, "frames"],
    *,
    later_s: float,
) -> Trajectories:
    """One reference of all drones at given times; NaN where a file says nothing.

    Args:
        references: references of different drones, at least one.
        frame: (frames,), numbers of the frames.
        time_s: (frames,), times of the frames, seconds.
        later_s: the clock of the references shows t + `later_s` at time t, seconds.
    """
    parts = [resample(reference, frame, time_s, later_s=later_s) for reference in references]
    return merged(parts, [frame] * len(parts), lambda _: time_s)


def _read(path: Path, fps: float, bodies: Bodies | None) -> Trajectories:
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        return marker_bodies(read_c3d(path), path, bodies)
    if suffix in (".tum", ".txt"):
        return read_tum(path)
    if suffix == ".parquet" or (suffix == ".csv" and "x_m" in first_line(path)):
        return read_trajectories(path, fps=fps)
    if suffix == ".csv":
        return _read_pose_file(path, fps)
    raise InputError(path, expected=f"a file that ends in {', '.join(_SUFFIXES)}", found=path.name)


def _read_pose_file(path: Path, fps: float) -> Trajectories:
    rate = _RATE.search(path.stem)
    position_m, orientation_wxyz = read_poses(path)
    frame = np.arange(len(position_m))
    return Trajectories(
        frame,
        frame / (fps if rate is None else float(rate["rate"])),
        (_DRONE.sub("dron", path.stem if rate is None else path.stem[: rate.start()]),),
        position_m[:, None],
        orientation_wxyz=None if orientation_wxyz is None else orientation_wxyz[:, None],
    )
