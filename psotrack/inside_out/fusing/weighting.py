"""One drone from two sources: its smoothed camera path and its track, the arm between their points, and their weights.

The two sources share no errors, so their difference contains no motion and has the sum of their variances. The weighted
mean of two positions with independent errors (Bar-Shalom et al. 2001, section 8.3.3) is right in every frame, however
long the errors of a source last.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import gammaincinv

from psotrack.geometry import cross_matrices
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
_FREEDOM, _SMOOTHINGS = 4.0, 3
#: Tracked point of a drone: the centre of its camera, or the middle of its silhouette.
Point = Literal["camera", "middle"]

#: Prior standard deviations of the logarithms of the variances. The differences determine only their sum; an outside
#: track may be of any program.
_PRIOR = np.array([1.0, 3.0])
#: Number of times that the arm, the variances, and the frames in which the sources agree are estimated in turn.
_ROUNDS = 3
#: Distance from the median, in median distances, beyond which a frame is left out of the arm.
_FAR = 4.0
#: Number of blocks of frames whose means show how certain the arm is, and the factor on its standard error: blocks are
#: few, and those of a flight of some seconds are correlated with each other.
_BLOCKS, _ERRORS = 6, 2.0
#: Smallest variance of a position, m2, and smallest factor on variances, for sources that never differ at all.
_LEAST_M2, _LEAST = 1e-10, 1e-6
#: Largest standard deviation of an orientation about an axis, radians: nothing is known.
_LARGEST_TURN_RAD = np.pi / 2

_Positions = Float[np.ndarray, "frames 3"]
_Covariances = Float[np.ndarray, "frames 3 3"]


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
    for _ in range(_SMOOTHINGS):
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


@dataclass(frozen=True)
class Weighted:
    """A drone's position from both sources.

    Attributes:
        position_m, covariance_m2: (frames, 3), (frames, 3, 3), NaN where neither source knows the drone.
        known: (frames, 2), whether the inside and the outside were used.
        gross: (frames, 2), whether a source contradicts the other one and was not used.
        scale: (2,), standard deviation of the errors of each source divided by the stated one.
        arm_m, arm_std_m: (3,), from the camera's centre to the middle, in the camera's axes, and standard errors.
    """

    position_m: _Positions
    covariance_m2: _Covariances
    known: Bool[np.ndarray, "frames 2"]
    gross: Bool[np.ndarray, "frames 2"]
    scale: Float[np.ndarray, "2"]
    arm_m: Float[np.ndarray, "3"]
    arm_std_m: float

    def sources(self) -> dict[str, dict[str, float]]:
        """The scale of each source, and its number of frames with gross errors, fit for JSON."""
        pairs = zip(self.scale.tolist(), self.gross.sum(axis=0).tolist(), strict=True)
        words = ({"scale": scale, "gross_frames": frames} for scale, frames in pairs)
        return dict(zip(("inside", "outside"), words, strict=True))


def weigh(
    inside: Inside,
    middle_m: _Positions,
    middle_m2: _Covariances,
    point: Point,
) -> Weighted:
    """The weighted mean of a path and a track that have frames in common.

    Args:
        inside: the path at the frames.
        middle_m, middle_m2: (frames, 3), (frames, 3, 3), positions of the track and stated covariances; NaN where it is
            not tracked.
        point: tracked point of the result.
    """
    known = np.stack([np.isfinite(each).all(axis=1) for each in (inside.position_m, middle_m)], axis=1)
    both = np.asarray(known.all(axis=1))
    agree = both
    variances = np.array([max(inside.white, 1.0), 1.0])
    for _ in range(_ROUNDS):
        arm_m, arm_std_m, count = estimate_arm(inside, np.where(agree[:, None], middle_m, np.nan))
        arm_m2 = _arm_covariance_m2(inside, arm_m, arm_std_m)
        at_arm_m = np.matvec(inside.rotation, arm_m)
        apart_m = middle_m - inside.position_m - at_arm_m
        fixed_m2 = inside.at_variance_m2(0.0) + arm_m2
        stated_m2 = np.stack([inside.stated_m2, middle_m2], axis=1)
        sum_m2 = fixed_m2 + np.einsum("s,fsij->fij", variances, stated_m2)
        misfit = np.full(len(both), np.inf)
        misfit[both] = _misfit(apart_m[both], sum_m2[both])
        usual = max(float(np.median(misfit[agree])) / CHI2_3_MEDIAN, _LEAST)
        agree = misfit <= usual * GATE
        variances = _fit_variances(
            apart_m[agree], fixed_m2[agree], stated_m2[agree], count, usual * variances, inside.white
        )
    gross = _wrong_source(np.stack([inside.pose_m, middle_m], axis=1), both & ~agree)
    known &= ~gross
    # One of the two sources is moved along the arm, to the point that the other one tracks.
    moved = 1 if point == "camera" else 0
    parts_m = np.stack([inside.position_m, middle_m], axis=1)
    parts_m2 = np.stack([inside.at_variance_m2(variances[0]), variances[1] * middle_m2], axis=1)
    parts_m[:, moved] += -at_arm_m if point == "camera" else at_arm_m
    parts_m2[:, moved] += arm_m2
    used = known[..., None, None]
    weight = np.where(used, np.linalg.inv(np.where(used, parts_m2, np.eye(3))), 0.0)
    somewhere = np.asarray(known.any(axis=1))
    covariance_m2 = np.full_like(arm_m2, np.nan)
    covariance_m2[somewhere] = np.linalg.inv(weight[somewhere].sum(axis=1))
    gain = covariance_m2[:, None] @ weight
    position_m = np.matvec(gain, np.where(known[..., None], parts_m, 0.0)).sum(axis=1)
    # The error of the arm is the same in all frames, and its standard error itself is uncertain.
    covariance_m2 += (_ERRORS**2 - 1) * arm_std_m**2 * gain[:, moved] @ gain[:, moved].mT
    return Weighted(position_m, covariance_m2, known, gross, np.sqrt(variances), arm_m, arm_std_m)


def estimate_arm(inside: Inside, middle_m: _Positions) -> tuple[Float[np.ndarray, "3"], float, float]:
    """The arm from the camera's centre to the middle, its standard error, and the number of independent frames.

    The arm (3,), in the camera's axes, metres, is constant, because the camera is fixed to the body. It is the mean of
    the arms near their median, which a minority of gross errors moves little. Errors of neighbouring frames are
    correlated, so that the standard error along an axis is that of the means of a few blocks of frames.

    Args:
        inside: the path at the frames.
        middle_m: (frames, 3), middle of the silhouette; NaN where unknown.
    """
    arms_m = np.matvec(inside.rotation.mT, middle_m - inside.position_m)
    arms_m = arms_m[np.isfinite(arms_m).all(axis=1)]
    if not len(arms_m):
        return np.zeros(3), 0.0, 0.0
    away_m = np.linalg.norm(arms_m - np.median(arms_m, axis=0), axis=1)
    arms_m = arms_m[away_m <= _FAR * np.median(away_m) + np.sqrt(_LEAST_M2)]
    arm_m = arms_m.mean(axis=0)
    if len(arms_m) < _BLOCKS:
        return arm_m, float(np.linalg.norm(arm_m)), 1.0
    means_m = [block.mean(axis=0) for block in np.array_split(arms_m, _BLOCKS)]
    variance_m2 = float(np.var(means_m, axis=0, ddof=1).mean()) / _BLOCKS + _LEAST_M2
    count = arms_m.var(axis=0).mean() / variance_m2 / _ERRORS**2
    return arm_m, float(np.sqrt(variance_m2)), max(float(count), 1.0)


def _arm_covariance_m2(inside: Inside, arm_m: Float[np.ndarray, "3"], arm_std_m: float) -> _Covariances:
    """(frames, 3, 3), covariance of the arm's end, world, m²."""
    by_turn = (
        np.minimum(inside.turn_rad, _LARGEST_TURN_RAD)[:, None, None]
        * inside.rotation
        @ cross_matrices(arm_m)
    )
    return by_turn @ by_turn.mT + (arm_std_m**2 + _LEAST_M2) * np.eye(3)


