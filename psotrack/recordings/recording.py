"""`Recording`: one recording with its cameras and, if known, its reference."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError, check_positive, errors_name
from psotrack.geometry import Camera, Rig, chosen_cameras, make_camera, make_rig
from psotrack.recordings.camera_recording import CameraRecording
from psotrack.recordings.timing import FrameTimes, Timeline, make_timeline
from psotrack.recordings.video import VideoInfo
from psotrack.support import short_repr
from psotrack.trajectories import Trajectories

_logger = logging.getLogger(__name__)


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


@dataclass(frozen=True)
class Reference:
    """What is known of the drones' true positions.

    Attributes:
        truth: the positions at the recording's instants.
        own: the positions as they were recorded, at their own rate, on the recording's clock; None where they were
            recorded at the instants.
        files: the files that it was read from.
        bodies: labels of the markers of each drone in the C3D file, as the user says; empty where the labels say it
            themselves.
        offset_s: time on the recording's clock at which the files' clock shows 0, seconds.
    """

    truth: Trajectories
    own: Trajectories | None = None
    files: tuple[Path, ...] = ()
    bodies: Mapping[str, Sequence[str]] = field(default_factory=dict)
    offset_s: float = 0.0


@dataclass(frozen=True)
class Timing:
    """The instants of a recording that differ from those of its cameras' frames.

    Attributes:
        rate_hz: instants per second; None is the rate of the fastest camera.
        num_instants: largest number of instants; None: until no camera has a frame.
    """

    rate_hz: float | None = None
    num_instants: int | None = None


@dataclass(frozen=True, repr=False)
class Recording:
    """What several cameras that stand still show at one time, on one clock.

    A recording that was just read may be inconsistent: a camera may have nothing that shows the drones, or images of
    another size than it was calibrated with. `usable` checks the consistency; its messages say what to do.

    Attributes:
        name: name of the recording.
        folder: folder of the recording.
        cameras: what there is of each camera.
        reference: what is known of the drones' true positions, or None.
        timing: the instants, where they are not those of the frames.
        bounds_m: lowest and highest x, y and z of the space in which drones are looked for, metres:
            (x0, x1, y0, y1, z0, z1); None where it is not known.
        marker_corners: table of the markers' corners, or None.
        onboard: videos of cameras on drones by the drones' names.
    """

    name: str
    folder: Path
    cameras: tuple[CameraRecording, ...]
    reference: Reference | None = None
    timing: Timing = Timing()
    bounds_m: tuple[float, float, float, float, float, float] | None = None
    marker_corners: Path | None = None
    onboard: Mapping[str, OnboardVideo] = field(default_factory=dict)

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of `psotrack init --show`."""
        from psotrack.recordings.inventory import inventory_html

        return inventory_html(self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Cameras, videos, detections and reference as plain data: `psotrack init --show --json`; detections are read.

        Raises:
            InputError: a file of detections cannot be read.
        """
        onboard = {
            name: {
                "video": str(flown.video.path),
                "frames": flown.video.num_frames,
                "fps": flown.video.fps,
                "image_size_wh": list(flown.video.image_size_wh),
                "focal_length_px": None if flown.K is None else float(flown.K[0, 0]),
                "frames_with_pose": int(np.isfinite(flown.orientation_wxyz).all(axis=1).sum()),
            }
            for name, flown in self.onboard.items()
        }
        truth, timed = self.truth, any(each.times is not None for each in self._timed)
        files = () if self.reference is None else self.reference.files
        return {
            "name": self.name,
            "folder": str(self.folder),
            "cameras": {each.name: each.to_dict() for each in self.cameras},
            "onboard": onboard or None,
            "drones": list(truth.drones) if truth else None,
            "frames_with_truth": int(np.count_nonzero(truth.seen.any(axis=1))) if truth else None,
            "rate_hz": self.fps if timed else None,
            "instants": self.num_frames if timed else 0,
            "bounds_m": None if self.bounds_m is None else list(self.bounds_m),
            "reference_files": [str(path) for path in files],
            "marker_corners": None if self.marker_corners is None else str(self.marker_corners),
        }

    @cached_property
    def by_name(self) -> Mapping[str, CameraRecording]:
        """What there is of each camera, by its name."""
        return {each.name: each for each in self.cameras}

    @cached_property
    def placed(self) -> tuple[CameraRecording, ...]:
        """The cameras whose lens and place are known."""
        return tuple(each for each in self.cameras if each.camera is not None)

    @property
    def is_placed(self) -> bool:
        """Whether lens and place of every camera are known."""
        return len(self.placed) == len(self.cameras)

    @cached_property
    def rig(self) -> Rig:
        """Lenses and places of the cameras for which both are known."""
        known = {each.name: each.camera for each in self.cameras if each.camera is not None}
        return make_rig(known) if known else _NO_RIG

    @cached_property
    def videos(self) -> Mapping[str, VideoInfo]:
        """Videos by camera name; a camera without video is absent."""
        return {each.name: each.video for each in self.cameras if each.video is not None}

    @cached_property
    def detections(self) -> Mapping[str, Path]:
        """Files of 2D detections by camera name; a camera without detections is absent."""
        return {each.name: each.detections for each in self.cameras if each.detections is not None}

    @property
    def truth(self) -> Trajectories | None:
        """The reference at the recording's instants, or None."""
        return None if self.reference is None else self.reference.truth

    @property
    def fps(self) -> float:
        """Instants per second: the rate of `timing`, or frames per second of the fastest camera."""
        if self._has_frames:
            return self._timeline.rate_hz
        return self.timing.rate_hz or max(each.fps for each in self.exposed.values())

    @property
    def num_frames(self) -> int:
        """Number of instants; 0 where no camera has a frame."""
        return self._timeline.num_instants if self._has_frames else 0

    def timeline(self, rate_hz: float | None = None) -> Timeline:
        """The instants of this recording, and the frame that each camera of the rig shows at each of them.

        Args:
            rate_hz: instants per second; None is the recording's own rate.

        Raises:
            InputError: no camera has a frame at time 0 or later.
            SettingsError: the rate is not above 0.
        """
        return self._timeline if rate_hz is None else self.at_rate(rate_hz).timeline()

    def at_rate(self, rate_hz: float | None) -> Recording:
        """This recording with another number of instants per second and the same end; None keeps its own rate.

        Raises:
            SettingsError: the rate is not above 0.
        """
        if rate_hz is None:
            return self
        check_positive("rate", rate_hz)
        count = self.timing.num_instants
        if count is not None:
            count = max(1, round(count * rate_hz / self.fps))
        return replace(self, timing=Timing(rate_hz, count))

    @cached_property
    def _timeline(self) -> Timeline:
        with errors_name(self.folder):
            timeline = make_timeline(self.exposed, self.timing.rate_hz)
        line_time_s = np.array([self.by_name[name].line_time_s for name in timeline.cameras])
        if line_time_s.any():
            timeline = replace(timeline, line_time_s=line_time_s)
        count = self.timing.num_instants
        return timeline if count is None else timeline.part(slice(count))

    @property
    def exposed(self) -> Mapping[str, FrameTimes]:
        """Times of the frames of the placed cameras by name, of all cameras where none is placed.

        They are those of the middle row where the shutter rolls. A camera that shows nothing has no frames.
        """
        times = {each.name: each.exposed for each in self._timed}
        known = [each for each in times.values() if each is not None]
        if not known:
            raise InputError(self.folder, expected="at least one video", found="none")
        none = replace(known[0], num_frames=0, listed_s=None)
        return {name: none if each is None else each for name, each in times.items()}

    @property
    def _has_frames(self) -> bool:
        return any(each.times is not None and each.times.num_frames for each in self._timed)

    @property
    def _timed(self) -> tuple[CameraRecording, ...]:
        """The placed cameras; all cameras with times where none is placed."""
        return self.placed or tuple(each for each in self.cameras if each.times is not None)

    def with_rig(self, rig: Rig) -> Recording:
        """This recording with other lenses and places of the cameras that a rig has."""
        return self.with_cameras({name: rig.cameras[index] for index, name in enumerate(rig.names)})

    def with_cameras(self, known: Mapping[str, Camera]) -> Recording:
        """This recording with other lenses and places of some cameras, by their names."""
        cameras = (replace(each, camera=known.get(each.name, each.camera)) for each in self.cameras)
        return replace(self, cameras=tuple(cameras))

    def usable(
        self,
        cameras: Sequence[str] | None = None,
        num_frames: int | None = None,
        *,
        videos: bool = True,
        silhouettes: bool = False,
    ) -> Recording:
        """This recording with the chosen cameras and frames only, checked to be consistent.

        A camera that cannot be used is left out with a warning, unless it is chosen by name.

        Args:
            cameras: names of the cameras to keep; None: all that can be used.
            num_frames: number of instants to keep from the start; None: all.
            videos: whether a camera needs a video; if not, detections are enough.
            silhouettes: whether stored silhouettes are as good as a video.

        Raises:
            InputError: no camera can be used, a chosen camera cannot be used, or an image size differs from the
                calibration.
            SettingsError: a camera is unknown, or the recording has fewer than `num_frames` instants.
        """
        asked = self.cameras if cameras is None else self._chosen(cameras)
        for each in asked:
            if each.stream is not None:
                raise InputError(
                    f"{self.folder}, camera {each.name}",
                    expected="a video file",
                    found=f"the stream {each.stream}",
                    remedy="record it first: this command works on files",
                )
        faults = {each.name: each.lacks(videos=videos, silhouettes=silhouettes) for each in asked}
        without = [each for each in asked if faults[each.name]]
        if len(without) == len(asked) or (without and cameras is not None):
            raise self._nothing_usable(asked, without, videos)
        for each in without:
            _logger.warning("camera %s is left out: it has no %s", each.name, faults[each.name])
        kept = tuple(each for each in asked if not faults[each.name])
        for each in kept:
            each.check_size()
        recording = replace(self, cameras=kept)
        return recording if num_frames is None else recording._first(num_frames)

    def with_detections(self, files: Mapping[str, Path]) -> Recording:
        """This recording with other files of detections; cameras without video last as long as their detections.

        Raises:
            InputError: a file cannot be read.
        """
        cameras = (each.with_detections(files.get(each.name)) for each in self.cameras)
        return replace(self, cameras=tuple(cameras))

    def check_detections(self, files: Mapping[str, Path]) -> None:
        """Warn of detections in frames that a camera does not have: nothing belongs to them.

        The recording must not be limited to its first instants: cameras have more frames than such a recording.

        Args:
            files: files of detections by camera name.

        Raises:
            InputError: a file cannot be read, or none of a camera's detections is in a frame that the camera has.
        """
        for name, path in files.items():
            self.by_name[name].check_detections(path)

    def _chosen(self, cameras: Sequence[str]) -> tuple[CameraRecording, ...]:
        """Cameras that a user names, whether they are placed or not."""
        names = chosen_cameras([cameras] if isinstance(cameras, str) else cameras, tuple(self.by_name))
        return tuple(self.by_name[name] for name in names)

    def _nothing_usable(
        self, asked: Sequence[CameraRecording], without: Sequence[CameraRecording], videos: bool
    ) -> InputError:
        names = ", ".join(each.name for each in asked)
        if all(each.camera is None for each in asked):
            return InputError(
                self.folder,
                expected="cameras whose lens and place are known",
                found=f"none for {names}",
                remedy="make a calibration with `psotrack calibrate rig`",
            )
        remedy = ""
        if any(each.silhouettes for each in without):
            remedy = "stored silhouettes do not show the images"
        elif all(each.detections for each in without):
            remedy = "`psotrack track --method projection-lines` needs detections only"
        return InputError(
            self.folder,
            expected=f"{'a video' if videos else 'a video, or detections,'} for each of the cameras {names}",
            found=f"none for {', '.join(each.name for each in without)}",
            remedy=remedy,
        )

    def _first(self, num_frames: int) -> Recording:
        """The first instants only; a camera that begins later is left out."""
        timeline = self.timeline()
        if not 0 < num_frames <= timeline.num_instants:
            expected = f"1 to {timeline.num_instants}, the frames of the recording"
            raise SettingsError("frames", expected=expected, found=f"{num_frames}")
        counts = (timeline.frame[:num_frames].max(axis=0) + 1).tolist()
        kept = []
        for each, count in zip(self.cameras, counts, strict=True):
            if count:
                kept.append(each.first(count))
            else:
                _logger.warning(
                    "camera %s is left out: it has no frame before instant %d", each.name, num_frames
                )
        if not kept:
            raise SettingsError(
                "frames",
                expected="instants in which a camera has a frame",
                found=f"none of the first {num_frames}",
            )
        late = len(kept) < len(self.cameras)
        # Without its fastest camera the recording would have other instants; and a camera's last frame may be near
        # later instants, too.
        timing = Timing(timeline.rate_hz if late else self.timing.rate_hz, num_frames)
        return replace(self, cameras=tuple(kept), timing=timing)


_NO_RIG = Rig((), Camera(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), np.zeros((0, 0)), np.zeros((0, 2))))


# Recordings of which only the videos matter: silhouettes, blobs and a detector's boxes need no calibration.


def recording_of_video(video: VideoInfo) -> Recording:
    """A recording of one camera with the name of the video's file, without its ending, or of the pictures' folder."""
    path = video.path.resolve()
    name = path.name if video.images else path.stem
    return Recording(name, path.parent, (CameraRecording(name, _stand_in(video), video),))


def with_all_videos(recording: Recording) -> Recording:
    """The recording with a lens and a place for each camera that has a video; never to be used for positions."""
    lacking = {each.name: each.video for each in recording.cameras if each.camera is None and each.video}
    stand_ins = {name: _stand_in(video) for name, video in lacking.items()}
    return recording.with_cameras(stand_ins)


def _stand_in(video: VideoInfo) -> Camera:
    width, height = video.image_size_wh
    K = np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=(width, height))
