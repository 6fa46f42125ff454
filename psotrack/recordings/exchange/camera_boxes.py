"""Boxes of tracked drones in the frames of each camera, at the times at which the frames were exposed."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry import Extents, make_extents, project_boxes
from psotrack.recordings import Recording
from psotrack.support import short_repr
from psotrack.trajectories import Trajectories
from psotrack.trajectories.resampling import interpolated

#: Longest gap between two frames of a track over which positions are interpolated, in intervals: one missing frame is a
#: gap, in which no box is invented.
_GAP = 1.5
#: A row's time and the row of a drone depend on each other: the second correction is far below a line of the image.
_ROLLING_PASSES = 2


@dataclass(frozen=True, repr=False)
class Footage:
    """The recording from which tracks were made, for formats that hold boxes, cameras or images.

    Attributes:
        recording: the recording.
        size_m: (drones, 3), full lengths of the tracked drones along the world's axes, metres; None if unknown.
        images: whether the images of the cameras are exported too.
    """

    recording: Recording
    size_m: Float[np.ndarray, "drones 3"] | None = None
    images: bool = False

    __repr__ = short_repr


@dataclass(frozen=True, repr=False)
class CameraFrames:
    """The frames of one camera during the tracks.

    Attributes:
        name: name of the camera.
        index: place of the camera in the rig.
        time_s: (frames,), times of the camera's frames from frame 0 on, seconds.
        fps: frames per second.
        image_size_wh: width and height, pixels.
    """

    name: str
    index: int
    time_s: Float[np.ndarray, "frames"]
    fps: float
    image_size_wh: tuple[int, int]

    __repr__ = short_repr


def camera_frames(recording: Recording, trajectories: Trajectories) -> list[CameraFrames]:
    """The cameras with frames before the end of the tracks, and these frames."""
    found = []
    for index, name in enumerate(recording.rig.names):
        times = recording.exposed[name]
        last_s = trajectories.time_s[-1] + 0.5 / times.fps
        time_s = times.time_s[times.time_s <= last_s]
        if len(time_s):
            width, height = recording.rig.cameras.image_size_wh[index].astype(int).tolist()
            found.append(CameraFrames(name, index, time_s, float(times.fps), (width, height)))
    return found


def boxes_in_camera(
    recording: Recording,
    camera: CameraFrames,
    trajectories: Trajectories,
    size_m: Float[np.ndarray, "drones 3"],
) -> Float[np.ndarray, "frames drones 4"]:
    """Boxes of the drones in each frame of a camera, xyxy in pixels as in `geometry.boxes`, not cut at the border.

    NaN where the drone is not seen in the tracks at the frame's time, or has no part in the image.

    Args:
        recording: the recording, with the rig.
        camera: the camera's frames.
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres.
    """
    cameras = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float32),
        recording.rig.cameras[np.array([camera.index])],
    )
    seen = make_extents(cameras, jnp.asarray(size_m, jnp.float32))
    line_time_s = recording.by_name[camera.name].line_time_s
    width, height = camera.image_size_wh
    time_s = np.repeat(camera.time_s[:, None], trajectories.num_drones, axis=1)
    xyxy, shown = _project(seen, _positions_at(trajectories, time_s))
    for _ in range(_ROLLING_PASSES if line_time_s else 0):
        # The frame's time is that of the middle row.
        row = np.clip(np.where(shown, xyxy[..., [1, 3]].mean(axis=-1), height / 2), 0, height)
        xyxy, shown = _project(seen, _positions_at(trajectories, time_s + (row - height / 2) * line_time_s))
    inside = (xyxy[..., 0] < width) & (xyxy[..., 1] < height) & (xyxy[..., 2] > 0) & (xyxy[..., 3] > 0)
    return np.where((shown & inside)[..., None], xyxy, np.nan)


def _project(
    seen: Extents, position_m: Float[np.ndarray, "frames drones 3"]
) -> tuple[Float[np.ndarray, "frames drones 4"], Bool[np.ndarray, "frames drones"]]:
    """Boxes, and whether they have a meaning."""
    known = np.isfinite(position_m).all(axis=-1)
    # Any number in place of NaN: the box is not used.
    boxes = project_boxes(seen, jnp.asarray(np.where(known[..., None], position_m, 0.0), jnp.float32))
    return np.asarray(boxes.xyxy, np.float64)[:, :, 0], np.asarray(boxes.in_front)[:, :, 0] & known


def _positions_at(
    trajectories: Trajectories, time_s: Float[np.ndarray, "frames drones"]
) -> Float[np.ndarray, "frames drones 3"]:
    """Positions of each drone at times of its own, metres; NaN where the drone is not seen."""
    position_m = np.where(trajectories.seen[..., None], trajectories.position_m, np.nan)
    gap_s = _GAP * float(np.median(np.diff(trajectories.time_s))) if trajectories.num_frames > 1 else 0.0
    columns = [
        interpolated(trajectories.time_s, position_m[:, [drone]], gap_s)(time_s[:, drone])
        for drone in range(trajectories.num_drones)
    ]
    return np.concatenate(columns, axis=1)