def _fit_variances(
    apart_m: _Positions,
    fixed_m2: _Covariances,
    stated_m2: Float[np.ndarray, "frames 2 3 3"],
    count: float,
    start: Float[np.ndarray, "2"],
    white: float,
) -> Float[np.ndarray, "2"]:
    """(2,), factors on the stated variances of both sources, of the highest posterior density given the differences."""
    # The differences are without the mean arm, which takes a part of the variance.
    independent, lost = count / len(apart_m), count / max(count - 1, 0.5)

    # What a path does not state of its errors is taken to be half white noise and half correlated.
    expected = np.log([max(1.0, 2 * white - 1), 1.0])

    def cost(logs: Float[np.ndarray, "2"]) -> float:
        sum_m2 = fixed_m2 + np.einsum("s,fsij->fij", np.exp(logs), stated_m2)
        misfit = lost * _misfit(apart_m, sum_m2) + np.linalg.slogdet(sum_m2)[1]
        prior = (((logs - expected) / _PRIOR) ** 2).sum()
        return float(independent * misfit.sum() + prior) / 2

    least = np.log([max(white, _LEAST), _LEAST])
    bounds = [(low, low + 40.0) for low in least]
    return np.exp(minimize(cost, np.maximum(np.log(start), least), method="L-BFGS-B", bounds=bounds).x)


def _wrong_source(
    positions_m: Float[np.ndarray, "frames 2 3"], contradict: Bool[np.ndarray, "frames"]
) -> Bool[np.ndarray, "frames 2"]:
    """(frames, 2), which source is wrong where two contradict each other: the one with the larger jump in the run.

    A jump is a second difference of unsmoothed positions, up to one frame outside of the run.
    """
    jump_m = np.zeros(positions_m.shape[:2])
    jump_m[1:-1] = np.nan_to_num(np.linalg.norm(np.diff(positions_m, n=2, axis=0), axis=2))
    wrong = np.zeros(jump_m.shape, bool)
    ends = np.flatnonzero(np.diff(np.pad(contradict, 1).astype(int)))
    for first, last in zip(ends[::2], ends[1::2], strict=True):
        wrong[first:last, jump_m[max(first - 1, 0) : last + 1].max(axis=0).argmax()] = True
    return wrong


def _misfit(
    vectors: Float[np.ndarray, "rows 3"], covariance: Float[np.ndarray, "rows 3 3"]
) -> Float[np.ndarray, "rows"]:
    """Squared lengths of vectors, normalised by their covariances."""
    return np.vecdot(vectors, np.linalg.solve(covariance, vectors[..., None])[..., 0])
