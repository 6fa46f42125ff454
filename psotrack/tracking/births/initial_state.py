"""The region where drones are looked for, and first positions that are given instead of found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, looking_depths_m
from psotrack.recordings import Recording
from psotrack.recordings.exchange import read_tracks
from psotrack.settings import DroneSettings
from psotrack.tracking.births.births import (
    NO_DRONES,
    WINDOW_FRAMES,
    BirthRules,
    Births,
    FlightLimits,
    state_at,
)
from psotrack.tracking.matching import Expected, crossings, from_silhouettes, wide_bounds
from psotrack.trajectories import Tracks, Trajectories

#: Number of first frames from which the sizes of drones at given positions are taken, and in which drones are found
#: for a method that is plugged in.
_START_FRAMES, _FRAMES = 10, 40
#: Standard deviation of a given position, metres: it may be that of the body's origin, and the drone may turn away.
_GIVEN_STD_M = 0.1


@dataclass(frozen=True)
class InitialState:
    """Positions, velocities and sizes of the drones at frame 0.

    Attributes:
        position_m: (drones, 3), positions in the world, metres.
        velocity_m_s: (drones, 3), velocities, metres per second.
        size_m: (drones, 3), full lengths along the world's axes, metres.
        num_cameras: (drones,), number of cameras that show the drone.
    """

    position_m: Float[np.ndarray, "drones 3"]
    velocity_m_s: Float[np.ndarray, "drones 3"]
    size_m: Float[np.ndarray, "drones 3"]
    num_cameras: Float[np.ndarray, "drones"]


@dataclass(frozen=True)
class StartSource:
    """Where the first positions come from.

    Attributes:
        init: "auto", "truth" or the name of a file of tracks (see `TrackSettings.init`).
        path: path of the recording, or of the file of tracks.
        given: trajectories whose first frame is the start; None where the drones are to be found.
    """

    init: str
    path: Path
    given: Trajectories | None = None


def start_source(recording: Recording, init: str) -> StartSource:
    """Where the first positions come from, with the given trajectories read.

    Raises:
        InputError: there is no reference, or the file cannot be read.
    """
    if init == "auto":
        return StartSource(init, recording.folder)
    if init != "truth":
        return StartSource(init, Path(init), read_tracks(init, recording=recording))
    if recording.truth is None:
        raise InputError(
            recording.folder, expected="a reference for --init truth", found="none", remedy="use --init auto"
        )
    return StartSource(init, recording.folder, recording.truth)


def room_bounds(rig: Rig, bounds_m: tuple[float, ...] | None = None) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the room, metres.

    Without given bounds, the room is the space into which the cameras look: from each camera along its optical axis, to
    twice the distance of the point at which all cameras look, and one metre wider on every side. Its height is from the
    floor at z = 0 to one metre above the highest camera; if a camera is at or below z = 0, the room begins one metre
    below the lowest camera. So a few cameras on one side have the same room as cameras on all sides.

    Args:
        rig: the cameras.
        bounds_m: given bounds (x0, x1, y0, y1, z0, z1), metres.

    Returns:
        (2, 3), lowest and highest corner.
    """
    if bounds_m is not None:
        return np.array(bounds_m, np.float64).reshape(3, 2).T
    axis, centre = rig.cameras.T_cam_world[:, 2, :3], rig.cameras.centre_world
    corners = np.concatenate([centre, centre + 2 * looking_depths_m(rig.cameras)[:, None] * axis])
    low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
    low[2] = 0.0 if centre[:, 2].min() > 0 else centre[:, 2].min() - 1.0
    high[2] = centre[:, 2].max() + 1.0
    return np.stack([low, high])


def known_motion(
    source: StartSource, drones: DroneSettings, fps: float
) -> tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None:
    """Given positions of the silhouettes' middles, (known, 3), metres, and velocities, (known, 3), m/s, at frame 0.

    None where nothing is given.

    Raises:
        InputError: fewer drones are given than there are.
    """
    if source.given is None:
        return None
    given = source.given
    there = np.isfinite(given.position_m).all(axis=-1)
    positions, velocities = [], []
    for drone in np.flatnonzero(there.any(axis=0)):
        rows = np.flatnonzero(there[:, drone])[:2]
        point, frames = given.position_m[rows, drone], given.frame[rows]
        if given.velocity_m_s is not None:
            velocity = given.velocity_m_s[rows[0], drone]
        elif len(rows) == 2:
            velocity = (point[1] - point[0]) * fps / (frames[1] - frames[0])
        else:
            velocity = np.zeros(3)
        positions.append(point[0] - velocity * frames[0] / fps + np.array(drones.body_offset_m))
        velocities.append(velocity)
    if len(positions) < (wanted := drones.count or 1):
        raise InputError(
            source.path,
            expected=f"{wanted} drone{'s' * (wanted > 1)} (--init {source.init})",
            found=f"{len(positions)}",
            remedy="say how many there are with --drones",
        )
    return np.array(positions)[: drones.count], np.array(velocities)[: drones.count]


