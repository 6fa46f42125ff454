"""Where drones are when tracking begins: found in the first frames, or told by the user."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.geometry import CameraRig
from psotrack.initiation.initialisation import InitialState, find_drones
from psotrack.recordings import Sequence
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.trajectories import Trajectories, read_trajectories

logger = logging.getLogger(__name__)

#: Frames from which the drones are found. Longer, and their paths are no straight lines any more.
START_FRAMES = 10
#: Drones of two starts that are nearer than this are one: the middles of box and silhouette, and some noise.
SAME_M = 0.3


def room_bounds(rig: CameraRig, settings: TrackSettings) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of the room, metres.

    Where nobody says, the room is what the cameras look into: from each of them along its optical axis, as far beyond
    the point that all of them look at as they are before it; a metre wider, from the floor at z = 0 (or below the
    lowest camera, if that is lower) to a metre above the highest one. A few cameras on one side so have the same room
    as all of them around it.
    """
    if settings.bounds_m is not None:
        return np.array(settings.bounds_m, np.float64).reshape(3, 2).T
    axis, centre = rig.cameras.T_cam_world[:, 2, :3], rig.cameras.centre_world
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    # The point nearest to all optical axes; cameras that look the same way have none, and get what their spread says.
    focus = np.linalg.lstsq(across.sum(axis=0), (across @ centre[..., None]).sum(axis=0)[:, 0])[0]
    spread = np.linalg.norm(np.ptp(centre, axis=0))
    depth = np.clip(((focus - centre) * axis).sum(axis=-1), spread / 4, 2 * spread)
    corners = np.concatenate([centre, centre + 2 * depth[:, None] * axis])
    low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
    low[2] = 0.0 if centre[:, 2].min() > 0 else centre[:, 2].min() - 1.0
    high[2] = centre[:, 2].max() + 1.0
    return np.stack([low, high])


def find_initial_state(
    sequence: Sequence,
    silhouettes: Silhouettes,
    settings: TrackSettings,
    bounds_m: Float[np.ndarray, "2 3"],
    detected: InitialState | None = None,
) -> InitialState:
    """Positions, velocities and sizes of the drones at frame 0, as `settings.init` says.

    Positions are of the silhouettes' middles. Drones that are not found may still come (see `tracking`): a start may
    be empty.

    Args:
        sequence: fit for use.
        silhouettes: of all of its cameras.
        settings: how.
        bounds_m: (2, 3), lowest and highest corner of the room.
        detected: what detections say of frame 0. With `init` "auto" those of its drones count too that the silhouettes
            do not tell: one that hangs in the air may be in the background by then.

    Raises:
        InputError: there is no reference or file to start from, or it has too few drones.
    """
    found = find_drones(
        sequence.rig.cameras,
        silhouettes.read(0, min(START_FRAMES, silhouettes.num_frames)),
        reduction=silhouettes.reduction,
        fps=sequence.fps,
        bounds_m=bounds_m,
        max_speed_m_s=settings.max_speed_m_s,
        drones=settings.drones,
    )
    if settings.init == "auto":
        start, source = found if detected is None else _with_others(found, detected), sequence.folder
    else:
        known, source = _known_start(sequence, settings.init)
        start = _with_sizes(known, found, sequence.fps, np.array(settings.body_offset_m))
        wanted = settings.drones or 1
        if len(start.position_m) < wanted:
            raise InputError(
                source,
                expected=f"{wanted} drone{'s' * (wanted > 1)} (--init {settings.init})",
                found=f"{len(start.position_m)}",
                remedy="say how many there are with --drones",
            )
    start = InitialState(*(value[: settings.drones] for value in vars(start).values()))
    if len(start.position_m) < (settings.drones or 0):
        logger.warning("frame 0: %d of %d drones found", len(start.position_m), settings.drones)
    if settings.drone_size_m is not None:
        start = InitialState(
            start.position_m,
            start.velocity_m_s,
            np.broadcast_to(np.array(settings.drone_size_m), start.position_m.shape),
            start.num_cameras,
        )
    if not np.isfinite(start.size_m).all():
        raise InputError(
            source,
            expected="a size for every drone",
            found="drones that no camera sees by themselves",
            remedy="pass --drone-size X,Y,Z",
        )
    return start


def _with_others(found: InitialState, detected: InitialState) -> InitialState:
    """The found drones, and after them those of the detected ones that are none of them."""
    apart_m = np.linalg.norm(detected.position_m[:, None] - found.position_m[None], axis=-1)
    others = apart_m.min(axis=1, initial=np.inf) > SAME_M
    return InitialState(
        *(np.concatenate([value, getattr(detected, name)[others]]) for name, value in vars(found).items())
    )


def known_motion(
    sequence: Sequence, settings: TrackSettings
) -> tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None:
    """Positions of the silhouettes' middles and velocities at frame 0, where `settings.init` tells; None if not.

    Raises:
        InputError: there is no reference or file to start from.
    """
    if settings.init == "auto":
        return None
    known, _ = _known_start(sequence, settings.init)
    nobody = InitialState(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    start = _with_sizes(known, nobody, sequence.fps, np.array(settings.body_offset_m))
    return start.position_m[: settings.drones], start.velocity_m_s[: settings.drones]


def _known_start(sequence: Sequence, init: str) -> tuple[Trajectories, Path]:
    """The trajectories that a start is taken from, and where they come from."""
    if init != "truth":
        path = Path(init)
        return read_trajectories(path, fps=sequence.fps), path
    if sequence.truth is None:
        raise InputError(
            sequence.folder, expected="a reference for --init truth", found="none", remedy="use --init auto"
        )
    return sequence.truth, sequence.folder


def _with_sizes(
    known: Trajectories, found: InitialState, fps: float, body_offset_m: Float[np.ndarray, "3"]
) -> InitialState:
    """A start from known trajectories: moved to frame 0, with the sizes of the drones that are seen there."""
    there = np.isfinite(known.position_m).all(axis=-1)
    positions, velocities, sizes, cameras = [], [], [], []
    for drone in np.flatnonzero(there.any(axis=0)):
        rows = np.flatnonzero(there[:, drone])[:2]
        point = known.position_m[rows, drone]
        frames = known.frame[rows]
        if known.velocity_m_s is not None:
            velocity = known.velocity_m_s[rows[0], drone]
        elif len(rows) == 2:
            velocity = (point[1] - point[0]) * fps / (frames[1] - frames[0])
        else:
            velocity = np.zeros(3)
        position = point[0] - velocity * frames[0] / fps + body_offset_m
        distance = np.linalg.norm(found.position_m - position, axis=-1)
        nearest = distance.argmin() if len(distance) and distance.min() < 0.5 else None
        positions.append(position)
        velocities.append(velocity)
        sizes.append(np.full(3, np.nan) if nearest is None else found.size_m[nearest])
        cameras.append(0.0 if nearest is None else found.num_cameras[nearest])
    size = np.array(sizes).reshape(-1, 3)
    # A drone that no camera sees by itself is taken to be like the others.
    usual = np.nanmedian(size, axis=0) if np.isfinite(size).any() else np.full(3, np.nan)
    return InitialState(
        position_m=np.array(positions).reshape(-1, 3),
        velocity_m_s=np.array(velocities).reshape(-1, 3),
        size_m=np.where(np.isfinite(size), size, usual),
        num_cameras=np.array(cameras),
    )
