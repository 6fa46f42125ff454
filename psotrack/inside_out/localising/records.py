"""Settings and result of localising a camera in a video."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering import PoseFilterParams
from psotrack.inside_out.pose import PoseSettings

#: Stages that each frame passes; the first two run in a thread of their own.
STAGES = ("decode", "grey", "detect", "locate", "filter")


@dataclass(frozen=True)
class LocaliseSettings:
    """Settings of localising a camera.

    Attributes:
        dictionary: name of the markers' dictionary, such as 4x4_1000.
        pose: settings of pose estimation.
        filter: parameters of the causal filter; None returns every frame's own pose.
    """

    dictionary: str = "4x4_1000"
    pose: PoseSettings = field(default_factory=PoseSettings)
    filter: PoseFilterParams | None = field(default_factory=PoseFilterParams)

    def within(self, num_frames: int | None) -> LocaliseSettings:
        """Settings for a recording of `num_frames` frames, as `PoseFilterParams.within`; None is a stream."""
        return self if self.filter is None else replace(self, filter=self.filter.within(num_frames))


@dataclass(frozen=True)
class LocalisedVideo:
    """Path of a camera, with the time that it took to compute.

    Attributes:
        path: filtered path; equal to `raw` without a filter.
        raw: path of each frame's own pose.
        seconds: seconds by stage of `STAGES`, summed over frames; stages run in parallel.
        wall_s: seconds from the first frame to the last.
        interrupted: whether Ctrl-C ended a stream.
    """

    path: CameraPath
    raw: CameraPath
    seconds: Mapping[str, float]
    wall_s: float
    interrupted: bool = False

    @property
    def frames_per_second(self) -> float:
        """Frames per second of wall time."""
        return self.raw.num_frames / max(self.wall_s, 1e-9)
