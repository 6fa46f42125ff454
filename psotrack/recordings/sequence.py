"""`Sequence`: what every source of data yields: videos, calibrated cameras, and a reference where known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import CameraRig
from psotrack.recordings.video import VideoInfo
from psotrack.trajectories import Trajectories


@dataclass(frozen=True)
class OnboardVideo:
    """The video of a drone's own camera, fixed to its body, without lens distortion.

    Attributes:
        video: the file.
        K: (3, 3), intrinsics in pixels; None where they are not known.
        position_m: (frames, 3), the camera's centre, world; NaN where it is not known.
        orientation_wxyz: (frames, 4), unit quaternions, camera to world, with camera axes x right, y down, z ahead; NaN
            where they are not known.
    """

    video: VideoInfo
    K: Float[np.ndarray, "3 3"] | None
    position_m: Float[np.ndarray, "frames 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]


@dataclass(frozen=True)
class Sequence:
    """Synchronised videos of calibrated cameras that stand still.

    Reading is lenient: a camera may have no video, and videos may differ in length. Using is strict: `usable`
    says what does not fit, and how to leave it out.

    Attributes:
        name: of the recording.
        folder: where it lies.
        rig: all calibrated cameras.
        videos: by camera name; a camera without video is absent.
        truth: the reference at the video's frames, or None.
        detections: files of 2D boxes by camera name.
        onboard: videos of drones' own cameras by the drones' names, or None.
    """

    name: str
    folder: Path
    rig: CameraRig
    videos: Mapping[str, VideoInfo]
    truth: Trajectories | None = None
    detections: Mapping[str, Path] | None = None
    onboard: Mapping[str, OnboardVideo] | None = None

    @property
    def fps(self) -> float:
        """Frames per second of the first video."""
        return self._first.fps

    @property
    def num_frames(self) -> int:
        """Frames that every video has."""
        return min((video.num_frames for video in self.videos.values()), default=0)

    @property
    def _first(self) -> VideoInfo:
        if not self.videos:
            raise InputError(self.folder, expected="at least one video", found="none")
        return next(iter(self.videos.values()))

    def usable(self, cameras: Ordered[str] | None = None, num_frames: int | None = None) -> Sequence:
        """This sequence with just the chosen cameras and frames, checked to be fit for tracking.

        Args:
            cameras: names to keep; None keeps all.
            num_frames: leading frames to keep; None keeps all.

        Raises:
            InputError: a camera has no video, or videos differ in size, rate or length, or in size from
                their calibration.
            SettingsError: a camera is unknown, or there are not so many frames.
        """
        rig = self.rig if cameras is None else self.rig.select(cameras)
        self._check_videos_there(rig)
        videos = {name: self.videos[name] for name in rig.names}
        for name, video in videos.items():
            calibrated_wh = rig.cameras.image_size_wh[rig.names.index(name)]
            _check(
                video, "calibrated", _size((int(calibrated_wh[0]), int(calibrated_wh[1]))), _size_of(video)
            )
        _check_alike(videos, _size_of, remedy="go without it by --cameras")
        _check_alike(videos, _rate_of, remedy="go without it by --cameras")
        shortest = min(video.num_frames for video in videos.values())
        if num_frames is None:
            _check_alike(videos, _length_of, remedy=f"pass --frames {shortest} to use those that all have")
            return replace(self, rig=rig, videos=videos)
        if not 0 < num_frames <= shortest:
            raise SettingsError(
                "frames", expected=f"1 to {shortest}, the frames that all cameras have", found=f"{num_frames}"
            )
        cut = {name: replace(video, num_frames=num_frames) for name, video in videos.items()}
        return replace(self, rig=rig, videos=cut)

    def _check_videos_there(self, rig: CameraRig) -> None:
        without = [name for name in rig.names if name not in self.videos]
        if without:
            rest = ",".join(name for name in rig.names if name in self.videos)
            raise InputError(
                self.folder,
                expected=f"a video for each of the cameras {', '.join(rig.names)}",
                found=f"none for {', '.join(without)}",
                remedy=f"pass --cameras {rest} to go without" if rest else "",
            )


def _check(video: VideoInfo, standard: str, expected: str, found: str, remedy: str = "") -> None:
    if found != expected:
        raise InputError(video.path, expected=f"{expected} as {standard}", found=found, remedy=remedy)


def _check_alike(videos: Mapping[str, VideoInfo], aspect: Callable[[VideoInfo], str], remedy: str) -> None:
    """Raise unless the videos agree; the one that is blamed differs from what most of them have."""
    usual = Counter(map(aspect, videos.values())).most_common(1)[0][0]
    model = next(video for video in videos.values() if aspect(video) == usual)
    for video in videos.values():
        _check(video, f"in {model.path.name}", usual, aspect(video), remedy)


def _size(image_size_wh: tuple[int, int]) -> str:
    return f"{image_size_wh[0]} x {image_size_wh[1]} pixels"


def _size_of(video: VideoInfo) -> str:
    return _size(video.image_size_wh)


def _rate_of(video: VideoInfo) -> str:
    # Three decimals tell 29.97 from 30, and are what every container holds.
    return f"{video.fps:.3f} frames per second"


def _length_of(video: VideoInfo) -> str:
    return f"{video.num_frames} frames"
