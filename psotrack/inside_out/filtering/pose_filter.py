"""Causal filter over the poses of single frames: each frame's estimate uses this frame and earlier ones only.

`step` follows a camera. A pose that does not fit the motion is gated and not used. Poses are returned once the first
ones are confirmed, and none after too long a gap. Poses that agree with one another but not with the motion make a
rival track, which takes over after enough poses, so that no wrong track lasts. After a gap the track goes on with
growing uncertainty; poses that it does not predict need the same confirmations as poses that contradict it, or markers
that agree beyond chance in a pose that does not contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.special import chdtri, gammaln

from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.geometry import rotation_matrices
from psotrack.inside_out.camera_path import CameraPath, Flag
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.motion import Agility, Motion, MotionEstimate
from psotrack.inside_out.pose import CameraPose
from psotrack.trajectories import Status

#: Probability that a good pose is gated, if errors are normal; those of videos are more often large.
_FALSE_ALARM = 1e-4
#: Number of successive poses that distinguish a turn, which only the wildest drone flies, from an outlier.
_TURN_POSES = 2
_WILDEST = Agility(50.0, 20.0)
#: Smallest number of markers that agree beyond chance: two more than the one that has a pose by itself.
_BEYOND_CHANCE = 3
#: Ambiguity of a pose below which no other pose explains its markers; and largest ratio of the density of outliers to
#: that of a pose that the motion predicts.
_UNLIKELY = 1e-3
#: Standard deviation of the wrong one of two poses from the right one, along each axis (m) and about each axis (rad).
_OTHER_POSE_STD = 1.0
#: Degrees of freedom of the Student distribution of an innovation: heavy tails, so that a single wild pose does not
#: make a hovering camera race.
_FREEDOM = 4.0
#: Logarithm of this distribution's density where it is largest, relative to that of a normal distribution.
_LOG_PEAK = float(gammaln(_FREEDOM / 2 + 3) - gammaln(_FREEDOM / 2) - 3 * np.log(_FREEDOM / 2))


@dataclass(frozen=True)
class PoseFilterParams:
    """Parameters of the pose filter.

    Attributes:
        longest_gap_s: time without a fitting pose after which no pose is returned until poses are confirmed again,
            seconds.
        confirm: number of poses that must agree before the first pose is returned, unless the markers of one pose agree
            beyond chance. 1 accepts every first pose.
        restart_after: number of successive poses that agree with one another and not with the track, after which they
            replace it. A track that rests on fewer poses needs fewer, unless the markers of one of its poses agree
            beyond chance.
    """

    longest_gap_s: float = 0.5
    confirm: int = 3
    restart_after: int = 10

    def __post_init__(self) -> None:
        check_positive("longest_gap_s", self.longest_gap_s)
        for name in ("confirm", "restart_after"):
            if getattr(self, name) < 1:
                raise SettingsError(name, expected="at least 1", found=f"{getattr(self, name)}")

    def within(self, num_frames: int | None) -> PoseFilterParams:
        """Parameters for a recording of `num_frames` frames: `confirm` is at most this number. None is a stream."""
        return self if num_frames is None else replace(self, confirm=max(1, min(self.confirm, num_frames)))


@dataclass(frozen=True)
class Track:
    """A camera's motion by the poses that fitted it.

    Attributes:
        motion: motion after the last of these poses.
        began_s, seen_s: times of the first and of the last of them, seconds.
        support: their number.
        ambiguity: probability that all of them belong to another camera pose that looks the same.
        sure: whether the markers of one of them agree beyond chance.
        constant: (6, 6), constant part of the covariance of the last of them.
    """

    motion: Motion
    began_s: float
    seen_s: float
    support: int
    ambiguity: float
    sure: bool
    constant: Float[np.ndarray, "6 6"]


@dataclass(frozen=True)
class FilterRun:
    """What `step` passes on from frame to frame; `FilterRun()` is the beginning, without any pose.

    Attributes:
        track: the track; None before the first pose.
        rival: track by poses that contradict the track.
        needed: number of poses after which the rival replaces the track.
        turns: whether the rival is the track after an unpredicted turn, and not another one.
        turned_s: time of the last unpredicted turn of the track, seconds.
        restarted_s: time since when the frame's track is another one than in the frame before, seconds; None if it is
            the same.
        jumped: whether the camera cannot have moved from one to the other.
        used: whether this frame's pose fits the track.
        log_likelihood: logarithm of the density of all poses as predicted, without its constant.
    """

    track: Track | None = None
    rival: Track | None = None
    needed: int = 0
    turns: bool = False
    turned_s: float = -np.inf
    restarted_s: float | None = None
    jumped: bool = False
    used: bool = False
    log_likelihood: float = 0.0

    def agility_at(self, time_s: float, agility: Agility) -> Agility:
        """How wildly the track may move: as wildly as any drone for the acceleration's time constant after a turn."""
        return _WILDEST if time_s - self.turned_s < pose_motion.ACCELERATION_TIME_S else agility


