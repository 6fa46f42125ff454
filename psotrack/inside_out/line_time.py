"""The line time of a rolling shutter, estimated from the markers in a video.

Rows of one frame show by how far the camera moves from row to row; the poses of neighbouring frames show by how far it
moves per second. The ratio of the two is the line time. A frame's motion per row is fitted with the frame's pose
(`pose.row_motion`), and the motion per second is the derivative of a cubic spline through the poses of consecutive
frames. With the motion per second v, the motion per row u and its covariance V, the estimate is the weighted least
squares solution of u = v x line time over all frames,

    line time = Σ vᵀ V⁻¹ u / Σ vᵀ V⁻¹ v,

and its variance is that of the sums over groups of neighbouring frames, whose errors are alike (Liang & Zeger,
Longitudinal data analysis using generalized linear models, Biometrika 73(1), 1986). Errors of the map and of the lens
do not change sign with the motion, so they hardly bias the estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import Camera
from psotrack.inside_out.filtering.manifold import right_jacobian
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import (
    ExpectedMotion,
    MarkerPose,
    PoseSettings,
    RollingShutter,
    estimate_pose,
)

#: Number and time (seconds) of a frame, and its markers, which are all in the map.
Detected = tuple[int, float, DetectedMarkers]

#: Number of consecutive frames through which a spline is laid, fewest such frames, and largest number of these runs.
_RUN_FRAMES, _FEWEST_FRAMES, _MOST_RUNS = 11, 5, 5
#: Smallest number of markers in a frame of a run. The rows of fewer markers hardly show a motion.
_FEWEST_MARKERS = 3
#: Largest number of times that motion and line time are estimated by turns, and change of the estimate, in standard
#: deviations, below which no further turn is needed.
_TURNS, _SAME = 4, 0.3
#: Standard deviations of the motion by the spline, velocity (m/s) and turn rate (rad/s), as prior of a frame's rows.
_SPLINE_STD = np.full(6, 0.05)
#: Number of neighbouring frames whose errors are alike.
_GROUP_FRAMES = 5
#: Residual of a frame's motion, in standard deviations, from which on its weight falls.
_ROBUST = 3.0
#: Ratio of an estimate to its standard deviation from which on the shutter rolls, and from which on a given line time
#: is contradicted.
_SURE, _CONTRADICTED = 4.0, 5.0
#: Time from the first row to the last, seconds, below which an uncertainty is no matter: at 1 m/s, 0.03 mm.
_NO_MATTER_S = 1e-4
#: Standard deviation of the readout, as a share of the time between two frames, above which nothing is shown.
_SHOWN = 0.1


@dataclass(frozen=True)
class LineTime:
    """A line time that was estimated from a video.

    Attributes:
        line_time_s: time from the exposure of one row to that of the next row, seconds.
        std_s: its standard deviation, seconds.
        frames: number of frames behind the estimate.
        rows: number of rows of the image.
        frame_s: time between two frames, seconds.
    """

    line_time_s: float
    std_s: float
    frames: int
    rows: int
    frame_s: float

    @property
    def readout_s(self) -> float:
        """Time from the exposure of the first row to the end of the frame's rows, seconds."""
        return self.line_time_s * self.rows

    @property
    def readout_std_s(self) -> float:
        """Standard deviation of `readout_s`, seconds."""
        return self.std_s * self.rows

    @property
    def is_shown(self) -> bool:
        """Whether the motion was enough to show the line time."""
        return self.rolls or self.readout_std_s < _SHOWN * self.frame_s

    @property
    def rolls(self) -> bool:
        """Whether the shutter certainly rolls."""
        return abs(self.line_time_s) > _SURE * self.std_s and abs(self.readout_s) > _NO_MATTER_S

    def contradicts(self, line_time_s: float) -> bool:
        """Whether the video contradicts a given line time."""
        off_s = abs(self.line_time_s - line_time_s)
        return off_s > _CONTRADICTED * self.std_s and off_s * self.rows > 5 * _NO_MATTER_S

    def shutter(self, given: RollingShutter | None = None) -> RollingShutter:
        """The shutter with which poses are estimated.

        A given line time is used as it is; where the video contradicts it, its standard deviation is the difference.
        Otherwise the estimate is used, if the shutter certainly rolls, and else 0. The uncertainty
        is then that of the estimate, and at most that of a shutter that takes the time between two frames.
        """
        if given is not None:
            if not self.contradicts(given.line_time_s):
                return given
            return replace(given, std_s=float(np.hypot(self.line_time_s - given.line_time_s, self.std_s)))
        if self.rolls:
            return RollingShutter(self.line_time_s, self.std_s)
        largest_s = self.frame_s / self.rows / np.sqrt(3)
        off_s = float(np.hypot(self.line_time_s, self.std_s))
        std_s = float(1 / np.hypot(1 / off_s, 1 / largest_s)) if off_s else 0.0
        return RollingShutter(0.0, std_s if std_s * self.rows > _NO_MATTER_S else 0.0)


