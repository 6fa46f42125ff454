"""The rolling shutter: rows of one frame are exposed one after the other while the camera moves.

The pose of a frame is that of its middle row. The pixels of a corner in another row are moved to where the camera would
have seen the corner when the middle row was exposed: by the difference of its projections by the poses at both times.
Those poses are known from the frames around it (spline-based correction: Hedborg, Forssén, Felsberg & Ringaby, Rolling
shutter bundle adjustment, CVPR 2012).

The line time, from row to row, is estimated from the markers in a video.
Rows of one frame show by how far the camera moves from row to row; the poses of neighbouring frames show by how far it
moves per second. With a line time that is a little wrong, the corners that are moved to the middle row
keep residuals in proportion to the error. With these residuals r, their inverse covariance V⁻¹ after the fit of the
pose, and their change d by the line time, one step of a search along the line time is

    Σ dᵀ V⁻¹ r / Σ dᵀ V⁻¹ d,

and its variance is that of the sums over groups of neighbouring frames, whose errors are alike (Liang & Zeger,
Longitudinal data analysis using generalized linear models, Biometrika 73(1), 1986). Errors of the map and of the lens
do not change sign with the motion, so they hardly bias the estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import NEAR_M, Camera, to_pixels
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import MarkerPose, PoseSettings, estimate_pose

#: Positions, (times, 3), and rotations from camera to world, (times, 3, 3), at times in seconds.
PosesAt = Callable[
    [Float[np.ndarray, "times"]], tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3 3"]]
]
#: Number and time (seconds) of a frame, and its markers, which are all in the map.
Detected = tuple[int, float, DetectedMarkers]

#: Number of consecutive frames through which a spline is laid, fewest such frames, and largest number of these runs.
_RUN_FRAMES, _FEWEST_FRAMES, _MOST_RUNS = 11, 5, 5
#: Smallest number of markers in a frame of a run. The rows of fewer markers hardly show a motion.
_FEWEST_MARKERS = 3
#: Largest number of steps, and length of a step, in standard deviations, below which no further one is needed.
_STEPS, _SAME = 6, 0.1
#: Number of neighbouring frames whose errors are alike.
_GROUP_FRAMES = 5
#: Residual of a frame, in standard deviations, from which on its weight falls.
_ROBUST = 3.0
#: Ratio of an estimate to its standard deviation from which on the shutter rolls, and from which on a given line time
#: is contradicted.
_SURE, _CONTRADICTED = 4.0, 5.0
#: Time from the first row to the last, seconds, below which an uncertainty is no matter: at 1 m/s, 0.03 mm.
_NO_MATTER_S = 1e-4
#: Standard deviation of the readout, as a share of the time between two frames, above which nothing is shown.
_SHOWN = 0.1


@dataclass(frozen=True)
class RollingShutter:
    """Rolling shutter of a camera: its rows are exposed one after the other.

    Attributes:
        line_time_s: time from the exposure of one row to that of the next row, seconds; negative if the rows are
            exposed from the last row to the first.
        std_s: standard deviation of the line time, seconds.
    """

    line_time_s: float
    std_s: float = 0.0


def spline_through(time_s: Sequence[float], poses: Sequence[tuple[np.ndarray, np.ndarray]]) -> PosesAt:
    """Cubic splines through poses, positions and rotations from camera to world, at two times or more, seconds."""
    position_m = CubicSpline(time_s, [position for position, _ in poses])
    turns = RotationSpline(time_s, Rotation.from_matrix([R for _, R in poses]))
    return lambda times: (position_m(times), turns(times).as_matrix())


@dataclass(frozen=True)
class SeenRows:
    """Corners in one frame, whose rows were exposed one after the other.

    Attributes:
        corners_px: (markers, 4, 2), pixels.
        corners_m: (markers, 4, 3), the same corners in the world, metres.
        lens: intrinsics of the camera.
        time_s: when the middle row was exposed, seconds.
    """

    corners_px: Float[np.ndarray, "markers 4 2"]
    corners_m: Float[np.ndarray, "markers 4 3"]
    lens: Camera
    time_s: float

    def late_s(self, line_time_s: float) -> Float[np.ndarray, "markers 4"]:
        """(markers, 4), when the rows of the corners were exposed, after the middle row, seconds."""
        return line_time_s * (self.corners_px[..., 1] - (float(self.lens.image_size_wh[1]) - 1) / 2)

    def at_middle_row(self, line_time_s: float, poses_at: PosesAt) -> Float[np.ndarray, "markers 4 2"]:
        """(markers, 4, 2), pixels of the corners as the middle row's pose shows them."""
        return self.corners_px - self.shift((0.0, line_time_s), poses_at)

    def shift(self, line_times_s: tuple[float, float], poses_at: PosesAt) -> Float[np.ndarray, "markers 4 2"]:
        """(markers, 4, 2), change of the pixels from one line time to another, seconds; 0 behind the camera."""
        first, second = (self._seen_at(line_time_s, poses_at) for line_time_s in line_times_s)
        return np.nan_to_num(second - first)

    def _seen_at(self, line_time_s: float, poses_at: PosesAt) -> Float[np.ndarray, "markers 4 2"]:
        """Pixels of the corners, each at the time of its row; NaN behind the camera."""
        position_m, R = poses_at((self.time_s + self.late_s(line_time_s)).ravel())
        x_cam = np.einsum("nji,nj->ni", R, self.corners_m.reshape(-1, 3) - position_m)
        x_cam[x_cam[:, 2] <= NEAR_M] = np.nan
        return np.asarray(to_pixels(self.lens, x_cam)).reshape(self.corners_px.shape)


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
    line_time_s = 0.0
    motions: list[PosesAt | None] = [None] * len(runs)
    for _ in range(_STEPS):
        followed = [
            _followed(run, motion, marker_map, lens, settings, line_time_s)
            for run, motion in zip(runs, motions, strict=True)
        ]
        motions = [motion for motion, _ in followed]
        found = [sums for _, sums in followed if len(sums)]
        if not found:
            return None
        step_s, std_s = _ratio(found)
        line_time_s += step_s
        if abs(step_s) < _SAME * std_s:
            break
    return LineTime(line_time_s, std_s, sum(map(len, found)), rows, frame_s)


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
    motion: PosesAt | None,
    marker_map: MarkerMap,
    lens: Camera,
    settings: PoseSettings,
    line_time_s: float,
) -> tuple[PosesAt | None, Float[np.ndarray, "frames 2"]]:
    """Fit the poses of a run.

    Returns:
        The motion by these poses, None if too few frames have one; and for each frame that is not at an end of the run,
        the weighted squares of the changes by the line time, and their products with the residuals.
    """
    poses: list[tuple[SeenRows, MarkerPose]] = []
    for _, time_s, markers in run:
        corners_m = marker_map.corners_of(markers.ids.tolist())
        rows = SeenRows(markers.corners_px, corners_m, lens, time_s)
        corners_px = markers.corners_px if motion is None else rows.at_middle_row(line_time_s, motion)
        pose = estimate_pose(corners_px, corners_m, lens, settings, std_px=markers.std_px)
        if pose is not None and len(pose.used) == len(pose.fits):
            poses.append((rows, pose))
    if len(poses) < _FEWEST_FRAMES:
        return None, np.zeros((0, 2))
    motion = spline_through(
        [rows.time_s for rows, _ in poses], [(pose.position_m, pose.R_world_cam) for _, pose in poses]
    )
    unit_s = 1e-3 / float(lens.image_size_wh[1])
    sums = []
    for rows, pose in poses[1:-1]:
        change = rows.shift((line_time_s - unit_s / 2, line_time_s + unit_s / 2), motion) / unit_s
        if pose.equations is not None:
            squares, products = pose.equations.products(change.reshape(-1, 8, 1))
            sums.append((squares[0, 0], products[0]))
    return motion, np.array(sums)


def _ratio(runs: Sequence[Float[np.ndarray, "_ 2"]]) -> tuple[float, float]:
    """Ratio of the sums of products and squares of all frames, and its standard deviation."""
    frames, ratio = np.concatenate(runs), 0.0
    for _ in range(5):
        left = np.abs(frames[:, 1] - ratio * frames[:, 0]) / np.sqrt(np.maximum(frames[:, 0], 1e-300))
        weight = 1 / np.maximum(1.0, left / _ROBUST)
        total = max(float(weight @ frames[:, 0]), 1e-300)
        ratio = float(weight @ frames[:, 1]) / total
    left = weight * (frames[:, 1] - ratio * frames[:, 0])
    starts = np.cumsum([0, *(len(run) for run in runs)])
    groups = [
        float(left[first : min(first + _GROUP_FRAMES, end)].sum())
        for start, end in pairwise(starts)
        for first in range(start, end, _GROUP_FRAMES)
    ]
    spread = np.sqrt(np.sum(np.square(groups)) * len(groups) / max(len(groups) - 1, 1))
    return ratio, float(max(spread, np.sqrt(total)) / total)