def given_state(
    rig: Rig, silhouettes: Silhouettes, source: StartSource, drones: DroneSettings, fps: float
) -> InitialState | None:
    """The drones at given positions, with sizes from the blobs there; None where no positions are given.

    Raises:
        InputError: fewer drones are given than there are, or no camera shows the size of a drone.
    """
    known = known_motion(source, drones, fps)
    if known is None:
        return None
    position_m, velocity_m_s = known
    sizes = (
        np.full((len(position_m), 3), np.nan)
        if drones.size_m is None
        else np.tile(drones.size_m, (len(position_m), 1))
    )
    size_m, num_cameras = _sizes_at(rig, silhouettes, position_m, velocity_m_s / fps)
    size_m = np.where(np.isfinite(sizes), sizes, size_m)
    there = np.isfinite(size_m).all(axis=-1)
    if not there.any():
        raise InputError(
            source.path,
            expected="a size for every drone",
            found="drones whose size no camera shows",
            remedy="pass --drone-size X,Y,Z",
        )
    # A drone that no camera shows alone gets the median size of the others.
    size_m = np.where(there[:, None], size_m, np.median(size_m[there], axis=0))
    return InitialState(position_m, velocity_m_s, size_m, num_cameras)


def state_at_first_frame(tracks: Tracks) -> InitialState:
    """The drones that were there at frame 0, as an initial state."""
    there = np.flatnonzero(np.isfinite(tracks.position_m[0]).all(axis=-1))
    position_m, velocity_m_s = (
        np.asarray(value[0], np.float64)[there] for value in (tracks.position_m, tracks.velocity_m_s)
    )
    size_m = np.asarray(tracks.size_m, np.float64)[there]
    return InitialState(position_m, velocity_m_s, size_m, np.asarray(tracks.num_cameras[0], float)[there])


def first_drones(
    rig: Rig,
    silhouettes: Silhouettes,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
    drones: DroneSettings,
) -> InitialState:
    """The drones of the first frames, for a method that is plugged in.

    Args:
        rig: the cameras.
        silhouettes: silhouettes of all cameras.
        fps: instants per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        max_speed_m_s: largest speed of a drone, m/s.
        drones: number and sizes where they are known.
    """
    count = min(_FRAMES, silhouettes.num_frames)
    sightings = from_silhouettes(silhouettes, frames=np.arange(count))
    limits = FlightLimits(fps, bounds_m, max_speed_m_s)
    rules = BirthRules(num_frames=silhouettes.num_frames, size_m=drones.size_m)
    births = Births(rig.cameras, limits, rules)
    for frame in range(count):
        births.step(frame, sightings[frame], NO_DRONES)
    found = [each for each in births.candidates() if each.instant < WINDOW_FRAMES][: drones.count]
    states = [state_at(each.path, 0, limits) for each in found]
    sizes = [each.size_m if drones.size_m is None else np.array(drones.size_m) for each in found]
    return InitialState(
        np.array([position for position, _ in states]).reshape(-1, 3),
        np.array([velocity for _, velocity in states]).reshape(-1, 3),
        np.array(sizes).reshape(-1, 3),
        np.array([each.num_cameras for each in found], float),
    )


def _sizes_at(
    rig: Rig,
    silhouettes: Silhouettes,
    position_m: Float[np.ndarray, "drones 3"],
    step_m: Float[np.ndarray, "drones 3"],
) -> tuple[Float[np.ndarray, "drones 3"], Float[np.ndarray, "drones"]]:
    """Sizes of drones from their blobs in the first frames; and mean numbers of cameras."""
    count, num_drones = min(_START_FRAMES, silhouettes.num_frames), len(position_m)
    seen, room_m = from_silhouettes(silhouettes, frames=np.arange(count)), wide_bounds(rig)
    spans, numbers = np.full((count, num_drones, 2), np.nan), np.zeros((count, num_drones))
    std_m2 = np.tile(_GIVEN_STD_M**2 * np.eye(3), (num_drones, 1, 1))
    for frame in range(count):
        expected = Expected(position_m + frame * step_m, std_m2, np.ones(num_drones))
        crossed = crossings(rig.cameras, seen[frame], room_m, expected)
        own = crossed.expected >= 0
        spans[frame, crossed.expected[own]] = crossed.span_m[own]
        numbers[frame, crossed.expected[own]] = crossed.seen[own].sum(axis=-1)
    shown = np.isfinite(spans).any(axis=(0, 2))
    size_m = np.full((num_drones, 3), np.nan)
    size_m[shown] = np.nanmedian(spans[:, shown], axis=0)[:, [0, 0, 1]]
    return size_m, numbers.mean(axis=0)
