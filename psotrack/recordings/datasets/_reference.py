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
from psotrack.recordings.datasets._poses import read_poses
from psotrack.recordings.mocap import body_trajectories, read_c3d
from psotrack.support import read_text
from psotrack.trajectories import Trajectories, read_trajectories, resample
from psotrack.trajectories.tum import read_tum

_logger = logging.getLogger(__name__)
#: Ending of a pose file's name that states its rate, such as `dron1_pos_25`.
_RATE = re.compile(r"_(?:pos|cam)_(?P<rate>\d+(?:\.\d+)?)$")
_SUFFIXES = (".csv", ".parquet", ".tum", ".txt", ".c3d")


#: Labels of the markers of each drone, as the user says.
Bodies = Mapping[str, Sequence[str]]


def read_reference(paths: Sequence[Path], fps: float, bodies: Bodies | None = None) -> list[Trajectories]:
    """The reference of each file, at its own rate and with its own clock.

    Args:
        paths: C3D files, TUM files, pose files of the dataset, or files of tracks.
        fps: rate of pose files whose name does not end in the rate, such as `dron1_pos_25.csv`, and of tracks without
            times; hertz.
        bodies: labels of the markers of each drone in the C3D file; None or empty: by the labels.

    Raises:
        InputError: a file cannot be read, or a drone has two files.
    """
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


def reference_at(
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
    parts = [
        resample(reference, frame, time_s, later_s=later_s)
        if reference.num_frames > 1
        else _nowhere(reference, frame, time_s)
        for reference in references
    ]
    unknown = np.full((len(frame), 1, 4), np.nan)
    turned = any(part.orientation_wxyz is not None for part in parts)
    orientations = [
        np.repeat(unknown, part.num_drones, axis=1)
        if part.orientation_wxyz is None
        else part.orientation_wxyz
        for part in parts
    ]
    return Trajectories(
        frame,
        time_s,
        tuple(drone for part in parts for drone in part.drones),
        np.concatenate([part.position_m for part in parts], axis=1),
        orientation_wxyz=np.concatenate(orientations, axis=1) if turned else None,
    )


def read_own_reference(paths: Sequence[Path], fps: float, bodies: Bodies | None = None) -> Trajectories:
    """One reference of all drones at the times of the file with most samples, with the references' own clock.

    Arguments and errors: see `read_reference`.
    """
    references = read_reference(paths, fps, bodies)
    finest = max(references, key=lambda reference: reference.num_frames)
    if len(references) == 1:
        return finest
    return reference_at(references, finest.frame, finest.time_s, later_s=0.0)


def _read(path: Path, fps: float, bodies: Bodies | None) -> Trajectories:
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        markers = read_c3d(path)
        return body_trajectories(
            markers, fps=markers.rate_hz, num_frames=len(markers.position_m), where=path, named=bodies
        )
    if suffix in (".tum", ".txt"):
        return read_tum(path)
    if suffix == ".parquet" or (suffix == ".csv" and "x_m" in _header(path)):
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
        (path.stem if rate is None else path.stem[: rate.start()],),
        position_m[:, None],
        orientation_wxyz=None if orientation_wxyz is None else orientation_wxyz[:, None],
    )


def _header(path: Path) -> str:
    lines = read_text(path).splitlines()
    return lines[0] if lines else ""


def _nowhere(
    reference: Trajectories, frame: Int[np.ndarray, "frames"], time_s: Float[np.ndarray, "frames"]
) -> Trajectories:
    position_m = np.full((len(frame), reference.num_drones, 3), np.nan)
    return replace(Trajectories(frame, time_s, reference.drones, position_m), orientation_wxyz=None)
