"""Fusion of inside-out and outside-in: one track per drone from its own camera's path and the static cameras' tracks.

The path is smoothed, and each source is weighted by its covariance, with a scale that is estimated from the differences
between the two. Where one source is missing, the other continues alone. Where the two contradict each other, the source
that does not jump is used.

Names of tracks are arbitrary, two tracks that met may have exchanged their drones, and a track may end and go on under
another name, while a camera stays on its drone. Tracks are therefore assigned by the distances in a window of frames,
and then reordered, so that each drone has one track for the whole recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter1d
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.evaluation import Offset, find_offset
from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.fusing import weighting
from psotrack.inside_out.fusing.weighting import Inside, Point, Weighted
from psotrack.support import atomic_write, refuse_to_overwrite
from psotrack.trajectories import GATE_M, UNASSIGNED, Status, Trajectories

#: Number of frames whose distances decide together which track is a drone's.
_WINDOW = 11
#: Least mean gain in a window, 1 for a distance of 0: less is rounding.
_LEAST_GAIN = 1e-9
#: Longest time to the nearest pose during which a drone coasts without either source, seconds; beyond, it is lost.
MAX_COASTING_S = 0.5
#: Words for the values of `FusedTracks.source`.
_SOURCES = ("none", "inside", "outside", "both")

#: The values of one drone in all frames, by their names.
_Rows = dict[str, np.ndarray]
_PARTS = ("position_m", "velocity_m_s", "covariance_m2", "status", "orientation_wxyz", "source")


def pair_tracks(
    camera_m: Float[np.ndarray, "frames paths 3"],
    middle_m: Float[np.ndarray, "frames tracks 3"],
) -> Int[np.ndarray, "frames paths"]:
    """Assign tracks to paths: (frames, paths), the index of the track of each path's drone, or `UNASSIGNED`.

    A path gets no track if its track is more than half a metre away in most frames that have both.

    Args:
        camera_m: (frames, paths, 3), positions of the paths' cameras; NaN where unknown.
        middle_m: (frames, tracks, 3), positions of the tracks; NaN where a track has none.
    """
    distance_m = np.linalg.norm(camera_m[:, :, None] - middle_m[:, None], axis=-1)
    gain = np.nan_to_num(1 - np.minimum(distance_m / GATE_M, 1) ** 2)
    gain = uniform_filter1d(gain, _WINDOW, axis=0, mode="constant")
    near = np.full(camera_m.shape[:2], UNASSIGNED)
    for row in np.flatnonzero((gain > _LEAST_GAIN).any(axis=(1, 2))):
        paths, tracks = linear_sum_assignment(gain[row], maximize=True)
        near[row, paths] = np.where(gain[row, paths, tracks] > _LEAST_GAIN, tracks, UNASSIGNED)
    frames, found = np.arange(len(near)), near.copy()
    for path in np.flatnonzero((near != UNASSIGNED).any(axis=0)):
        # Where no distance tells, the drone keeps its track, unless another drone has this track.
        rows = np.flatnonzero(near[:, path] != UNASSIGNED)
        own = near[rows[weighting.nearest_index(rows, frames)], path]
        is_free = (np.delete(near, path, axis=1) != own[:, None]).all(axis=1)
        both_m = distance_m[frames, path, own]
        both_m = both_m[np.isfinite(both_m)]
        of_drone = np.mean(both_m <= GATE_M) > 0.5
        found[:, path] = np.where(is_free & of_drone, own, UNASSIGNED)
    return found


def reorder_tracks(
    pairing: Int[np.ndarray, "frames paths"], num_tracks: int
) -> tuple[Int[np.ndarray, "frames tracks"], dict[int, int]]:
    """Undo exchanges of tracks.

    Returns:
        (frames, tracks), the index of the track that is in each column; and for each path with a track the column that
        has its track in all frames. Another drone keeps its column when a path takes its track and leaves it its own.
    """
    order = np.tile(np.arange(num_tracks), (len(pairing), 1))
    column: dict[int, int] = {}
    changed = np.diff(pairing, axis=0, prepend=UNASSIGNED) != 0
    for row, path in np.argwhere(changed & (pairing != UNASSIGNED)).tolist():
        now = int(np.flatnonzero(order[row] == pairing[row, path])[0])
        own = column.setdefault(path, now)
        order[row:, [own, now]] = order[row:, [now, own]]
    return order, column


@dataclass(frozen=True)
class FusedDrone:
    """Result of the fusion for one drone that carries a camera.

    Attributes:
        name: name of the drone.
        tracks: names of the outside tracks that belong to it, in the order of time; empty where there are none.
        offset: offset of the camera's clock; None if it was not estimated.
        frames_both, frames_inside, frames_outside: number of frames in which both sources, or only one, were used.
        weighted: arm, scales and positions; None without a track.
    """

    name: str
    tracks: tuple[str, ...]
    offset: Offset | None
    frames_both: int
    frames_inside: int
    frames_outside: int
    weighted: Weighted | None

    def to_dict(self) -> dict[str, Any]:
        """The result, fit for JSON; None for what is not known."""
        offset, found = self.offset, self.weighted
        sources = None if found is None else found.sources()
        return {
            "drone": self.name,
            "tracks": list(self.tracks),
            "offset_s": offset and offset.offset_s,
            "offset_std_s": offset and offset.std_s,
            "frames_both": self.frames_both,
            "frames_inside": self.frames_inside,
            "frames_outside": self.frames_outside,
            "lever_arm_m": found and found.arm_m.tolist(),
            "lever_arm_std_m": found and [found.arm_std_m] * 3,
            "inside": sources and sources["inside"],
            "outside": sources and sources["outside"],
        }

    def __str__(self) -> str:
        tracks = " and ".join(f"track {name}" for name in self.tracks) or "no track, kept as it is"
        parts = [f"{self.name}: {tracks}"]
        if self.offset is not None:
            parts.append(f"clock {self.offset.offset_s:+.4f} ± {self.offset.std_s:.4f} s")
        parts.append(
            f"frames of both {self.frames_both}, inside only {self.frames_inside}, outside only {self.frames_outside}"
        )
        if self.weighted is not None:
            std_mm = 1e3 * self.weighted.arm_std_m
            parts.append(
                f"arm ({', '.join(f'{value:.1f} ± {std_mm:.1f}' for value in 1e3 * self.weighted.arm_m)}) mm"
            )
            parts += [
                f"{word}: stated errors multiplied by {of_source['scale']:.2f}, "
                f"{of_source['gross_frames']} gross errors left out"
                for word, of_source in self.weighted.sources().items()
            ]
        return "; ".join(parts)


@dataclass(frozen=True)
class IdentitySwap:
    """A frame from which on a drone has another outside track; `before` and `after` are the tracks' names."""

    drone: str
    frame: int
    before: str
    after: str