@dataclass(frozen=True)
class Estimated:
    """A frame's estimated pose.

    Attributes:
        motion: pose and motion, with the constant part of the covariance; None of a frame that is lost.
        used: whether the frame's own pose fits the motion; also true of the poses before the track is confirmed.
        ambiguity: probability that it belongs to another camera pose that looks the same.
    """

    motion: MotionEstimate | None = None
    used: bool = False
    ambiguity: float = np.nan


@dataclass(frozen=True)
class _Updated:
    """A track with one more pose; whether the pose is in its gate, and the log density of the pose."""

    track: Track
    fits: bool
    log_density: float


def expected(run: FilterRun, time_s: float, params: PoseFilterParams, agility: Agility) -> Estimated:
    """Estimate at the time of a frame, without the frame's pose."""
    track = run.track
    used = track is not None and run.used and time_s == track.seen_s
    if track is None or not confirmed(run, params) or time_s - track.seen_s > params.longest_gap_s:
        return Estimated(None, used)
    later, _, _ = pose_motion.predict(track.motion, time_s - track.seen_s, run.agility_at(time_s, agility))
    found = pose_motion.estimate(later)
    return Estimated(replace(found, covariance=found.covariance + track.constant), used, track.ambiguity)


def confirmed(run: FilterRun, params: PoseFilterParams) -> bool:
    """Whether the track may be returned: enough poses agree, or the markers of one pose agree beyond chance."""
    return run.track is not None and (run.track.support >= params.confirm or run.track.sure)


def step(
    run: FilterRun, time_s: float, pose: CameraPose | None, params: PoseFilterParams, agility: Agility
) -> FilterRun:
    """Follow the camera into the next frame, whose own pose is `pose`; None if it has none.

    Raises:
        InputError: times do not increase, or a pose's covariance is not positive definite.
    """
    run = replace(run, used=False, restarted_s=None, jumped=False)
    track = run.track
    if track is not None and not time_s > track.seen_s:
        raise InputError("time_s", expected=f"a time after {track.seen_s:g} s", found=f"{time_s:g} s")
    if pose is None:
        return run
    if not (np.isfinite(pose.covariance).all() and np.linalg.eigvalsh(pose.varying)[0] > 0):
        where = f"covariance at {time_s:g} s"
        raise InputError(where, expected="a positive definite matrix", found="another")
    if track is None:
        first = _first_track(time_s, pose, agility)
        return replace(run, track=first, restarted_s=time_s, jumped=True, used=True)
    updated = _updated(track, time_s, pose, params, run.agility_at(time_s, agility))
    run = replace(run, log_likelihood=run.log_likelihood + updated.log_density)
    is_fresh = time_s - track.seen_s <= params.longest_gap_s
    accepts = updated.fits and (is_fresh or _is_predicted(updated))
    rival = run.rival
    if rival is not None and time_s - rival.seen_s <= params.longest_gap_s:
        rivalling = _updated(rival, time_s, pose, params, _WILDEST if run.turns else agility)
        if rivalling.fits and not (accepts and updated.log_density >= rivalling.log_density):
            # The pose belongs to the rival, even where the track has grown uncertain enough to accept it.
            return _rivalled(run, rivalling.track, run.needed, run.turns)
    if accepts:
        return replace(run, track=updated.track, rival=None, used=True)
    if is_fresh:
        anew = replace(track, motion=pose_motion.turning(track.motion, _WILDEST))
        turned = _updated(anew, time_s, pose, params, _WILDEST)
        if turned.fits and _is_predicted(turned) and confirmed(run, params):
            turn = replace(turned.track, began_s=time_s)
            return _rivalled(run, turn, track.support + _TURN_POSES, True)
    first = _first_track(time_s, pose, _WILDEST)
    needed = params.restart_after if track.sure else min(params.restart_after, track.support + 1)
    if not is_fresh:
        needed = 1 if updated.fits and first.sure else max(params.confirm, params.restart_after)
    return _rivalled(run, first, needed, False)


def _rivalled(run: FilterRun, rival: Track, needed: int, turns: bool) -> FilterRun:
    """The run with a rival track, which replaces the track if it has enough poses."""
    if rival.support < needed:
        return replace(run, rival=rival, needed=needed, turns=turns)
    return replace(
        run,
        track=rival,
        rival=None,
        turned_s=rival.began_s if turns else -np.inf,
        restarted_s=rival.began_s,
        jumped=not turns,
        used=True,
    )


def _first_track(time_s: float, pose: CameraPose, agility: Agility) -> Track:
    """The track of a single pose."""
    motion = pose_motion.initial_motion(pose, agility)
    return Track(motion, time_s, time_s, 1, pose.ambiguity, _is_sure(pose), pose.constant)


def _is_sure(pose: CameraPose) -> bool:
    """Whether the markers of a pose agree beyond chance, and no other pose explains them."""
    return pose.num_markers >= _BEYOND_CHANCE and pose.ambiguity < _UNLIKELY


