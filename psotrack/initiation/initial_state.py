"""The initial state: positions, velocities and sizes of the drones at frame 0, found in the first frames or given."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.geometry import Rig, looking_depths_m
from psotrack.initiation.initialisation import InitialState, all_blobs, find_drones_in_blobs
from psotrack.recordings import Recording
from psotrack.settings import DroneSettings
from psotrack.silhouettes import Silhouettes
from psotrack.trajectories import Trajectories, read_trajectories

logger = logging.getLogger(__name__)

#: Number of first frames in which the drones are found. Over more frames their paths are no straight lines.
START_FRAMES = 10
#: Two initial positions nearer than this are of one drone, metres: the middles of box and silhouette differ.
SAME_M = 0.3
#: A given position takes the size of a found drone that is nearer than this, metres.
SAME_DRONE_M = 0.5


@dataclass(frozen=True)
class StartSource:
    """Where the initial state comes from.

    Attributes:
        init: "auto", "truth" or the name of a file of tracks (see `TrackSettings.init`).
        path: path of the recording, or of the file of tracks.
        given: trajectories whose first frame is the start; None where the drones are to be found.
    """

    init: str
    path: Path
    given: Trajectories | None = None


def start_source(recording: Recording, init: str) -> StartSource:
    """Where the initial state comes from, with the given trajectories read.

    Raises:
        InputError: there is no reference, or the file cannot be read.
    """
    if init == "auto":
        return StartSource(init, recording.folder)
    if init != "truth":
        return StartSource(init, Path(init), read_trajectories(Path(init), fps=recording.fps))
    if recording.truth is None:
        raise InputError(
            recording.folder, expected="a reference for --init truth", found="none", remedy="use --init auto"
        )
    return StartSource(init, recording.folder, recording.truth)


def room_bounds(
    rig: Rig, bounds_m: tuple[float, float, float, float, float, float] | None = None
) -> Float[np.ndarray, "2 3"]:
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


def find_initial_state(
    rig: Rig,
    silhouettes: Silhouettes,
    source: StartSource,
    drones: DroneSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> InitialState:
    """Positions of the silhouettes' middles, velocities and sizes of the drones at frame 0.

    Drones that are not found may still come later, so the state may have no drones.

    Args:
        rig: the cameras.
        silhouettes: silhouettes of all cameras of the rig.
        source: given trajectories, or none.
        drones: number, sizes and body offset where they are known.
        fps: frames per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        max_speed_m_s: largest speed of a drone, m/s.

    Raises:
        InputError: the given trajectories have too few drones, or the size of a drone cannot be found.
    """
    count, exposures = min(START_FRAMES, silhouettes.num_frames), silhouettes.exposures
    state = find_drones_in_blobs(
        rig.cameras,
        all_blobs(
            silhouettes.read(0, count),
            silhouettes.reduction,
            None if exposures is None else exposures[:count],
            silhouettes.borders,
        ),
        fps=fps,
        bounds_m=bounds_m,
        max_speed_m_s=max_speed_m_s,
        drones=drones.count,
    )
    if source.given is not None:
        state = _with_sizes(source.given, state, fps, np.array(drones.body_offset_m))
        wanted = drones.count or 1
        if len(state.position_m) < wanted:
            raise InputError(
                source.path,
                expected=f"{wanted} drone{'s' * (wanted > 1)} (--init {source.init})",
                found=f"{len(state.position_m)}",
                remedy="say how many there are with --drones",
            )
    return state


def complete_initial_state(
    state: InitialState, detected: InitialState | None, drones: DroneSettings, source: StartSource
) -> InitialState:
    """The initial state with drones that only detections show, limited to the known number, with known sizes.

    Args:
        state: initial state, found in silhouettes or given.
        detected: drones that detections show at frame 0; None where no detections are read. These drones are added
            unless the positions are given: a drone that hovers may be part of the learned background.
        drones: number and sizes where they are known.
        source: where the state comes from.

    Raises:
        InputError: the size of a drone is not known.
    """
    if detected is not None and source.given is None:
        state = _with_others(state, detected)
    state = InitialState(*(value[: drones.count] for value in vars(state).values()))
    if len(state.position_m) < (drones.count or 0):
        logger.warning("frame 0: %d of %d drones found", len(state.position_m), drones.count)
    if drones.size_m is not None:
        size_m = np.broadcast_to(np.array(drones.size_m), state.position_m.shape)
        state = InitialState(state.position_m, state.velocity_m_s, size_m, state.num_cameras)
    if not np.isfinite(state.size_m).all():
        raise InputError(
            source.path,
            expected="a size for every drone",
            found="drones whose size no camera shows",
            remedy="pass --drone-size X,Y,Z",
        )
    return state


def known_motion(
    source: StartSource, drones: DroneSettings, fps: float
) -> tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None:
    """Given positions of the silhouettes' middles, (known, 3), metres, and velocities, (known, 3), m/s, at frame 0.

    None where nothing is given.
    """
    if source.given is None:
        return None
    none_found = InitialState(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    state = _with_sizes(source.given, none_found, fps, np.array(drones.body_offset_m))
    return state.position_m[: drones.count], state.velocity_m_s[: drones.count]


def _with_others(found: InitialState, detected: InitialState) -> InitialState:
    """The found drones, and after them the detected drones that are not among the found ones."""
    apart_m = np.linalg.norm(detected.position_m[:, None] - found.position_m[None], axis=-1)
    others = apart_m.min(axis=1, initial=np.inf) > SAME_M
    return InitialState(
        *(np.concatenate([value, getattr(detected, name)[others]]) for name, value in vars(found).items())
    )


def _with_sizes(
    given: Trajectories, found: InitialState, fps: float, body_offset_m: Float[np.ndarray, "3"]
) -> InitialState:
    """Given trajectories at frame 0, with the sizes of the drones that were found there."""
    there = np.isfinite(given.position_m).all(axis=-1)
    positions, velocities, sizes, cameras = [], [], [], []
    for drone in np.flatnonzero(there.any(axis=0)):
        rows = np.flatnonzero(there[:, drone])[:2]
        point = given.position_m[rows, drone]
        frames = given.frame[rows]
        if given.velocity_m_s is not None:
            velocity = given.velocity_m_s[rows[0], drone]
        elif len(rows) == 2:
            velocity = (point[1] - point[0]) * fps / (frames[1] - frames[0])
        else:
            velocity = np.zeros(3)
        position = point[0] - velocity * frames[0] / fps + body_offset_m
        distance = np.linalg.norm(found.position_m - position, axis=-1)
        nearest = distance.argmin() if len(distance) and distance.min() < SAME_DRONE_M else None
        positions.append(position)
        velocities.append(velocity)
        sizes.append(np.full(3, np.nan) if nearest is None else found.size_m[nearest])
        cameras.append(0.0 if nearest is None else found.num_cameras[nearest])
    size = np.array(sizes).reshape(-1, 3)
    # A drone that was not found there gets the median size of the drones that were found.
    usual = np.nanmedian(size, axis=0) if np.isfinite(size).any() else np.full(3, np.nan)
    return InitialState(
        position_m=np.array(positions).reshape(-1, 3),
        velocity_m_s=np.array(velocities).reshape(-1, 3),
        size_m=np.where(np.isfinite(size), size, usual),
        num_cameras=np.array(cameras),
    )