@dataclass(frozen=True)
class FusedTracks:
    """Fused tracks of the drones that carry cameras, followed by the outside tracks of all other drones.

    As text, a line for each drone and each swap, and a line on the whole.

    Attributes:
        trajectories: at the frames of both sources, by the clock of the outside tracks. Orientations are the cameras',
            smoothed; velocities are those of the source that tracks `point`, and where it has none, of the other one.
        point: tracked point of the fused drones. Paths without a track are of the camera, tracks without a path of the
            middle.
        drones: results for the drones that carry cameras, one per path.
        identity_swaps: swaps of outside tracks between drones; the fused tracks are without them.
        source: (frames, drones), 1 where the inside was used, 2 where the outside was, 3 where both were, else 0.
    """

    trajectories: Trajectories
    point: Point
    drones: tuple[FusedDrone, ...]
    identity_swaps: tuple[IdentitySwap, ...]
    source: Int[np.ndarray, "frames drones"]

    def to_dict(self) -> dict[str, Any]:
        """What was found, fit for JSON; None for what is not known."""
        return {
            "point": self.point,
            "frames": self.trajectories.num_frames,
            "drones": [drone.to_dict() for drone in self.drones],
            "others": list(self.trajectories.drones[len(self.drones) :]),
            "exchanges": [dict(vars(swap)) for swap in self.identity_swaps],
        }

    def __str__(self) -> str:
        swaps = (
            f"from frame {swap.frame}: {swap.drone} is track {swap.after} instead of {swap.before}"
            for swap in self.identity_swaps
        )
        whole = f"{self.trajectories.num_drones} drones, {self.trajectories.num_frames} frames"
        if not any(drone.tracks for drone in self.drones):
            whole += "; nothing was fused, because no frame has both a pose and a track"
        return "\n".join([*map(str, self.drones), *swaps, whole])