def _updated(
    track: Track, time_s: float, pose: CameraPose, params: PoseFilterParams, agility: Agility
) -> _Updated:
    """A track with one more pose.

    A pose is gated where its squared Mahalanobis distance from the prediction exceeds the value that chi-square with 6
    degrees of freedom exceeds with probability `_FALSE_ALARM`. An ambiguous pose is weighted by the probability that it
    is the right one, given how well it fits.
    """
    predicted, _, _ = pose_motion.predict(track.motion, time_s - track.seen_s, agility)
    found = pose_motion.innovation(predicted, pose)
    spread = found.covariance + pose.constant
    nis, log_size = float(found.off @ np.linalg.solve(spread, found.off)), float(np.linalg.slogdet(spread)[1])
    robust = _LOG_PEAK - ((_FREEDOM + 6) * float(np.log1p(nis / _FREEDOM)) + log_size) / 2
    right = probability_right(found.off, spread, pose.ambiguity)
    more = Track(
        pose_motion.correct(predicted, found, right),
        track.began_s,
        time_s,
        track.support + 1,
        min(track.ambiguity, pose.ambiguity),
        track.sure or _is_sure(pose),
        pose.constant,
    )
    return _Updated(more, bool(nis <= chdtri(6, _FALSE_ALARM)), robust)


def probability_right(
    off: Float[np.ndarray, "6"], spread: Float[np.ndarray, "6 6"], ambiguity: float
) -> float:
    """Probability that an ambiguous pose is the right one, given how well it fits the motion.

    Bayes' rule. A wrong pose is distributed about the right one with a metre and a radian along and about each axis.

    Args:
        off: (6,), difference of the pose from the prediction, metres and radians.
        spread: (6, 6), covariance of this difference.
        ambiguity: probability, before the motion is considered, that another pose is the right one.
    """
    if ambiguity == 0:
        return 1.0
    wide = spread + _OTHER_POSE_STD**2 * np.eye(6)
    fits, other = (
        -(off @ np.linalg.solve(matrix, off) + np.linalg.slogdet(matrix)[1]) / 2 for matrix in (spread, wide)
    )
    return float(1 / (1 + ambiguity / (1 - ambiguity) * np.exp(min(other - fits, 700.0))))


def _is_predicted(updated: _Updated) -> bool:
    """Whether the last pose is predicted by the motion rather than an outlier.

    The density of an outlier within a metre and a radian must be below `_UNLIKELY` times the density of the pose.
    """
    return bool(updated.log_density > -np.log(_UNLIKELY))


def poses_of(
    path: CameraPath, constant: Float[np.ndarray, "frames 6 6"] | None = None
) -> list[CameraPose | None]:
    """The frames' own poses of a path; None for frames without one.

    Args:
        path: the path; an unknown ambiguity counts as 0.
        constant: (frames, 6, 6), the part of the covariances by errors that are the same in all frames; None is 0.
    """
    values = (
        path.position_m,
        rotation_matrices(path.orientation_wxyz),
        path.covariance,
        np.zeros((path.num_frames, 6, 6)) if constant is None else constant,
        np.nan_to_num(path.ambiguity).tolist(),
        path.num_markers.tolist(),
    )
    return [CameraPose(*one) if np.isfinite(one[0]).all() else None for one in zip(*values, strict=True)]


def path_of(raw: CameraPath, estimates: Sequence[Estimated]) -> CameraPath:
    """The path with the estimated poses of its frames.

    `TRACKED` where the frame's own pose fits the motion, `COASTING` where there was none or it was gated, and `LOST`,
    with NaN, where there is no estimate.
    """
    has_pose, motions = np.isfinite(raw.position_m).all(axis=1), [one.motion for one in estimates]
    there = np.array([motion is not None for motion in motions], bool)
    used = np.array([one.used for one in estimates], bool)
    ambiguity = np.where(there, [one.ambiguity for one in estimates], np.nan)
    flags = raw.flags | np.where(has_pose & ~used, int(Flag.GATED), 0)
    surer = there & (ambiguity < raw.ambiguity)
    return replace(
        raw,
        position_m=filled(motions, "position_m", 3),
        orientation_wxyz=orientations(motions),
        covariance=filled(motions, "covariance", 6, 6),
        ambiguity=ambiguity,
        status=np.where(there, np.where(used, int(Status.TRACKED), int(Status.COASTING)), int(Status.LOST)),
        flags=np.where(surer, flags & ~int(Flag.AMBIGUOUS), flags),
        velocity_m_s=filled(motions, "velocity_m_s", 3) if there.any() else None,
    )


def filled(poses: Sequence[CameraPose | None], name: str, *shape: int) -> np.ndarray:
    """(frames, *shape), an attribute of the frames' poses; NaN in frames without one."""
    unknown = np.full(shape, np.nan)
    values = [unknown if pose is None else getattr(pose, name) for pose in poses]
    return np.array(values, float).reshape(len(poses), *shape)


def orientations(poses: Sequence[CameraPose | None]) -> Float[np.ndarray, "frames 4"]:
    """(frames, 4), unit quaternions, camera to world, of the frames' poses; NaN in frames without one."""
    wxyz, R = np.full((len(poses), 4), np.nan), filled(poses, "R_world_cam", 3, 3)
    there = np.isfinite(R[:, 0, 0])
    if there.any():
        wxyz[there] = Rotation.from_matrix(R[there]).as_quat(scalar_first=True)
    return wxyz
