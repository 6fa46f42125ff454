"""`Recording`: one recording with its videos, calibrated cameras and, if known, its reference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Rig
from psotrack.recordings.video import VideoInfo
from psotrack.support import short_repr
from psotrack.trajectories import Trajectories


@dataclass(frozen=True)
class OnboardVideo:
    """The video of a camera that is fixed to a drone and has no lens distortion.

    Attributes:
        video: the video file.
        K: (3, 3), intrinsics in pixels; None if unknown.
        position_m: (frames, 3), the camera's centre in the world, metres; NaN if unknown.
        orientation_wxyz: (frames, 4), unit quaternions from camera to world, with camera axes x right, y down, z
            forward; NaN if unknown.
    """

    video: VideoInfo
    K: Float[np.ndarray, "3 3"] | None
    position_m: Float[np.ndarray, "frames 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]


@dataclass(frozen=True, repr=False)
class Recording:
    """Synchronised videos of calibrated cameras that stand still.

    A recording that was just read may be inconsistent: a camera may have no video, and videos may differ in length.
    `usable` checks the consistency; its messages say how to leave a camera or frames out.

    Attributes:
        name: name of the recording.
        folder: folder of the recording.
        rig: all calibrated cameras.
        videos: videos by camera name; a camera without video is absent.
        truth: the reference at the video's frames, or None.
        detections: files of 2D detections by camera name, or None.
        onboard: videos of cameras on drones by the drones' names, or None.
    """

    name: str
    folder: Path
    rig: Rig
    videos: Mapping[str, VideoInfo]
    truth: Trajectories | None = None
    detections: Mapping[str, Path] | None = None
    onboard: Mapping[str, OnboardVideo] | None = None

    __repr__ = short_repr

    @property
    def fps(self) -> float:
        """Frames per second of the first video."""
        return self._first.fps

    @property
    def num_frames(self) -> int:
        """Number of frames of the shortest video."""
        return min((video.num_frames for video in self.videos.values()), default=0)

    @property
    def _first(self) -> VideoInfo:
        if not self.videos:
            raise InputError(self.folder, expected="at least one video", found="none")
        return next(iter(self.videos.values()))

    def usable(self, cameras: Sequence[str] | None = None, num_frames: int | None = None) -> Recording:
        """This recording with the chosen cameras and frames only, checked to be consistent.

        Args:
            cameras: names of the cameras to keep; None: all.
            num_frames: number of frames to keep from the start; None: all.

        Raises:
            InputError: a camera has no video; the videos differ in image size, rate or length; or an image size
                differs from the calibration.
            SettingsError: a camera is unknown, or a video has fewer than `num_frames` frames.
        """
        rig = self.rig if cameras is None else self.rig.select(cameras)
        self._check_videos_exist(rig)
        videos = {name: self.videos[name] for name in rig.names}
        for name, video in videos.items():
            calibrated_wh = rig.cameras.image_size_wh[rig.names.index(name)]
            expected = _size_text((int(calibrated_wh[0]), int(calibrated_wh[1])))
            _check_equal(video, "calibrated", expected, _video_size(video))
        _check_consistent(videos, _video_size, remedy="leave it out with --cameras")
        _check_consistent(videos, _video_rate, remedy="leave it out with --cameras")
        shortest = min(video.num_frames for video in videos.values())
        if num_frames is None:
            remedy = f"pass --frames {shortest} to use the frames that all videos have"
            _check_consistent(videos, _video_length, remedy=remedy)
            return replace(self, rig=rig, videos=videos)
        if not 0 < num_frames <= shortest:
            raise SettingsError(
                "frames", expected=f"1 to {shortest}, the frames that all cameras have", found=f"{num_frames}"
            )
        cut = {name: replace(video, num_frames=num_frames) for name, video in videos.items()}
        return replace(self, rig=rig, videos=cut)

    def _check_videos_exist(self, rig: Rig) -> None:
        without = [name for name in rig.names if name not in self.videos]
        if without:
            rest = ",".join(name for name in rig.names if name in self.videos)
            raise InputError(
                self.folder,
                expected=f"a video for each of the cameras {', '.join(rig.names)}",
                found=f"none for {', '.join(without)}",
                remedy=f"pass --cameras {rest} to leave these out" if rest else "",
            )


def _check_equal(video: VideoInfo, standard: str, expected: str, found: str, remedy: str = "") -> None:
    if found != expected:
        raise InputError(video.path, expected=f"{expected} as {standard}", found=found, remedy=remedy)


def _check_consistent(
    videos: Mapping[str, VideoInfo], aspect: Callable[[VideoInfo], str], remedy: str
) -> None:
    """Raise `InputError` for the first video that differs from most videos in one aspect."""
    usual = Counter(map(aspect, videos.values())).most_common(1)[0][0]
    model = next(video for video in videos.values() if aspect(video) == usual)
    for video in videos.values():
        _check_equal(video, f"in {model.path.name}", usual, aspect(video), remedy)


def _size_text(image_size_wh: tuple[int, int]) -> str:
    return f"{image_size_wh[0]} x {image_size_wh[1]} pixels"


def _video_size(video: VideoInfo) -> str:
    return _size_text(video.image_size_wh)


def _video_rate(video: VideoInfo) -> str:
    # Three decimals distinguish 29.97 from 30, and every container stores at least three.
    return f"{video.fps:.3f} frames per second"


def _video_length(video: VideoInfo) -> str:
    return f"{video.num_frames} frames"
