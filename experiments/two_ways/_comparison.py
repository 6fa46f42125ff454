"""One rig, two methods: errors of outside-in, inside-out and both fused, beside each other, and in ranges of frames.

The constant offset of each track from the reference is removed in the axes of the body, because a camera, the middle of
a silhouette and a body's origin are different points. Only frames that both methods cover count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.inside_out import CameraPath, FusedTracks, fuse, read_camera_path
from psotrack.recordings.datasets import read_sequence
from psotrack.trajectories import Trajectories, read_trajectories

METHODS = ("outside", "inside", "fused")


@dataclass(frozen=True)
class Compared:
    """Errors (frames,) of one drone by each method, in metres, in frames that both methods cover."""

    drone: str
    error_m: dict[str, np.ndarray]
    frame: np.ndarray


def compare_drones(sequence: Path, inside: Sequence[Path], outside: Path) -> list[Compared]:
    """Fuse, and compare every drone that both methods have with the sequence's reference.

    Args:
        sequence: folder of the sequence.
        inside: files of `psotrack onboard localise`, whose drones are named as in the reference.
        outside: a file of `psotrack track`.
    """
    paths = {name: path for path, name in map(read_camera_path, inside)}
    tracks = read_trajectories(outside)
    fused = fuse(paths, tracks)
    truth = read_sequence(sequence).truth
    if truth is None or truth.orientation_wxyz is None:
        raise InputError(sequence, expected="a reference with orientations", found="none")
    return [one for name in paths if (one := _compared(name, paths[name], tracks, fused, truth))]


def _compared(
    name: str, path: CameraPath, tracks: Trajectories, fused: FusedTracks, truth: Trajectories
) -> Compared | None:
    """Errors of one drone; None if only one method has the drone."""
    index = [drone.name for drone in fused.drones].index(name)
    if not fused.drones[index].tracks:
        return None
    drone = truth.drones.index(name)
    known = np.isfinite(truth.orientation_wxyz[:, drone]).all(axis=1) & truth.seen[:, drone]
    frame = truth.frame[known]
    rotation = Rotation.from_quat(truth.orientation_wxyz[known, drone], scalar_first=True)
    true_m = truth.position_m[known, drone]
    own = [tracks.drones.index(track) for track in fused.drones[index].tracks]
    nearest = np.full((len(frame), 3), np.nan)
    for track in own:
        # Where tracks were exchanged, the track at the drone counts, which favours the outside-in method.
        there_m = _at(frame, tracks, track)
        better = np.linalg.norm(there_m - true_m, axis=1) < np.nan_to_num(
            np.linalg.norm(nearest - true_m, axis=1), nan=np.inf
        )
        nearest[better] = there_m[better]
    position_m = {
        "outside": nearest,
        "inside": _at(frame, path.trajectories(name), 0),
        "fused": _at(frame, fused.trajectories, index),
    }
    both = np.isfinite(sum(position_m.values())).all(axis=1)
    in_body_m = {
        method: rotation[both].inv().apply(position_m[method][both] - true_m[both]) for method in METHODS
    }
    error_m = {
        method: np.linalg.norm(off_m - np.median(off_m, axis=0), axis=1)
        for method, off_m in in_body_m.items()
    }
    return Compared(name, error_m, frame[both])


def _at(frame: np.ndarray, tracks: Trajectories, drone: int) -> np.ndarray:
    """Positions (frames, 3) of one drone, metres; NaN where the drone is not tracked."""
    position_m = np.full((len(frame), 3), np.nan)
    _, to, source = np.intersect1d(frame, tracks.frame, return_indices=True)
    seen = tracks.seen[source, drone]
    position_m[to[seen]] = tracks.position_m[source[seen], drone]
    return position_m


def ranges(one: Compared, length: int) -> pd.DataFrame:
    """One row per range of frames; both methods must cover at least half of a range."""
    rows = []
    for first in range(0, int(one.frame.max()) + 1, length):
        inside = (one.frame >= first) & (one.frame < first + length)
        if inside.sum() < length / 2:
            continue
        mean_m = {f"{method}_m": one.error_m[method][inside].mean() for method in METHODS}
        ratio = mean_m["fused_m"] / min(mean_m["inside_m"], mean_m["outside_m"])
        rows.append(
            {"drone": one.drone, "first_frame": first, "frames": inside.sum(), **mean_m, "ratio": ratio}
        )
    return pd.DataFrame(rows)
