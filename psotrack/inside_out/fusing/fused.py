"""Inside-out and outside-in fused: one track of each drone from its own camera's path and the static cameras' tracks.

Each source counts as its covariance says, with a scale that the differences between the two tell; errors that last over
frames count once, not once per frame. Where one source is missing the other goes on alone, from where both were. Where
they are grossly apart, the one that fits the motion is believed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.clocks import Offset, find_offset
from psotrack.errors import InputError
from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.fusing.drone_fusion import DroneFusion, DroneTrack, Point, fuse_drone, path_alone
from psotrack.inside_out.fusing.mounting import Mounted, mounted, robust_arm
from psotrack.inside_out.fusing.outside_tracks import OutsideTracks, picked, spread
from psotrack.inside_out.fusing.pairing import Pairing, paired
from psotrack.trajectories import GATE_M, UNASSIGNED, Status, Trajectories

#: Within so much of where its middle is expected, or four times as far as is usual, a track may be of a drone.
_LEAST_REACH_M, _FAR = 0.1, 4.0


@dataclass(frozen=True)
class FusedDrone:
    """What the fusion found of one drone that carries a camera.

    Attributes:
        name: of the drone.
        tracks: names of the outside tracks that are of it, in the order of time; empty where none is.
        offset: of the camera's clock, where it was sought.
        frames_both, frames_inside, frames_outside: frames in which both, or one alone, were used.
        fusion: the arm, and how each source errs; None without a track.
    """

    name: str
    tracks: tuple[str, ...]
    offset: Offset | None
    frames_both: int
    frames_inside: int
    frames_outside: int
    fusion: DroneFusion | None


@dataclass(frozen=True)
class Exchange:
    """From this frame on, a drone's outside track is another one: `before` and `after` are their names."""

    drone: str
    frame: int
    before: str
    after: str


@dataclass(frozen=True)
class Fused:
    """Drones that carry cameras, fused, and after them the outside tracks of others, as they are.

    Attributes:
        trajectories: of the frames of both, by the clock of the outside tracks. Orientations are the cameras'.
        point: of the fused drones. Paths without a track are of the camera, tracks without a path of the middle.
        drones: one for each path.
        exchanges: of outside tracks between drones, mended.
        source: (frames, drones), 1 where the inside was used, 2 where the outside was, 3 where both were, else 0.
    """

    trajectories: Trajectories
    point: Point
    drones: tuple[FusedDrone, ...]
    exchanges: tuple[Exchange, ...]
    source: Int[np.ndarray, "frames drones"]


def fuse(
    inside: CameraPath | Mapping[str, CameraPath],
    outside: Trajectories,
    *,
    point: Point = "camera",
    max_offset_s: float | None = None,
) -> Fused:
    """Fuse the paths of on-board cameras with the tracks that static cameras have of the same drones.

    Tracks may have any names: each path is assigned the track that is with it, piece by piece, so that tracks that
    were exchanged are put right. The arm between the camera's centre and the middle that the tracks are of is found
    from both, constant in the camera's axes, and so are the scales of both covariances. A path without a track and a
    track without a path are kept as they are. Only what either tracks counts: what is coasting or lost does not.

    Args:
        inside: the paths, by the names of their drones; one alone is called `drone`.
        outside: the tracks, of the middles of silhouettes; covariances may be missing.
        point: what the fused tracks are of. The camera's centre is where the markers say; the middle is the point
            that static cameras see, a property of the silhouettes.
        max_offset_s: find by how much each camera's clock is ahead of the tracks', from minus this to this.

    Raises:
        InputError: there is nothing to fuse, or an offset is sought and the motion does not tell it.
    """
    paths = {"drone": inside} if isinstance(inside, CameraPath) else dict(inside)
    if not any(path.seen.any() for path in paths.values()):
        raise InputError("inside paths", expected="a pose in at least one frame", found="none")
    if not outside.seen.any():
        raise InputError("outside tracks", expected="a position in at least one frame", found="none")
    offsets = {name: _offset(name, path, outside, max_offset_s) for name, path in paths.items()}
    clocks_s = {name: 0.0 if offset is None else offset.offset_s for name, offset in offsets.items()}
    tracks_in = spread(outside, (path.time_s[path.seen] - clocks_s[name] for name, path in paths.items()))
    frame, time_s = tracks_in.frame, tracks_in.time_s
    cameras = [mounted(path, time_s, clocks_s[name]) for name, path in paths.items()]
    pairing = _paired(frame, cameras, tracks_in.tracked_m)
    tracks: dict[str, DroneTrack] = {}
    drones = []
    for (name, path), theirs in zip(paths.items(), pairing.track.T, strict=True):
        names = tuple(dict.fromkeys(outside.drones[k] for k in theirs if k != UNASSIGNED))
        found = None
        if names:
            own = picked(tracks_in.tracked_m, theirs), picked(tracks_in.covariance_m2, theirs)
            found = fuse_drone(path, frame, time_s, clocks_s[name], *own, point)
        tracks[name] = path_alone(path, time_s, clocks_s[name]) if found is None else found.track
        both, one, other = (int((_source(tracks[name]) == source).sum()) for source in (3, 1, 2))
        drones.append(FusedDrone(name, names, offsets[name], both, one, other, found))
    for name, theirs in zip(outside.drones, pairing.rest.T, strict=True):
        track = _track_alone(tracks_in, theirs)
        if track.used.any():
            tracks[_new_name(name, tracks)] = track
    return Fused(
        trajectories=_together(tracks_in, tracks),
        point=point,
        drones=tuple(drones),
        exchanges=tuple(
            Exchange(drones[of.drone].name, of.frame, outside.drones[of.before], outside.drones[of.after])
            for of in pairing.changes
        ),
        source=np.stack([_source(track) for track in tracks.values()], axis=1),
    )


