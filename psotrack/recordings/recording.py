"""`Recording`: one recording with its videos, calibrated cameras and, if known, its reference."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError, check_positive, errors_name
from psotrack.geometry import Rig, chosen_cameras
from psotrack.recordings.detections import read_detections
from psotrack.recordings.stored_silhouettes import StoredSilhouettes
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


@dataclass(frozen=True, repr=False)
class Recording:
    """Videos of, or detections in, cameras that stand still, whose frames meet on one clock.

    A recording that was just read may be inconsistent: a camera may have nothing that shows the drones, or images of
    another size than it was calibrated with. `usable` checks the consistency; its messages say what to do.

    Attributes:
        name: name of the recording.
        folder: folder of the recording.
        rig: all cameras that are calibrated and placed.
        videos: videos by camera name; a camera without video is absent.
        truth: the reference at the recording's instants, or None.
        detections: files of 2D detections by camera name, or None.
        onboard: videos of cameras on drones by the drones' names, or None.
        frame_times: times of the frames by camera name; a camera with a video that is absent here begins at time 0
            and has the video's rate.
        unplaced: cameras of the recording that are not in the rig, because their lens or their place is not known.
        streams: addresses of streams and numbers of devices by camera name; such a camera has no video.
        silhouettes: stored silhouettes by camera name. They take the place of a video; for a camera that has a video,
            they save the time of making the same silhouettes again.
        ignore: images by camera name, white where nothing counts as foreground.
        line_time_s: times from the exposure of one row to that of the next row by camera name, seconds; a camera that
            is absent has a global shutter.
        bounds_m: lowest and highest x, y and z of the space in which drones are looked for, metres:
            (x0, x1, y0, y1, z0, z1); None where it is not known.
        marker_corners: table of the markers' corners, or None.
        reference_files: files of the reference; empty where it is not known from which files it comes.
        bodies: labels of the markers of each drone in the C3D file of the reference, as the user says; empty where the
            labels say it themselves.
        reference_offset_s: time on the recording's clock at which the reference's clock shows 0, seconds.
        rate_hz: instants per second; None is the rate of the fastest camera.
        num_instants: largest number of instants; None: until no camera has a frame.
    """

    name: str
    folder: Path
    rig: Rig
    videos: Mapping[str, VideoInfo]
    truth: Trajectories | None = None
    detections: Mapping[str, Path] | None = None
    onboard: Mapping[str, OnboardVideo] | None = None
    frame_times: Mapping[str, FrameTimes] = field(default_factory=dict)
    unplaced: tuple[str, ...] = ()
    streams: Mapping[str, str] = field(default_factory=dict)
    silhouettes: Mapping[str, StoredSilhouettes] = field(default_factory=dict)
    ignore: Mapping[str, Path] = field(default_factory=dict)
    line_time_s: Mapping[str, float] = field(default_factory=dict)
    bounds_m: tuple[float, float, float, float, float, float] | None = None
    marker_corners: Path | None = None
    reference_files: tuple[Path, ...] = ()
    bodies: Mapping[str, Sequence[str]] = field(default_factory=dict)
    reference_offset_s: float = 0.0
    rate_hz: float | None = None
    num_instants: int | None = None

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
            for name, flown in (self.onboard or {}).items()
        }
        truth, timed = self.truth, bool(self.frame_times)
        return {
            "name": self.name,
            "folder": str(self.folder),
            "cameras": {name: self._described(name) for name in (*self.rig.names, *self.unplaced)},
            "onboard": onboard or None,
            "drones": list(truth.drones) if truth else None,
            "frames_with_truth": int(np.count_nonzero(truth.seen.any(axis=1))) if truth else None,
            "rate_hz": self.fps if timed else None,
            "instants": self.num_frames if timed else 0,
            "bounds_m": None if self.bounds_m is None else list(self.bounds_m),
            "reference_files": [str(path) for path in self.reference_files],
            "marker_corners": None if self.marker_corners is None else str(self.marker_corners),
        }

    def _described(self, name: str) -> dict[str, Any]:
        """What there is of a camera, as plain data."""
        video, times = self.videos.get(name), self.frame_times.get(name)
        detections = (self.detections or {}).get(name)
        ignore, silhouettes = self.ignore.get(name), self.silhouettes.get(name)
        described: dict[str, Any] = {
            "video": str(video.path) if video else self.streams.get(name),
            "silhouettes": None if silhouettes is None else str(silhouettes.path),
            "frames": times.num_frames if times else None,
            "fps": times.fps if times else None,
            "begins_s": float(times.time_s[0]) if times and times.num_frames else None,
            "image_size_wh": list(video.image_size_wh) if video else None,
            "focal_length_px": None,
            "centre_m": None,
            "placed": name in self.rig.names,
            "detections": len(read_detections(detections)) if detections else None,
            "ignore": None if ignore is None else str(ignore),
        }
        if described["placed"]:
            cam = self.rig.cameras[self.rig.names.index(name)]
            described["image_size_wh"] = [int(side) for side in cam.image_size_wh]
            described["focal_length_px"] = float(cam.K[0, 0])
            described["centre_m"] = [round(float(value), 4) for value in cam.centre_world]
        return described

    def __post_init__(self) -> None:
        times = {name: self._frame_times_of(name, video) for name, video in self.videos.items()}
        object.__setattr__(self, "frame_times", {**self.frame_times, **times})

    def _frame_times_of(self, name: str, video: VideoInfo) -> FrameTimes:
        """Times of as many frames as a video has."""
        times = self.frame_times.get(name, FrameTimes(video.num_frames, video.fps))
        if times.listed_s is None or video.num_frames < times.num_frames:
            return replace(times.cut(video.num_frames), num_frames=video.num_frames)
        return times

    @property
    def fps(self) -> float:
        """Instants per second: `rate_hz`, or frames per second of the fastest camera."""
        if self._has_frames:
            return self._timeline.rate_hz
        return self.rate_hz or max(each.fps for each in self._times.values())

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
        count = self.num_instants
        if count is not None:
            count = max(1, round(count * rate_hz / self.fps))
        return replace(self, rate_hz=rate_hz, num_instants=count)

    @cached_property
    def _timeline(self) -> Timeline:
        with errors_name(self.folder):
            timeline = make_timeline(self._times, self.rate_hz)
        line_time_s = np.array([self.line_time_s.get(name, 0.0) for name in timeline.cameras])
        if line_time_s.any():
            timeline = replace(timeline, line_time_s=line_time_s)
        return timeline if self.num_instants is None else timeline.part(slice(self.num_instants))

    @property
    def exposed(self) -> Mapping[str, FrameTimes]:
        """Times of the frames of the rig's cameras by name; those of the middle row where the shutter rolls."""
        return self._times

    @property
    def _has_frames(self) -> bool:
        return any(name in self.frame_times and self.frame_times[name].num_frames for name in self._timed)

    @property
    def _timed(self) -> tuple[str, ...]:
        """Names of the rig's cameras; of all cameras where none is placed."""
        return self.rig.names or tuple(self.frame_times)

    @property
    def _times(self) -> dict[str, FrameTimes]:
        """Times of the frames of these cameras; a camera that shows nothing has no frames."""
        known = [self.frame_times[name] for name in self._timed if name in self.frame_times]
        if not known:
            raise InputError(self.folder, expected="at least one video", found="none")
        none = replace(known[0], num_frames=0, listed_s=None)
        times = {name: self.frame_times.get(name, none) for name in self._timed}
        # The frame of a rolling shutter has the time of its middle row.
        return {name: each.corrected(self._readout_s(name) / 2) for name, each in times.items()}

    def _readout_s(self, name: str) -> float:
        """Time from the exposure of a camera's first row to that of its last row, seconds."""
        line_time_s = self.line_time_s.get(name, 0.0)
        if not line_time_s or name not in self.rig.names:
            return 0.0
        return line_time_s * float(self.rig.cameras.image_size_wh[self.rig.names.index(name), 1])

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
        names = self._usable_names(cameras, videos, silhouettes)
        rig = self.rig.select(names)
        for name in names:
            if name in self.videos:
                _check_size(self.videos[name], rig, name)
        kept = replace(
            self,
            rig=rig,
            videos={name: self.videos[name] for name in names if name in self.videos},
            silhouettes={name: self.silhouettes[name] for name in names if name in self.silhouettes},
            frame_times={name: self.frame_times[name] for name in names if name in self.frame_times},
            detections=None
            if self.detections is None
            else {name: path for name, path in self.detections.items() if name in names},
        )
        return kept if num_frames is None else kept._first(num_frames)

    def with_detections(self, files: Mapping[str, Path]) -> Recording:
        """This recording with other files of detections; cameras without video last as long as their detections.

        Raises:
            InputError: a file cannot be read.
        """
        times = dict(self.frame_times)
        for name, path in files.items():
            known = times.get(name)
            if name in self.videos or name in self.silhouettes:
                continue
            if known is not None and known.listed_s is None:
                times[name] = replace(known, num_frames=_frames_of(path))
        return replace(self, detections=dict(files), frame_times=times)

    def check_detections(self, files: Mapping[str, Path]) -> None:
        """Warn of detections in frames that a camera does not have: nothing belongs to them.

        The recording must not be limited to its first instants: cameras have more frames than such a recording.

        Args:
            files: files of detections by camera name.

        Raises:
            InputError: a file cannot be read, or none of a camera's detections is in a frame that the camera has.
        """
        for name, path in files.items():
            known = self.frame_times.get(name)
            frame = read_detections(path).frame
            if known is None or not len(frame) or frame[-1] < known.num_frames:
                continue
            last = known.num_frames - 1
            beyond = int(np.count_nonzero(frame > last))
            shown = self.videos[name].path.name if name in self.videos else "its frames"
            if beyond == len(frame):
                raise InputError(
                    path,
                    expected=f"detections in the frames 0 to {last} of camera {name} ({shown})",
                    found=f"none before frame {int(frame[0])}",
                    remedy="are they detections in another video?",
                )
            _logger.warning(
                "%s: %d of %d detections are not used, because camera %s (%s) ends with frame %d; are they detections "
                "in another video, or is the first frame counted as 1?",
                path, beyond, len(frame), name, shown, last,
            )  # fmt: skip

    def _usable_names(
        self, cameras: Sequence[str] | None, videos: bool, silhouettes: bool
    ) -> tuple[str, ...]:
        """Names of the cameras that are to be used; the others are left out with a warning each."""
        names = (*self.rig.names, *self.unplaced) if cameras is None else self._chosen(cameras)
        self._check_files(names)
        faults = {name: self._fault(name, videos, silhouettes) for name in names}
        without = {name: fault for name, fault in faults.items() if fault}
        if len(without) == len(names) or (without and cameras is not None):
            raise self._nothing_usable(names, tuple(without), videos)
        for name, fault in without.items():
            _logger.warning("camera %s is left out: it has no %s", name, fault)
        return tuple(name for name in names if name not in without)

    def _chosen(self, cameras: Sequence[str]) -> tuple[str, ...]:
        """Full names of cameras that a user names, whether they are placed or not."""
        known = (*self.rig.names, *self.unplaced)
        return chosen_cameras([cameras] if isinstance(cameras, str) else cameras, known)

    def _fault(self, name: str, videos: bool, silhouettes: bool) -> str:
        """What a camera lacks, in words; empty for a camera that can be used."""
        if name in self.unplaced:
            return "place in the world"
        if videos and name not in self.videos and not (silhouettes and name in self.silhouettes):
            return "video"
        return "" if name in self.frame_times else "video and no detections"

    def _check_files(self, names: Sequence[str]) -> None:
        for name in names:
            if name in self.streams:
                raise InputError(
                    f"{self.folder}, camera {name}",
                    expected="a video file",
                    found=f"the stream {self.streams[name]}",
                    remedy="record it first: this command works on files",
                )

    def _nothing_usable(self, names: Sequence[str], without: Sequence[str], videos: bool) -> InputError:
        wanted = "a video" if videos else "a video, or detections,"
        if set(names) <= set(self.unplaced):
            return InputError(
                self.folder,
                expected="cameras whose lens and place are known",
                found=f"none for {', '.join(names)}",
                remedy="make a calibration with `psotrack calibrate rig`",
            )
        return InputError(
            self.folder,
            expected=f"{wanted} for each of the cameras {', '.join(names)}",
            found=f"none for {', '.join(without)}",
            remedy="stored silhouettes do not show the images" if self.silhouettes.keys() & without else "",
        )

    def _first(self, num_frames: int) -> Recording:
        """The first instants only; a camera that begins later is left out."""
        timeline = self.timeline()
        if not 0 < num_frames <= timeline.num_instants:
            expected = f"1 to {timeline.num_instants}, the frames of the recording"
            raise SettingsError("frames", expected=expected, found=f"{num_frames}")
        last = timeline.frame[:num_frames].max(axis=0)
        counts = dict(zip(timeline.cameras, (last + 1).tolist(), strict=True))
        late = [name for name in self.rig.names if not counts[name]]
        for name in late:
            _logger.warning("camera %s is left out: it has no frame before instant %d", name, num_frames)
        rig = self.rig.select([name for name in self.rig.names if name not in late]) if late else self.rig
        return replace(
            self,
            rig=rig,
            videos={
                name: replace(video, num_frames=counts[name])
                for name, video in self.videos.items()
                if name in rig.names
            },
            silhouettes={
                name: replace(stored, num_frames=min(counts[name], stored.num_frames))
                for name, stored in self.silhouettes.items()
                if name in rig.names
            },
            frame_times={name: self.frame_times[name].cut(counts[name]) for name in rig.names},
            # Without its fastest camera the recording would have other instants.
            rate_hz=timeline.rate_hz if late else self.rate_hz,
            # A camera's last frame may be near later instants, too.
            num_instants=num_frames,
        )


def _frames_of(path: Path) -> int:
    """Number of frames up to the last detection of a file."""
    return int(read_detections(path).frame.max(initial=-1)) + 1


def _check_size(video: VideoInfo, rig: Rig, name: str) -> None:
    """Raise `InputError` where the images have another size than the camera was calibrated with."""
    width, height = (int(side) for side in rig.cameras.image_size_wh[rig.names.index(name)])
    found_w, found_h = video.image_size_wh
    if (width, height) == (found_w, found_h):
        return
    remedy = "is it the video of another camera?"
    if width * found_h == height * found_w:
        factor = f"{found_w // gcd(found_w, width)}/{width // gcd(found_w, width)}"
        remedy = f"if both show the same field of view, multiply the first two rows of K by {factor}"
    raise InputError(
        video.path,
        expected=f"{width} x {height} pixels as calibrated",
        found=f"{found_w} x {found_h} pixels",
        remedy=remedy,
    )
