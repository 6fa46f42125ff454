"""`Sequence`: what every source of data yields: videos, calibrated cameras, and a reference where there is one."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace
from pathlib import Path

from psotrack.cameras import CameraRig
from psotrack.errors import InputError, SettingsError
from psotrack.trajectories import Trajectories
from psotrack.video import VideoInfo


@dataclass(frozen=True)
class Sequence:
    """Synchronised videos of calibrated cameras that stand still.

    Reading is lenient: a camera may have no video, and videos may differ in length. Using is strict: `usable` says
    what does not fit, and how to leave it out.

    Attributes:
        name: of the recording.
        folder: where it lies.
        rig: all calibrated cameras.
        videos: by camera name; a camera without video is absent.
        truth: the reference at the video's frames, or None.
        detections: files of 2D boxes by camera name.
    """

    name: str
    folder: Path
    rig: CameraRig
    videos: Mapping[str, VideoInfo]
    truth: Trajectories | None = None
    detections: Mapping[str, Path] | None = None

    @property
    def fps(self) -> float:
        """Frames per second of the first video."""
        return self._first.fps

    @property
    def num_frames(self) -> int:
        """Frames that every video has."""
        return min(video.num_frames for video in self.videos.values())

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
            InputError: a camera has no video, or videos differ in length, rate or from their calibration.
            SettingsError: a camera is unknown, or there are not so many frames.
        """
        rig = self.rig if cameras is None else self.rig.select(cameras)
        without = [name for name in rig.names if name not in self.videos]
        if without:
            raise InputError(
                self.folder,
                expected=f"a video for each of the cameras {', '.join(rig.names)}",
                found=f"none for {', '.join(without)}",
                remedy=f"pass --cameras {','.join(n for n in rig.names if n in self.videos)} to go without",
            )
        videos = {name: self.videos[name] for name in rig.names}
        first = next(iter(videos.values()))
        shortest = min(video.num_frames for video in videos.values())
        for name, video in videos.items():
            size_wh = tuple(int(side) for side in rig.cameras[rig.names.index(name)].image_size_wh)
            if video.image_size_wh != size_wh:
                raise InputError(
                    video.path,
                    expected=f"{size_wh[0]} x {size_wh[1]} pixels as calibrated",
                    found=f"{video.image_size_wh[0]} x {video.image_size_wh[1]}",
                )
            if abs(video.fps - first.fps) > 1e-3:
                raise InputError(
                    video.path, expected=f"{first.fps:g} frames per second", found=f"{video.fps:g}"
                )
            if num_frames is None and video.num_frames != first.num_frames:
                raise InputError(
                    video.path,
                    expected=f"{first.num_frames} frames as in {first.path.name}",
                    found=f"{video.num_frames}",
                    remedy=f"pass --frames {shortest} to use those that all cameras have",
                )
        if num_frames is not None and not 0 < num_frames <= shortest:
            raise SettingsError(
                "frames", expected=f"1 to {shortest}, the frames that all cameras have", found=f"{num_frames}"
            )
        if num_frames is not None:
            videos = {name: replace(video, num_frames=num_frames) for name, video in videos.items()}
        return replace(self, rig=rig, videos=videos)