def estimate_line_time(
    detected: Sequence[Detected], marker_map: MarkerMap, lens: Camera, settings: PoseSettings
) -> LineTime | None:
    """Estimate the line time of a camera from the frames in which it moves most.

    Args:
        detected: number and time of each frame, in their order, and its markers.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings of pose estimation.

    Returns:
        The estimate; None without at least five consecutive frames that show enough markers.
    """
    runs = _runs(detected, settings)
    if not runs:
        return None
    frame_s = float(np.median(np.diff([time_s for _, time_s, _ in runs[0]])))
    rows = int(lens.image_size_wh[1])
    # A motion per row is stated as the motion per second that it would be with this line time.
    unit = RollingShutter(frame_s / 2 / rows)
    ratio = 0.0
    motions: list[list[ExpectedMotion | None]] = [[None] * len(run) for run in runs]
    for turn in range(_TURNS):
        followed = [
            _followed(run, expected, marker_map, lens, settings, unit)
            for run, expected in zip(runs, motions, strict=True)
        ]
        found = [one for one in followed if one is not None]
        if not found:
            return None
        before, (ratio, std) = ratio, _ratio(found)
        if turn and abs(ratio - before) < _SAME * std:
            break
        spread = np.diag(_SPLINE_STD**2)
        motions = [
            [None] * len(run) if one is None else [ExpectedMotion(ratio * v, spread) for v in one.all_motions]
            for run, one in zip(runs, followed, strict=True)
        ]
    frames = sum(len(one.motion) for one in found)
    return LineTime(ratio * unit.line_time_s, std * unit.line_time_s, frames, rows, frame_s)


@dataclass(frozen=True)
class _FollowedRun:
    """Motions of a camera in a run of frames.

    Attributes:
        all_motions: (run, 6), motion by the spline at all frames of the run.
        motion: (frames, 6), motion by the spline at frames with a pose that are not at an end of the run.
        rows: (frames, 6), motion by the rows of these frames, in the unit of `estimate_line_time`.
        information: (frames, 6, 6), inverse covariances of `rows`.
    """

    all_motions: Float[np.ndarray, "run 6"]
    motion: Float[np.ndarray, "frames 6"]
    rows: Float[np.ndarray, "frames 6"]
    information: Float[np.ndarray, "frames 6 6"]


def _runs(detected: Sequence[Detected], settings: PoseSettings) -> list[list[Detected]]:
    """Runs of consecutive frames in which the image moves most; runs do not overlap."""
    fewest = max(_FEWEST_MARKERS, settings.min_markers)
    usable = [one for one in detected if len(one[2]) >= fewest]
    if len(usable) < _FEWEST_FRAMES:
        return []
    step = min(b[0] - a[0] for a, b in pairwise(usable))
    runs: list[list[Detected]] = [[]]
    for one in usable:
        if runs[-1] and (one[0] - runs[-1][-1][0] != step or len(runs[-1]) == _RUN_FRAMES):
            runs.append([])
        runs[-1].append(one)
    runs = [run for run in runs if len(run) >= _FEWEST_FRAMES]
    moved = [np.mean([_moved_px2(a[2], b[2]) for a, b in pairwise(run)]) for run in runs]
    most = sorted(np.argsort(moved, kind="stable")[::-1][:_MOST_RUNS].tolist())
    return [runs[index] for index in most]


