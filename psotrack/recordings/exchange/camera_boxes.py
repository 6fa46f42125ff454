"""Boxes of tracked drones in the frames of each camera, at the times at which the frames were exposed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from psotrack.recordings import FrameTimes, Recording, view_in_images
from psotrack.support import short_repr
from psotrack.trajectories import Trajectories, resample

#: Longest gap between two frames of a track over which positions are interpolated, in intervals: one missing frame is a
#: gap, in which no box is invented.
_GAP = 1.5


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


def camera_frames(recording: Recording, trajectories: Trajectories) -> dict[str, FrameTimes]:
    """The times of the frames before the end of the tracks, of each camera that has some, by its name."""
    found = {}
    for name, times in recording.exposed.items():
        last_s = trajectories.time_s[-1] + 0.5 / times.fps
        found[name] = times.cut(int(np.count_nonzero(times.time_s <= last_s)))
    return {name: times for name, times in found.items() if times.num_frames}


def boxes_in_camera(
    recording: Recording,
    name: str,
    times: FrameTimes,
    trajectories: Trajectories,
    size_m: Float[np.ndarray, "drones 3"],
) -> Float[np.ndarray, "frames drones 4"]:
    """Boxes of the drones in each frame of a camera, xyxy in pixels as in `geometry.boxes`, not cut at the border.

    NaN where the drone is not seen in the tracks at the frame's time, or has no part in the image.

    Args:
        recording: the recording, with the rig.
        name: name of the camera.
        times: times of the camera's frames.
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres.
    """
    gap_s = _GAP * float(np.median(np.diff(trajectories.time_s))) if trajectories.num_frames > 1 else 0.0
    position_m = np.where(trajectories.seen[..., None], trajectories.position_m, np.nan)
    seen = Trajectories(trajectories.frame, trajectories.time_s, trajectories.drones, position_m)
    at_frames = resample(seen, np.arange(times.num_frames), times.time_s, gap_s=gap_s)
    alone = replace(recording, cameras=(recording.by_name[name],))
    return view_in_images(alone, at_frames, size_m).boxes_px[:, :, 0]
