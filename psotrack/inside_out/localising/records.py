"""Settings and result of localising a camera in a video."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering import PoseFilterParams, smooth
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import PoseSettings
from psotrack.inside_out.rolling_shutter import LineTime, RollingShutter

#: Stages that each frame passes; the first two run in a thread of their own.
STAGES = ("decode", "grey", "detect", "locate", "filter")


@dataclass(frozen=True)
class LocaliseSettings:
    """Settings of localising a camera.

    Attributes:
        dictionary: name of the markers' dictionary, such as 4x4_1000.
        pose: settings of pose estimation.
        filter: parameters of the causal filter; None returns every frame's own pose.
        shutter: the camera's rolling shutter; None is estimated from a recording, and is a global shutter otherwise.
    """

    dictionary: str = "4x4_1000"
    pose: PoseSettings = field(default_factory=PoseSettings)
    filter: PoseFilterParams | None = field(default_factory=PoseFilterParams)
    shutter: RollingShutter | None = None


@dataclass(frozen=True)
class LocalisedVideo:
    """Path of a camera in a video, or in frames whose markers are detected.

    Attributes:
        path: filtered path; equal to `raw` without a filter.
        raw: path of each frame's own pose.
        constant: (frames, 6, 6), part of the covariances of `raw` by errors that are the same in all frames.
        shutter: the shutter with which the poses were estimated.
        marker_map: the map; where only centres were given, with the corners that were found.
        line_time: the line time that the frames show; None if it was not estimated: in a stream, and without five
            consecutive frames that show enough markers.
        wrong_markers: ids of the markers that are not where the map has them; they were left out, unless most
            of the seen markers are wrong.
        unknown_markers: ids of seen markers whose centres were given, but whose corners could not be found.
        interrupted: whether Ctrl-C ended a stream.
        seconds: seconds by stage of `STAGES`, summed over frames; stages run in parallel.
        wall_s: seconds from the first frame to the last.
    """

    path: CameraPath
    raw: CameraPath
    constant: Float[np.ndarray, "frames 6 6"]
    shutter: RollingShutter
    marker_map: MarkerMap
    line_time: LineTime | None = None
    wrong_markers: tuple[int, ...] = ()
    unknown_markers: tuple[int, ...] = ()
    interrupted: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)
    wall_s: float = 0.0

    def smoothed(self, params: PoseFilterParams | None = None) -> CameraPath:
        """The path with every pose estimated from all frames."""
        return smooth(self.raw, params, self.constant)

    @property
    def frames_per_second(self) -> float:
        """Frames per second of wall time."""
        return self.raw.num_frames / max(self.wall_s, 1e-9)