def _moved_px2(before: DetectedMarkers, after: DetectedMarkers) -> float:
    """Mean squared motion of the markers that both frames show; 0 without such markers."""
    _, first, second = np.intersect1d(before.ids, after.ids, return_indices=True)
    off = after.corners_px[second] - before.corners_px[first]
    return float((off**2).sum(axis=-1).mean()) if len(first) else 0.0


def _followed(
    run: Sequence[Detected],
    expected: Sequence[ExpectedMotion | None],
    marker_map: MarkerMap,
    lens: Camera,
    settings: PoseSettings,
    unit: RollingShutter,
) -> _FollowedRun | None:
    """Fit poses and motions of a run; None if too few frames have a pose."""
    poses: list[MarkerPose | None] = [
        estimate_pose(
            markers.corners_px,
            marker_map.corners_of(markers.ids.tolist()),
            lens,
            settings,
            None,
            unit,
            motion,
        )
        for (_, _, markers), motion in zip(run, expected, strict=True)
    ]
    kept = [
        (time_s, pose)
        for (_, time_s, _), pose in zip(run, poses, strict=True)
        if pose is not None and pose.motion is not None
    ]
    if len(kept) < _FEWEST_FRAMES:
        return None
    time_s = np.array([one for one, _ in kept])
    motion = _spline_motion(time_s, [pose for _, pose in kept], np.array([one for _, one, _ in run]))
    inner = [pose.motion for _, pose in kept[1:-1] if pose.motion is not None]
    information = np.linalg.inv(np.array([one.measured_covariance for one in inner]))
    at = np.isin([one for _, one, _ in run], time_s[1:-1])
    return _FollowedRun(motion, motion[at], np.array([one.measured for one in inner]), information)


def _spline_motion(
    time_s: Float[np.ndarray, "poses"], poses: Sequence[MarkerPose], at_s: Float[np.ndarray, "times"]
) -> Float[np.ndarray, "times 6"]:
    """(times, 6), velocity and turn rate of a cubic spline through poses."""
    position_m = CubicSpline(time_s, [pose.position_m for pose in poses])
    turns = Rotation.from_matrix([pose.R_world_cam for pose in poses])
    # Turns from the middle pose; a run is too short for half a revolution.
    turn = CubicSpline(time_s, (turns[len(poses) // 2].inv() * turns).as_rotvec())
    rate = (right_jacobian(turn(at_s)) @ turn(at_s, 1)[..., None])[..., 0]
    return np.concatenate([position_m(at_s, 1), rate], axis=1)


def _ratio(runs: Sequence[_FollowedRun]) -> tuple[float, float]:
    """Ratio of the motions per row to the motions per second, and its standard deviation."""
    weighted = [np.einsum("fij,fj->fi", run.information, run.motion) for run in runs]
    information = [(weight * run.motion).sum(axis=1) for weight, run in zip(weighted, runs, strict=True)]
    right = [(weight * run.rows).sum(axis=1) for weight, run in zip(weighted, runs, strict=True)]
    share = [np.ones(len(one)) for one in information]
    ratio = 0.0
    for _ in range(5):
        total = sum(float(w @ one) for w, one in zip(share, information, strict=True))
        ratio = sum(float(w @ one) for w, one in zip(share, right, strict=True)) / max(total, 1e-300)
        share = [
            1 / np.maximum(1.0, np.abs(r - ratio * one) / np.sqrt(np.maximum(one, 1e-300)) / _ROBUST)
            for r, one in zip(right, information, strict=True)
        ]
    total = sum(float(w @ one) for w, one in zip(share, information, strict=True))
    sums = np.array(
        [
            float((w * (r - ratio * one))[first : first + _GROUP_FRAMES].sum())
            for w, r, one in zip(share, right, information, strict=True)
            for first in range(0, len(one), _GROUP_FRAMES)
        ]
    )
    spread = np.sqrt((sums**2).sum() * len(sums) / max(len(sums) - 1, 1))
    return ratio, float(max(spread, np.sqrt(total)) / max(total, 1e-300))