def _offset(name: str, path: CameraPath, outside: Trajectories, max_offset_s: float | None) -> Offset | None:
    if max_offset_s is None:
        return None
    known = path.seen & (path.status == Status.TRACKED)
    position_m = np.where(known[:, None], path.position_m, np.nan)[:, None]
    orientation_wxyz = path.orientation_wxyz[:, None]
    try:
        return find_offset(outside, path.time_s, position_m, orientation_wxyz, max_offset_s=max_offset_s)
    except InputError as error:
        raise InputError(f"the clock of {name}", expected="an offset", found=f"none ({error})") from error


def _paired(
    frame: Int[np.ndarray, "frames"], cameras: list[Mounted], middle_m: Float[np.ndarray, "frames tracks 3"]
) -> Pairing:
    """Who is who: first by the cameras themselves, then by where each, with its arm, expects its drone's middle."""
    expected_m = np.stack([camera.position_m for camera in cameras], axis=1)
    reach_m = np.full(len(cameras), GATE_M)
    pairing = paired(frame, expected_m, reach_m, middle_m)
    for index, camera in enumerate(cameras):
        own_m = picked(middle_m, pairing.track[:, index])
        arm_m, _ = robust_arm(camera, own_m, frame)
        expected_m[:, index] += camera.rotation @ arm_m
        off_m = np.linalg.norm(own_m - expected_m[:, index], axis=1)
        if np.isfinite(off_m).any():
            reach_m[index] = np.clip(_FAR * np.nanmedian(off_m), _LEAST_REACH_M, GATE_M)
    return paired(frame, expected_m, reach_m, middle_m)


def _track_alone(outside: OutsideTracks, track: Int[np.ndarray, "frames"]) -> DroneTrack:
    """An outside track of a drone without a camera, as it is."""
    own = outside.status[np.arange(len(track)), track]
    status = np.where(track == UNASSIGNED, int(Status.LOST), own)
    return DroneTrack(
        position_m=picked(outside.position_m, track),
        velocity_m_s=picked(outside.velocity_m_s, track),
        covariance_m2=picked(outside.covariance_m2, track),
        orientation_wxyz=np.full((len(track), 4), np.nan),
        status=status,
        used=np.stack([np.zeros(len(track), bool), status == Status.TRACKED], axis=1),
    )


def _new_name(name: str, taken: Mapping[str, DroneTrack]) -> str:
    while name in taken:
        name += " outside"
    return name


def _source(track: DroneTrack) -> Int[np.ndarray, "frames"]:
    return track.used @ np.array([1, 2])


def _together(outside: OutsideTracks, tracks: Mapping[str, DroneTrack]) -> Trajectories:
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