def fuse(
    inside: CameraPath | Mapping[str, CameraPath],
    outside: Trajectories,
    *,
    point: Point = "camera",
    max_offset_s: float | None = None,
) -> FusedTracks:
    """Fuse the paths of on-board cameras with the tracks that static cameras have of the same drones.

    Names of tracks do not matter: each path is assigned the track near it, so that identity swaps are resolved. The arm
    between the camera's centre and the middle of the silhouette, constant in the camera's axes, is estimated, and so
    are the scales of both covariances. A path without a track is smoothed, and a track without a path is kept as it is.
    Of tracks only tracked positions are used, neither coasting nor lost ones.

    Args:
        inside: paths by the names of their drones; a single path is called `drone`. A path with velocities was smoothed
            or filtered before, and is not smoothed again.
        outside: tracks of the middles of silhouettes; covariances are optional.
        point: tracked point of the result: the camera's centre, which the markers define, or the middle of the
            silhouette, which static cameras see.
        max_offset_s: estimate how much each camera's clock is ahead of the tracks' clock, from minus this to this,
            seconds; None for equal clocks.

    Raises:
        InputError: there is nothing to fuse, no track is near a path although both are known at the same times, or the
            motion does not determine a clock offset.
        SettingsError: `max_offset_s` is smaller than the time between two poses of a path.
    """
    paths = {"drone": inside} if isinstance(inside, CameraPath) else dict(inside)
    if not any(path.seen.any() for path in paths.values()):
        raise InputError("inside paths", expected="a pose in at least one frame", found="none")
    if not outside.seen.any():
        raise InputError("outside tracks", expected="a position in at least one frame", found="none")
    offsets = {name: _find_clock_offset(name, path, outside, max_offset_s) for name, path in paths.items()}
    clocks_s = {name: 0.0 if offset is None else offset.offset_s for name, offset in offsets.items()}
    tracks = weighting.outside_at(
        outside, [path.time_s[path.seen] - clocks_s[name] for name, path in paths.items()]
    )
    cameras = [weighting.inside_at(path, tracks.time_s, clocks_s[name]) for name, path in paths.items()]
    tracked = np.asarray(tracks.status == Status.TRACKED)
    middle_m = np.where(tracked[..., None], tracks.position_m, np.nan)
    pairing = pair_tracks(np.stack([camera.position_m for camera in cameras], axis=1), middle_m)
    _check_near(pairing, cameras, middle_m)
    order, column = reorder_tracks(pairing, tracks.num_drones)
    rows: dict[str, _Rows] = {}
    drones, swaps = [], []
    for name, camera, own in zip(paths, cameras, pairing.T, strict=True):
        track, weighted = _outside_rows(tracks, own), None
        names = [tracks.drones[index] for index in own[own != UNASSIGNED]]
        if names:
            own_m = np.where((track["source"] == 2)[:, None], track["position_m"], np.nan)
            weighted = weighting.weigh(camera, own_m, track["covariance_m2"], point)
            if weighted.gross[:, 0].any():
                gross_s = tracks.time_s[weighted.gross[:, 0]] + clocks_s[name]
                status = paths[name].status.copy()
                status[weighting.nearest_index(paths[name].time_s, gross_s)] = Status.LOST
                without = replace(paths[name], status=status)
                camera = weighting.inside_at(without, tracks.time_s, clocks_s[name])
                again = weighting.weigh(camera, own_m, track["covariance_m2"], point)
                weighted = replace(again, gross=again.gross | weighted.gross)
        rows[name] = _fused_rows(camera, weighted, track["velocity_m_s"], point)
        both, one, other = (int((rows[name]["source"] == which).sum()) for which in (3, 1, 2))
        own_names = tuple(dict.fromkeys(names))
        drones.append(FusedDrone(name, own_names, offsets[name], both, one, other, weighted))
        steps = zip(tracks.frame[own != UNASSIGNED].tolist()[1:], names, names[1:], strict=False)
        swaps += [
            IdentitySwap(name, frame, before, after) for frame, before, after in steps if before != after
        ]
    for index in sorted(set(range(tracks.num_drones)) - set(column.values())):
        rest = _outside_rows(tracks, order[:, index])
        if rest["source"].any():
            rows[_free_name(tracks.drones[index], rows)] = rest
    joined = {part: np.stack([each[part] for each in rows.values()], axis=1) for part in _PARTS}
    source = joined.pop("source")
    trajectories = Trajectories(tracks.frame, tracks.time_s, tuple(rows), **joined)
    swaps.sort(key=lambda swap: swap.frame)
    return FusedTracks(trajectories, point, tuple(drones), tuple(swaps), source)


