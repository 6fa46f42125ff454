"""Fusion of inside-out and outside-in: one track per drone from its own camera's path and the static cameras' tracks.

Each source is weighted by its covariance, with a scale that is estimated from the differences between the two. Errors
that last over several frames are modelled as such. Where one source is missing, the other continues alone. Where the
two differ grossly, the source that fits the motion is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.evaluation import Offset, find_offset
from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.fusing.drone_fusion import DroneFusion, DroneTrack, Point, fuse_drone, unfused_path
from psotrack.inside_out.fusing.outside_tracks import OutsideTracks, align_tracks, select_track
from psotrack.inside_out.fusing.pairing import Pairing, pair_tracks
from psotrack.inside_out.fusing.resampling import ResampledPath, estimate_arm, resample_path
from psotrack.trajectories import GATE_M, UNASSIGNED, Status, Trajectories

#: Smallest distance, metres, and multiple of the usual distance, from the expected middle of a drone, within which a
#: track may belong to the drone.
_LEAST_REACH_M, _FAR = 0.1, 4.0


@dataclass(frozen=True)
class FusedDrone:
    """Result of the fusion for one drone that carries a camera.

    Attributes:
        name: name of the drone.
        tracks: names of the outside tracks that belong to it, in the order of time; empty where there are none.
        offset: offset of the camera's clock; None if it was not estimated.
        frames_both, frames_inside, frames_outside: number of frames in which both sources, or only one, were used.
        nearest_m: median distance of the camera from the nearest track, over the frames that have both, metres; NaN
            without such frames.
        fusion: arm and error models; None without a track.
    """

    name: str
    tracks: tuple[str, ...]
    offset: Offset | None
    frames_both: int
    frames_inside: int
    frames_outside: int
    nearest_m: float
    fusion: DroneFusion | None

    def to_dict(self) -> dict[str, Any]:
        """The result, fit for JSON; None for what is not known."""
        fusion = self.fusion
        return {
            "drone": self.name,
            "tracks": list(self.tracks),
            "offset_s": None if self.offset is None else self.offset.offset_s,
            "offset_std_s": None if self.offset is None else self.offset.std_s,
            "frames_both": self.frames_both,
            "frames_inside": self.frames_inside,
            "frames_outside": self.frames_outside,
            "lever_arm_m": None if fusion is None else fusion.arm_m.tolist(),
            "lever_arm_std_m": None if fusion is None else fusion.arm_std_m.tolist(),
            "inside": None if fusion is None else fusion.inside.to_dict(),
            "outside": None if fusion is None else fusion.outside.to_dict(),
        }

    def __str__(self) -> str:
        tracks = " and ".join(f"track {name}" for name in self.tracks) or "no track, kept as it is"
        parts = [f"{self.name}: {tracks}"]
        if self.offset is not None:
            parts.append(f"clock {self.offset.offset_s:+.4f} ± {self.offset.std_s:.4f} s")
        parts.append(
            f"frames of both {self.frames_both}, inside only {self.frames_inside}, outside only {self.frames_outside}"
        )
        if self.fusion is not None:
            arm = ", ".join(
                f"{1e3 * value:.1f} ± {1e3 * std:.1f}"
                for value, std in zip(self.fusion.arm_m, self.fusion.arm_std_m, strict=True)
            )
            parts.append(f"arm ({arm}) mm")
            parts.extend(
                f"{word}: stated errors multiplied by {errors.scale:.2f}, {errors.gated} gross errors left out"
                for word, errors in (("inside", self.fusion.inside), ("outside", self.fusion.outside))
            )
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
        trajectories: at the frames of both sources, by the clock of the outside tracks. Orientations are the cameras'.
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

    Names of tracks do not matter: each path is assigned the track near it, piece by piece, so that identity swaps are
    resolved. The arm between the camera's centre and the middle of the silhouette, constant in the camera's axes, is
    estimated, and so are the scales of both covariances. A path without a track and a track without a path are kept as
    they are. Only tracked poses and positions are used, neither coasting nor lost ones.

    Args:
        inside: paths by the names of their drones; a single path is called `drone`.
        outside: tracks of the middles of silhouettes; covariances are optional.
        point: tracked point of the result: the camera's centre, which the markers define, or the middle of the
            silhouette, which static cameras see.
        max_offset_s: estimate how much each camera's clock is ahead of the tracks' clock, from minus this to this,
            seconds; None for equal clocks.

    Raises:
        InputError: there is nothing to fuse, or the motion does not determine a clock offset.
        SettingsError: `max_offset_s` is smaller than the time between two poses of a path.
    """
    paths = {"drone": inside} if isinstance(inside, CameraPath) else dict(inside)
    if not any(path.seen.any() for path in paths.values()):
        raise InputError("inside paths", expected="a pose in at least one frame", found="none")
    if not outside.seen.any():
        raise InputError("outside tracks", expected="a position in at least one frame", found="none")
    offsets = {name: _find_clock_offset(name, path, outside, max_offset_s) for name, path in paths.items()}
    clocks_s = {name: 0.0 if offset is None else offset.offset_s for name, offset in offsets.items()}
    tracks_in = align_tracks(
        outside, (path.time_s[path.seen] - clocks_s[name] for name, path in paths.items())
    )
    frame, time_s = tracks_in.frame, tracks_in.time_s
    cameras = [resample_path(path, time_s, clocks_s[name]) for name, path in paths.items()]
    pairing = _pair(frame, cameras, tracks_in.tracked_m)
    tracks: dict[str, DroneTrack] = {}
    drones = []
    for (name, path), camera, own_index in zip(paths.items(), cameras, pairing.track.T, strict=True):
        names = tuple(dict.fromkeys(outside.drones[k] for k in own_index if k != UNASSIGNED))
        found = None
        if names:
            own_track = (
                select_track(tracks_in.tracked_m, own_index),
                select_track(tracks_in.covariance_m2, own_index),
            )
            found = fuse_drone(path, frame, time_s, clocks_s[name], *own_track, point)
        tracks[name] = unfused_path(path, time_s, clocks_s[name]) if found is None else found.track
        both, one, other = (int((_source(tracks[name]) == source).sum()) for source in (3, 1, 2))
        nearest_m = _nearest_m(camera, tracks_in.tracked_m)
        drones.append(FusedDrone(name, names, offsets[name], both, one, other, nearest_m, found))
    for name, own_index in zip(outside.drones, pairing.rest.T, strict=True):
        track = _outside_track(tracks_in, own_index)
        if track.used.any():
            tracks[_free_name(name, tracks)] = track
    return FusedTracks(
        trajectories=_join_tracks(tracks_in, tracks),
        point=point,
        drones=tuple(drones),
        identity_swaps=tuple(
            IdentitySwap(
                drones[change.drone].name,
                change.frame,
                outside.drones[change.before],
                outside.drones[change.after],
            )
            for change in pairing.changes
        ),
        source=np.stack([_source(track) for track in tracks.values()], axis=1),
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


def _pair(
    frame: Int[np.ndarray, "frames"],
    cameras: list[ResampledPath],
    middle_m: Float[np.ndarray, "frames tracks 3"],
) -> Pairing:
    """Pair tracks with paths, first by the cameras' positions, then by the middles expected from each camera's arm."""
    expected_m = np.stack([camera.position_m for camera in cameras], axis=1)
    reach_m = np.full(len(cameras), GATE_M)
    pairing = pair_tracks(frame, expected_m, reach_m, middle_m)
    for index, camera in enumerate(cameras):
        own_m = select_track(middle_m, pairing.track[:, index])
        arm_m, _ = estimate_arm(camera, own_m)
        expected_m[:, index] += camera.rotation @ arm_m
        off_m = np.linalg.norm(own_m - expected_m[:, index], axis=1)
        if np.isfinite(off_m).any():
            reach_m[index] = np.clip(_FAR * np.nanmedian(off_m), _LEAST_REACH_M, GATE_M)
    return pair_tracks(frame, expected_m, reach_m, middle_m)


def _nearest_m(camera: ResampledPath, middle_m: Float[np.ndarray, "frames tracks 3"]) -> float:
    """Median distance of a camera from the nearest track, metres; NaN without frames that have both."""
    distance_m = np.linalg.norm(middle_m - camera.position_m[:, None], axis=-1)
    both = np.isfinite(distance_m).any(axis=1)
    return float(np.median(np.nanmin(distance_m[both], axis=1))) if both.any() else np.nan


def _outside_track(outside: OutsideTracks, track: Int[np.ndarray, "frames"]) -> DroneTrack:
    """The outside track of a drone without a camera, unchanged."""
    own_status = outside.status[np.arange(len(track)), track]
    status = np.where(track == UNASSIGNED, int(Status.LOST), own_status)
    return DroneTrack(
        position_m=select_track(outside.position_m, track),
        velocity_m_s=select_track(outside.velocity_m_s, track),
        covariance_m2=select_track(outside.covariance_m2, track),
        orientation_wxyz=np.full((len(track), 4), np.nan),
        status=status,
        used=np.stack([np.zeros(len(track), bool), status == Status.TRACKED], axis=1),
    )


def _free_name(name: str, taken: Mapping[str, DroneTrack]) -> str:
    while name in taken:
        name += " outside"
    return name


def _source(track: DroneTrack) -> Int[np.ndarray, "frames"]:
    return track.used @ np.array([1, 2])


def _join_tracks(outside: OutsideTracks, tracks: Mapping[str, DroneTrack]) -> Trajectories:
    def stacked(part: str) -> np.ndarray:
        return np.stack([getattr(track, part) for track in tracks.values()], axis=1)

    return Trajectories(
        frame=outside.frame,
        time_s=outside.time_s,
        drones=tuple(tracks),
        position_m=stacked("position_m"),
        velocity_m_s=stacked("velocity_m_s"),
        orientation_wxyz=stacked("orientation_wxyz"),
        status=stacked("status"),
        covariance_m2=stacked("covariance_m2"),
    )
