"""`CameraRecording`: what a recording has of one camera."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from psotrack.errors import InputError
from psotrack.geometry import Camera
from psotrack.recordings.detections import read_detections
from psotrack.recordings.stored_silhouettes import StoredSilhouettes
from psotrack.recordings.timing import FrameTimes
from psotrack.recordings.video import VideoInfo, frame_times
from psotrack.support import short_repr

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class CameraRecording:
    """What there is of one camera that stands still.

    Attributes:
        name: name of the camera.
        camera: its lens and its place; None where one of them is not known.
        video: its video, or None.
        stream: address of its stream, or "device" and the number or path of its device; such a camera has no video.
        times: times of its frames. A camera with a video and without times has those of the video's file;
            a camera of which nothing is known to be in time has none.
        line_time_s: time from the exposure of one row to that of the next row, seconds; 0 of a global shutter.
        detections: file of its 2D detections, or None.
        silhouettes: its stored silhouettes, or None. They take the place of a video; for a camera that has a video,
            they save the time of making the same silhouettes again.
        ignore: image that is white where nothing counts as foreground, or None.
    """

    name: str
    camera: Camera | None = None
    video: VideoInfo | None = None
    stream: str | None = None
    times: FrameTimes | None = None
    line_time_s: float = 0.0
    detections: Path | None = None
    silhouettes: StoredSilhouettes | None = None
    ignore: Path | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.video is None:
            return
        count = self.video.num_frames
        times = frame_times(self.video) if self.times is None else self.times
        if times.listed_s is None or count < times.num_frames:
            times = replace(times.cut(count), num_frames=count)
        object.__setattr__(self, "times", times)

    @property
    def exposed(self) -> FrameTimes | None:
        """Times of the frames; of the middle row where the shutter of a placed camera rolls."""
        if self.times is None or self.camera is None or not self.line_time_s:
            return self.times
        return self.times.corrected(self.line_time_s * float(self.camera.image_size_wh[1]) / 2)

    def first(self, num_frames: int) -> CameraRecording:
        """The first frames only."""
        video, stored, times = self.video, self.silhouettes, self.times
        video = video and replace(video, num_frames=num_frames)
        stored = stored and replace(stored, num_frames=min(num_frames, stored.num_frames))
        return replace(self, video=video, silhouettes=stored, times=times and times.cut(num_frames))

    def with_detections(self, path: Path | None) -> CameraRecording:
        """The same with another file of detections; a camera that shows nothing else lasts until the last of them.

        Raises:
            InputError: the file cannot be read.
        """
        times, shows = self.times, self.video is not None or self.silhouettes is not None
        if path is not None and not shows and times is not None and times.listed_s is None:
            last = int(read_detections(path).frame.max(initial=-1))
            times = replace(times, num_frames=last + 1)
        return replace(self, detections=path, times=times)

    def lacks(self, *, videos: bool, silhouettes: bool) -> str:
        """What the camera lacks to be used, in words; empty where it lacks nothing.

        Args:
            videos: whether it needs a video; if not, detections are enough.
            silhouettes: whether stored silhouettes are as good as a video.
        """
        if self.camera is None:
            return "place in the world"
        if videos and self.video is None and not (silhouettes and self.silhouettes):
            return "video"
        return "video and no detections" if self.times is None else ""

    def check_size(self) -> None:
        """Raise `InputError` where the images have another size than the camera was calibrated with."""
        if self.video is None or self.camera is None:
            return
        width, height = self.camera.image_size_wh.astype(int).tolist()
        found_w, found_h = self.video.image_size_wh
        if (width, height) == (found_w, found_h):
            return
        remedy = (
            "is it the video of another camera? If both show the same field of view, `psotrack calibrate convert` "
            f"rescales the rig file with --size {found_w},{found_h}"
        )
        raise InputError(
            self.video.path,
            expected=f"{width} x {height} pixels as calibrated",
            found=f"{found_w} x {found_h} pixels",
            remedy=remedy,
        )

    def check_detections(self, path: Path) -> None:
        """Warn of detections in frames that the camera does not have: nothing belongs to them.

        Args:
            path: file of detections in the camera's frames, all of which must be there.

        Raises:
            InputError: the file cannot be read, or none of the detections is in a frame that the camera has.
        """
        frame = read_detections(path).frame
        if self.times is None or not len(frame) or frame[-1] < self.times.num_frames:
            return
        last = self.times.num_frames - 1
        beyond = int(np.count_nonzero(frame > last))
        shown = "its frames" if self.video is None else self.video.path.name
        if beyond == len(frame):
            raise InputError(
                path,
                expected=f"detections in the frames 0 to {last} of camera {self.name} ({shown})",
                found=f"none before frame {int(frame[0])}",
                remedy="are they detections in another video?",
            )
        _logger.warning(
            "%s: %d of %d detections are not used, because camera %s (%s) ends with frame %d; are they detections "
            "in another video, or is the first frame counted as 1?",
            path, beyond, len(frame), self.name, shown, last,
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """What there is of the camera, as plain data; detections are read.

        Raises:
            InputError: the detections cannot be read.
        """
        video, times, camera = self.video, self.times, self.camera
        content: dict[str, Any] = {
            "video": self.stream if video is None else str(video.path),
            "silhouettes": None if self.silhouettes is None else str(self.silhouettes.path),
            "frames": None if times is None else times.num_frames,
            "fps": None if times is None else times.fps,
            "begins_s": float(times.time_s[0]) if times and times.num_frames else None,
            "image_size_wh": None if video is None else list(video.image_size_wh),
            "focal_length_px": None,
            "centre_m": None,
            "placed": camera is not None,
            "detections": None if self.detections is None else len(read_detections(self.detections)),
            "ignore": None if self.ignore is None else str(self.ignore),
        }
        if camera is not None:
            content["image_size_wh"] = content["image_size_wh"] or camera.image_size_wh.astype(int).tolist()
            content["focal_length_px"] = float(camera.K[0, 0])
            content["centre_m"] = [round(float(value), 4) for value in camera.centre_world]
        return content
