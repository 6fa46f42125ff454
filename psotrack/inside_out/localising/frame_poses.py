"""Poses of frames whose markers are detected, one after the other: each frame's own pose, and the filter's estimate.

Also the settings and the result of localising a camera in a video.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import Camera
from psotrack.inside_out import filtering
from psotrack.inside_out.camera_path import CameraPath, Flag
from psotrack.inside_out.filtering import Agility, Estimated, FilterRun, MotionEstimate, PoseFilterParams
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import CameraPose, MarkerPose, PoseSettings, estimate_pose
from psotrack.inside_out.rolling_shutter import (
    Detected,
    LineTime,
    PosesAt,
    RollingShutter,
    SeenRows,
)
from psotrack.trajectories import Status

#: Stages that each frame passes; the first two run in a thread of their own.
STAGES = ("decode", "grey", "detect", "locate", "filter")
#: Number of markers that the paper requires. A pose from fewer markers is flagged, even if the settings allow it.
PAPER_MARKERS = 4
#: Probability that another pose is the right one above which a pose is flagged as ambiguous.
_AMBIGUOUS = 0.05
#: Numbers of poses of a stream after which the camera's agility is chosen anew by them, and they are filtered anew.
_CHOICES = (5, 10, 20, 40, 80)
#: Number of times that the motion of a stream and a frame's pose are estimated by turns.
_TURNS = 3
#: Standard deviations of velocity (m/s) and turn rate (rad/s) where nothing is known of the motion.
_UNKNOWN_RATES = np.repeat([5.0, 3.0], 3)


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
        return filtering.smooth(self.raw, params, self.constant)

    @property
    def frames_per_second(self) -> float:
        """Frames per second of wall time."""
        return self.raw.num_frames / max(self.wall_s, 1e-9)


@dataclass(frozen=True)
class MotionAround:
    """Motion of a camera around a frame.

    Attributes:
        poses_at: poses at times, seconds.
        rate_root: (6, 6), root of the covariance of velocity along the world's axes and turn rate about the camera's.
    """

    poses_at: PosesAt
    rate_root: Float[np.ndarray, "6 6"]


@dataclass(frozen=True)
class FollowedFrame:
    """One frame of a camera.

    Attributes:
        number, time_s: number and time of the frame, seconds.
        num_markers: number of detected markers.
        pose: the frame's own pose; None without one.
        estimated: the filter's estimate.
    """

    number: int
    time_s: float
    num_markers: int
    pose: MarkerPose | None
    estimated: Estimated = field(default_factory=Estimated)


@dataclass(frozen=True)
class Localiser:
    """What a camera is localised by in frames whose markers are detected.

    Attributes:
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings; the dictionary is not used.
        seconds: times by stage; the times of "locate" and "filter" are added.
    """

    marker_map: MarkerMap
    lens: Camera
    settings: LocaliseSettings
    seconds: dict[str, float] = field(default_factory=lambda: {"locate": 0.0, "filter": 0.0})

    @property
    def shutter(self) -> RollingShutter:
        """The shutter; a global one where it is not known."""
        return self.settings.shutter or RollingShutter(0.0)

    @property
    def rolls(self) -> bool:
        """Whether the shutter rolls, or may roll."""
        return bool(self.shutter.line_time_s or self.shutter.std_s)

    @property
    def params(self) -> PoseFilterParams:
        """Parameters of the filter; those by default where there is none."""
        return self.settings.filter or PoseFilterParams()

    def with_pose(self, **changes: Any) -> Localiser:
        """The same with other settings of pose estimation."""
        pose = replace(self.settings.pose, **changes)
        return replace(self, settings=replace(self.settings, pose=pose))

    def follow(
        self,
        detected: Iterable[Detected],
        agility: Agility | None,
        around: Callable[[float], MotionAround | None] | None = None,
    ) -> Iterator[FollowedFrame]:
        """Each frame's own pose and the filter's estimate, frame by frame.

        Args:
            detected: number and time (seconds) of each frame, and its markers, which are all in the map.
            agility: how wildly the camera moves; None of a stream, where it is chosen as poses come.
            around: motion around a frame by its time; None takes it from the filter.
        """
        shutter, params, rolls = self.shutter, self.params, self.rolls
        model, run, recent = agility or Agility(), FilterRun(), list[tuple[float, CameraPose]]()
        for number, time_s, markers in detected:
            began_s = time.perf_counter()
            predicted = filtering.expected(run, time_s, params, model).motion
            predicted_s = time.perf_counter()
            corners_m = self.marker_map.corners_of(markers.ids.tolist())
            rows = SeenRows(markers.corners_px, corners_m, self.lens, time_s)
            motion = around(time_s) if around is not None else _constant(predicted, time_s)
            for turn in range(_TURNS if rolls and around is None else 1):
                moved = markers
                if rolls and motion is not None:
                    corners_px = rows.at_middle_row(shutter.line_time_s, motion.poses_at)
                    moved = replace(markers, corners_px=corners_px)
                pose = self._own_pose(moved, corners_m, predicted)
                if rolls and pose is not None:
                    pose = _with_rows(pose, rows, shutter, motion)
                    if turn < _TURNS - 1 and around is None:
                        trial = _stepped(run, time_s, pose, params, model)
                        now = filtering.expected(trial, time_s, params, model)
                        motion = _constant(now.motion, time_s) or motion
            located_s = time.perf_counter()
            run = _stepped(run, time_s, pose, params, model)
            if agility is None and pose is not None and len(recent) < _CHOICES[-1]:
                recent.append((time_s, pose))
                if len(recent) in _CHOICES:
                    times_s, poses = zip(*recent, strict=True)
                    model, run = filtering.choose_agility(times_s, poses, params), FilterRun()
                    for earlier_s, earlier in recent:
                        run = _stepped(run, earlier_s, earlier, params, model)
            self.seconds["locate"] += located_s - predicted_s
            self.seconds["filter"] += time.perf_counter() - located_s + predicted_s - began_s
            yield FollowedFrame(
                number, time_s, len(markers), pose, filtering.expected(run, time_s, params, model)
            )

    def _own_pose(
        self,
        markers: DetectedMarkers,
        corners_m: Float[np.ndarray, "markers 4 3"],
        predicted: MotionEstimate | None,
    ) -> MarkerPose | None:
        """The pose by a frame's markers; the filter's prediction decides between poses that fit about equally well."""
        try:
            return estimate_pose(
                markers.corners_px,
                corners_m,
                self.lens,
                self.settings.pose,
                None if self.settings.filter is None else predicted,
                std_px=markers.std_px,
                map_std_m=self.marker_map.std_of(markers.ids.tolist()),
            )
        except np.linalg.LinAlgError:
            # Corners of a wrong map may determine no pose at all; the frame is lost, the others are not.
            return None


def _stepped(
    run: FilterRun, time_s: float, own: CameraPose | None, params: PoseFilterParams, agility: Agility
) -> FilterRun:
    try:
        return filtering.step(run, time_s, own, params, agility)
    except np.linalg.LinAlgError:
        # Poses by a wrong map may contradict the motion without any doubt: the filter starts anew.
        return FilterRun()


def own_path(frames: Sequence[FollowedFrame], settings: PoseSettings) -> CameraPath:
    """The path of the frames' own poses; without a pose, the number of markers counts the detected markers."""
    poses = [frame.pose for frame in frames]
    there = np.array([pose is not None for pose in poses], bool)
    seen = np.array([frame.num_markers for frame in frames], int)
    num_markers = np.where(there, filtering.filled(poses, "num_markers"), seen).astype(int)
    ambiguity = filtering.filled(poses, "ambiguity")
    few = (num_markers > 0) & (num_markers < max(PAPER_MARKERS, settings.min_markers))
    flags = np.where(few, int(Flag.FEW_MARKERS), 0)
    return CameraPath(
        frame=np.array([frame.number for frame in frames], int),
        time_s=np.array([frame.time_s for frame in frames], float),
        position_m=filtering.filled(poses, "position_m", 3),
        orientation_wxyz=filtering.orientations(poses),
        covariance=filtering.filled(poses, "covariance", 6, 6),
        num_markers=num_markers,
        reprojection_px=filtering.filled(poses, "reprojection_px"),
        ambiguity=ambiguity,
        status=np.where(there, int(Status.TRACKED), int(Status.LOST)),
        flags=flags | np.where(ambiguity > _AMBIGUOUS, int(Flag.AMBIGUOUS), 0),
    )


