"""Both sources at the same frames: the smoothed path of an on-board camera, and the tracks of static cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import gammaincinv

from psotrack.inside_out.camera_path import CameraPath
from psotrack.settings import MotionSettings
from psotrack.tracking.motion import Measurements, estimate_jerk_density, motion_params, smooth
from psotrack.trajectories import Status, Trajectories

#: Largest standard deviation of a position along an axis, metres: a position that is uncertain by a kilometre says
#: nothing about a drone that cameras see.
_LARGEST_STD_M = 1e3
#: Standard deviation along each axis of tracks without covariances, metres; the fusion estimates its scale.
_UNSTATED_M = 0.03
#: Difference below which two times are equal, seconds.
_SAME_S = 1e-6
#: Median of the length of three normal numbers, and of its square (chi-square with 3 degrees of freedom).
MEDIAN_LENGTH, CHI2_3_MEDIAN = 1.538, 2.366
#: Gate of squared normalised errors: chi-square with 3 degrees of freedom exceeds it with probability 1e-6.
GATE = 2.0 * float(gammaincinv(3 / 2, 1 - 1e-6))
#: Degrees of freedom of the poses' errors, and number of times that a path is smoothed with new weights.
_FREEDOM, _ROUNDS = 4.0, 3
#: Smallest factor on stated variances, for sources that never err at all.
_LEAST = 1e-6


@dataclass(frozen=True)
class Inside:
    """A smoothed path at frames. Unknown positions and velocities are NaN; rotations are interpolated over gaps.

    Attributes:
        pose_m: (frames, 3), position of the pose nearest in time, before smoothing.
        position_m, velocity_m_s: (frames, 3), of the camera's centre, world.
        covariance_m2: (frames, 3, 3), of the position, if all errors of the poses are white noise.
        stated_m2: (frames, 3, 3), covariance that the path states for the pose nearest in time.
        white: variance of the white noise that is seen in the poses, per stated variance; 0 for a path that was
            smoothed before.
        rotation: (frames, 3, 3), camera to world.
        turn_rad: (frames,), standard deviation of the rotation about each axis.
        away_s: (frames,), time to the nearest pose, seconds.
        tracked: (frames,), whether the frame has a pose of its own.
        oriented: (frames,), whether the rotation is known, and not interpolated over a gap.
    """

    pose_m: Float[np.ndarray, "frames 3"]
    position_m: Float[np.ndarray, "frames 3"]
    velocity_m_s: Float[np.ndarray, "frames 3"]
    covariance_m2: Float[np.ndarray, "frames 3 3"]
    stated_m2: Float[np.ndarray, "frames 3 3"]
    white: float
    rotation: Float[np.ndarray, "frames 3 3"]
    turn_rad: Float[np.ndarray, "frames"]
    away_s: Float[np.ndarray, "frames"]
    tracked: Bool[np.ndarray, "frames"]
    oriented: Bool[np.ndarray, "frames"]

    def at_variance_m2(self, variance: float) -> Float[np.ndarray, "frames 3 3"]:
        """(frames, 3, 3), covariances of the positions if the poses' errors have `variance` times the stated one.

        What exceeds the white noise is correlated, and smoothing does not reduce it.
        """
        return self.covariance_m2 + (variance - self.white) * self.stated_m2


def nearest_index(sorted_values: np.ndarray, wanted: np.ndarray) -> Int[np.ndarray, "wanted"]:
    """(wanted,), index of the value that is nearest to each wanted one; of two equally near ones the earlier."""
    middles = (sorted_values[:-1] + sorted_values[1:]) / 2
    return np.searchsorted(middles, wanted - _SAME_S / 2)


def informative(covariance_m2: Float[np.ndarray, "*rows 3 3"]) -> Bool[np.ndarray, "*rows"]:
    """Whether covariances of positions are known, and not so large that the position is as good as unknown."""
    variance_m2 = np.diagonal(covariance_m2, axis1=-2, axis2=-1)
    return np.isfinite(covariance_m2).all(axis=(-2, -1)) & (variance_m2 <= _LARGEST_STD_M**2).all(axis=-1)


def smoothed(path: CameraPath) -> tuple[CameraPath, float]:
    """The path without useless poses, its positions smoothed unless they were before, and `white` (see `Inside`).

    The jerk density is the one that fits the recording best. Errors have a t distribution, so that a pose far from the
    others counts little: its covariance grows with its distance (K. Lange, R. Little, J. Taylor, Robust statistical
    modeling using the t distribution, Journal of the American Statistical Association 84, 1989).
    """
    usable = (
        path.seen & np.isfinite(path.covariance).all(axis=(1, 2)) & informative(path.covariance[:, :3, :3])
    )
    usable &= np.isfinite(path.orientation_wxyz).all(axis=1)
    if path.velocity_m_s is not None:
        return replace(path, status=np.where(usable, path.status, Status.LOST)), 0.0
    usable &= path.status == Status.TRACKED
    if not usable.any():
        return replace(path, status=np.full(path.num_frames, int(Status.LOST))), 1.0
    stated_m2 = np.where(usable[:, None, None], path.covariance[:, :3, :3], np.eye(3))
    white, misfit = 1.0, np.full(path.num_frames, 3.0)
    for _ in range(_ROUNDS):
        factor = (_FREEDOM * white + misfit) / (_FREEDOM + 3)
        weighted_m2 = factor[:, None, None] * stated_m2
        measured = Measurements(path.time_s, path.position_m[:, None], weighted_m2[:, None], usable[:, None])
        params = motion_params(MotionSettings(error_share=0.0), 1)
        params = replace(params, jerk_density_m2_s5=estimate_jerk_density(measured, params))
        found = smooth(measured, params)
        moved_m = found.position_m[:, 0] - path.position_m
        misfit = np.where(
            usable, np.vecdot(moved_m, np.linalg.solve(stated_m2, moved_m[..., None])[..., 0]), 0.0
        )
        fits = usable & (misfit <= max(white, float(np.median(misfit[usable])) / CHI2_3_MEDIAN) * GATE)
        # A smoothed position follows its own pose in part, which makes the differences smaller.
        part = np.trace(np.linalg.solve(weighted_m2, found.covariance_m2[:, 0]), axis1=1, axis2=2)
        white = max(float(misfit[fits].sum() / (3 - part[fits]).sum()), _LEAST)
    covariance = path.covariance.copy()
    covariance[:, :3, :3] = found.covariance_m2[:, 0]
    return replace(
        path,
        position_m=found.position_m[:, 0],
        velocity_m_s=found.velocity_m_s[:, 0],
        orientation_wxyz=np.where(fits[:, None], path.orientation_wxyz, np.nan),
        covariance=covariance,
        status=np.where(fits, int(Status.TRACKED), int(Status.COASTING)),
    ), white


def inside_at(path: CameraPath, time_s: Float[np.ndarray, "frames"], offset_s: float) -> Inside:
    """The path at the times of frames; the path at t + offset_s belongs to the frame at t, seconds."""
    found, white = smoothed(path)
    wanted_s, frames = time_s + offset_s, len(time_s)
    rows = np.flatnonzero(found.seen)
    posed = np.flatnonzero(found.seen & np.isfinite(found.orientation_wxyz).all(axis=1))
    if len(posed) < 2 or found.velocity_m_s is None:
        nothing = np.full((frames, 3, 3), np.nan)
        identity = np.tile(np.eye(3), (frames, 1, 1))
        vector = nothing[:, 0]
        never = np.full(frames, np.inf)
        no = np.zeros(frames, bool)
        return Inside(vector, vector, vector, nothing, nothing, white, identity, never, never, no, no)
    row_s, pose_s = found.time_s[rows], found.time_s[posed]
    step_s = max(_step_s(path.time_s), _step_s(time_s)) / 2 + _SAME_S
    at_s = np.clip(wanted_s, row_s[0], row_s[-1])
    index = rows[nearest_index(row_s, wanted_s)]
    known = (np.abs(found.time_s[index] - wanted_s) <= step_s) & (np.abs(at_s - wanted_s) <= _SAME_S)
    own = posed[nearest_index(pose_s, wanted_s)]
    away_s = np.abs(found.time_s[own] - wanted_s)
    oriented = known & (away_s <= step_s)
    motion = CubicHermiteSpline(row_s, found.position_m[rows], found.velocity_m_s[rows])
    turned = Rotation.from_quat(found.orientation_wxyz[posed], scalar_first=True)
    rates_rad_s = (turned[:-1].inv() * turned[1:]).magnitude() / np.diff(pose_s) / MEDIAN_LENGTH
    own_rad2 = np.trace(path.covariance[own, 3:, 3:], axis1=1, axis2=2) / 3
    # In a gap the drone may turn twice as quickly as usual.
    turn_rad = np.sqrt(own_rad2 + (2 * np.median(rates_rad_s) * np.where(oriented, 0.0, away_s)) ** 2)
    hidden = ~known[:, None]
    smoothed_m2 = found.covariance[index, :3, :3] * (white > 0)
    return Inside(
        pose_m=path.position_m[index],
        position_m=np.where(hidden, np.nan, motion(at_s)),
        velocity_m_s=np.where(hidden, np.nan, motion(at_s, 1)),
        covariance_m2=np.where(hidden[..., None], np.nan, smoothed_m2),
        stated_m2=path.covariance[own, :3, :3],
        white=white,
        rotation=Slerp(pose_s, turned)(np.clip(wanted_s, pose_s[0], pose_s[-1])).as_matrix(),
        turn_rad=turn_rad,
        away_s=away_s,
        tracked=oriented & (found.status[own] == Status.TRACKED),
        oriented=oriented,
    )


def _step_s(time_s: Float[np.ndarray, "_"]) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def outside_at(outside: Trajectories, also_s: Iterable[Float[np.ndarray, "_"]]) -> Trajectories:
    """The tracks at their own frames and at frames of the same rate for other times; NaN and `LOST` where unknown.

    Args:
        outside: tracks of static cameras; tracks without covariances get one, whose scale the fusion estimates.
        also_s: times of cameras on drones, by the clock of the tracks, seconds; times before frame 0 are left out.
    """
    times_s = list(also_s)
    if outside.num_frames > 1:
        step_s = float(np.median(np.diff(outside.time_s) / np.diff(outside.frame)))
    else:
        step_s = float(np.median(np.concatenate([[1.0], *map(np.diff, times_s)])[1:] or [1.0]))
    first_frame, first_s = outside.frame[0], outside.time_s[0]
    numbers = [first_frame + np.round((each_s - first_s) / step_s) for each_s in times_s]
    frame = np.unique(np.maximum(np.concatenate([outside.frame, *numbers]), -1).astype(np.int64))
    frame = frame[frame >= 0]
    time_s = first_s + step_s * (frame - first_frame)
    rows = np.isin(frame, outside.frame)
    time_s[rows] = outside.time_s
    covariance_m2, velocity_m_s = outside.covariance_m2, outside.velocity_m_s
    if covariance_m2 is None:
        covariance_m2 = np.broadcast_to(_UNSTATED_M**2 * np.eye(3), (*outside.position_m.shape, 3))
    if velocity_m_s is None:
        velocity_m_s = np.full_like(outside.position_m, np.nan)
    is_informative = informative(covariance_m2)
    tracked = int(Status.TRACKED) if outside.status is None else outside.status

    def at_frames(values: np.ndarray) -> np.ndarray:
        found = np.full((len(frame), *values.shape[1:]), np.nan)
        found[rows] = values
        return found

    status = at_frames(np.where(outside.seen & is_informative, tracked, int(Status.LOST)))
    return Trajectories(
        frame,
        time_s,
        outside.drones,
        at_frames(outside.position_m),
        velocity_m_s=at_frames(velocity_m_s),
        status=np.nan_to_num(status, nan=int(Status.LOST)).astype(int),
        covariance_m2=at_frames(np.where(is_informative[..., None, None], covariance_m2, np.nan)),
    )
