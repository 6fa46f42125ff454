"""Settings and result of localising a camera in a video."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering import PoseFilterParams
from psotrack.inside_out.line_time import LineTime
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import PoseSettings, RollingShutter

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

    def within(self, num_frames: int | None) -> LocaliseSettings:
        """Settings for a recording of `num_frames` frames, as `PoseFilterParams.within`; None is a stream."""
        return self if self.filter is None else replace(self, filter=self.filter.within(num_frames))


@dataclass(frozen=True)
class LocalisedVideo:
    """Path of a camera, with the time that it took to compute.

    Attributes:
        path: filtered path; equal to `raw` without a filter.
        raw: path of each frame's own pose.
        marker_map: the map; where only centres were given, with the corners that were found.
        seconds: seconds by stage of `STAGES`, summed over frames; stages run in parallel.
        wall_s: seconds from the first frame to the last.
        interrupted: whether Ctrl-C ended a stream.
        shutter: the shutter with which the poses were estimated; None is a global shutter.
        line_time: the line time that the video shows; None if it was not estimated: in a stream, and in a video without
            five consecutive frames that show enough markers.
        wrong_markers: ids of the markers that are not where the map has them; they were left out, unless most
            of the seen markers are wrong.
        unknown_markers: ids of seen markers whose centres were given, but whose corners could not be found.
    """

    path: CameraPath
    raw: CameraPath
    marker_map: MarkerMap
    seconds: Mapping[str, float]
    wall_s: float
    interrupted: bool = False
    shutter: RollingShutter | None = None
    line_time: LineTime | None = None
    wrong_markers: tuple[int, ...] = ()
    unknown_markers: tuple[int, ...] = ()

    @property
    def frames_per_second(self) -> float:
        """Frames per second of wall time."""
        return self.raw.num_frames / max(self.wall_s, 1e-9)