def _constant(predicted: MotionEstimate | None, time_s: float) -> MotionAround | None:
    """The motion around a frame by an estimate at its time."""
    if predicted is None:
        return None
    return MotionAround(constant_motion(predicted, time_s), np.linalg.cholesky(predicted.rate_covariance))


def constant_motion(predicted: MotionEstimate, time_s: float) -> PosesAt:
    """Poses with the velocity and the turn rate of an estimate at a time, seconds."""

    def poses_at(times: Float[np.ndarray, "times"]) -> tuple[np.ndarray, np.ndarray]:
        late_s = (times - time_s)[:, None]
        turns = Rotation.from_rotvec(late_s * predicted.rate_rad_s).as_matrix()
        return predicted.position_m + late_s * predicted.velocity_m_s, predicted.R_world_cam @ turns

    return poses_at


def _with_rows(
    pose: MarkerPose, rows: SeenRows, shutter: RollingShutter, motion: MotionAround | None
) -> MarkerPose:
    """A pose whose rows show the motion during the frame as well, with covariances by it and by the line time.

    The motion is that around the frame and a change, whose six numbers are unknowns with a prior.
    """
    equations = pose.equations
    if equations is None or len(equations.fits) < len(rows.corners_px):
        return pose
    gain = equations.gain()
    root = np.diag(_UNKNOWN_RATES) if motion is None else motion.rate_root

    def by_rates(line_time_s: float) -> Float[np.ndarray, "markers 8 6"]:
        late_s = np.repeat(rows.late_s(line_time_s), 2, axis=1)[..., None]
        return late_s * equations.slopes[..., :6] @ root

    by_motion = by_rates(shutter.line_time_s)
    squares, products = equations.products(by_motion)
    spread, of_motion = np.linalg.inv(np.eye(6) + squares), gain @ by_motion.reshape(-1, 6)
    change = -of_motion @ spread @ products
    by_line_time = by_rates(shutter.std_s).reshape(-1, 6)
    if motion is not None and shutter.std_s:
        line_times_s = shutter.line_time_s, shutter.line_time_s + shutter.std_s
        shift_px = rows.shift(line_times_s, motion.poses_at)
        by_line_time = np.column_stack([by_line_time, shift_px.ravel()])
    constant = (gain @ by_line_time) @ (gain @ by_line_time).T
    return replace(
        pose,
        position_m=pose.position_m + change[:3],
        R_world_cam=pose.R_world_cam @ Rotation.from_rotvec(change[3:6]).as_matrix(),
        covariance=pose.covariance + of_motion @ spread @ of_motion.T + constant,
        constant=pose.constant + constant,
    )