def _check_near(
    pairing: Int[np.ndarray, "frames paths"],
    cameras: list[Inside],
    middle_m: Float[np.ndarray, "frames tracks 3"],
) -> None:
    """Raise `InputError` if no path has a track, although both are known at the same times."""
    if (pairing != UNASSIGNED).any():
        return
    apart_m = [np.linalg.norm(middle_m - camera.position_m[:, None], axis=-1) for camera in cameras]
    if np.isfinite(apart_m).any():
        raise InputError(
            "outside tracks",
            expected=f"a track within {GATE_M:g} m of a path in most frames that have both",
            found=f"none (the nearest is {np.nanmin(apart_m):.2f} m away)",
            remedy="all files must have one recording, one clock (see --max-offset) and one world",
        )


def _find_clock_offset(
    name: str, path: CameraPath, outside: Trajectories, max_offset_s: float | None
) -> Offset | None:
    if max_offset_s is None:
        return None
    known = path.seen & (path.status == Status.TRACKED)
    position_m = np.where(known[:, None], path.position_m, np.nan)[:, None]
    orientation_wxyz = path.orientation_wxyz[:, None]
    try:
        return find_offset(outside, path.time_s, position_m, orientation_wxyz, max_offset_s=max_offset_s)
    except InputError as error:
        raise InputError(f"the clock of {name}", expected="an offset", found=f"none ({error})") from error


def _fused_rows(
    camera: Inside, weighted: Weighted | None, outside_m_s: Float[np.ndarray, "frames 3"], point: Point
) -> _Rows:
    """The rows of a drone that carries a camera; without a track, of the camera alone."""
    if weighted is None:
        position_m, covariance_m2 = camera.position_m, camera.at_variance_m2(max(camera.white, 1.0))
        source = camera.tracked.astype(int)
    else:
        position_m, covariance_m2 = weighted.position_m, weighted.covariance_m2
        source = (weighted.known[:, 0] & camera.tracked) + 2 * weighted.known[:, 1]
    known = np.isfinite(position_m).all(axis=1) & ((source > 0) | (camera.away_s <= MAX_COASTING_S))
    coasting = np.where(known, int(Status.COASTING), int(Status.LOST))
    first_m_s, second_m_s = (
        (camera.velocity_m_s, outside_m_s) if point == "camera" else (outside_m_s, camera.velocity_m_s)
    )
    velocity_m_s = np.where(np.isnan(first_m_s), second_m_s, first_m_s)
    wxyz = Rotation.from_matrix(camera.rotation).as_quat(scalar_first=True)
    return {
        "position_m": np.where(known[:, None], position_m, np.nan),
        "velocity_m_s": np.where(known[:, None], velocity_m_s, np.nan),
        "covariance_m2": np.where(known[:, None, None], covariance_m2, np.nan),
        "orientation_wxyz": np.where(camera.oriented[:, None], wxyz, np.nan),
        "status": np.where(source > 0, int(Status.TRACKED), coasting),
        "source": source,
    }


def _outside_rows(tracks: Trajectories, index: Int[np.ndarray, "frames"]) -> _Rows:
    """The rows of an outside track, unchanged; lost where the index is `UNASSIGNED`."""
    rows = {part: getattr(tracks, part)[np.arange(len(index)), index] for part in _PARTS[:4]}
    rows["status"] = np.where(index == UNASSIGNED, int(Status.LOST), rows["status"])
    source = np.where(rows["status"] == Status.TRACKED, 2, 0)
    return rows | {"orientation_wxyz": np.full((len(index), 4), np.nan), "source": source}


def _free_name(name: str, taken: Mapping[str, _Rows]) -> str:
    while name in taken:
        name += " outside"
    return name


def write_fused(path: Path | str, fused: FusedTracks, *, force: bool = False) -> None:
    """Write a CSV with one row per frame and drone; values that are not known are empty fields.

    Columns: `frame`, `time_s`, `drone`, `x_m` to `z_m`, `vx_m_s` to `vz_m_s`, `qw` to `qz` (camera to world), `cov_xx`
    to `cov_zz` (the upper triangle), `source` (both, inside, outside or none), `status`. Every command that reads
    tracks reads the table.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    refuse_to_overwrite(path, force)
    table = fused.trajectories.to_pandas()
    table["source"] = np.array(_SOURCES)[fused.source].ravel()
    names = list(map(str, table.columns))
    turns, covariances = ([name for name in names if name.startswith(start)] for start in ("q", "cov_"))
    with atomic_write(Path(path)) as temporary:
        table[[*names[:9], *turns, *covariances, "source", "status"]].to_csv(temporary, index=False)
