"""Paths from the poses of all frames: filtered, each frame by itself and the frames before; or smoothed, by all frames.

How wildly the camera moves is chosen for a recording by the likelihood of its poses. For the smoother, the causal
filter runs once forwards and once backwards in time, and a pose is used if it fits in both directions. A
Rauch-Tung-Striebel smoother on the manifold of poses (`psotrack.geometry.estimation`) gives the path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering import pose_filter
from psotrack.inside_out.filtering.motion import Agility, Motion
from psotrack.inside_out.filtering.pose_filter import Estimated, FilterRun, PoseFilterParams
from psotrack.inside_out.pose import CameraPose

#: Factor between neighbouring values, and largest number of steps from the defaults: accelerations from 0.05 to
#: 500 m/s², changes of the turn rate from 0.03 to 300 rad/s.
_FACTOR, _MOST_STEPS = 10.0**0.25, 8
#: Lengths of the search's steps: with the last alone, a flight like none of the defaults would take many.
_STRIDES = (2, 1)
#: Number of successive poses that are looked at together, and largest number of such windows.
_WINDOW, _MOST_WINDOWS = 60, 4
#: What a step from the defaults costs of the log likelihood, so that a few poses do not decide.
_STEP_COST = 0.25
#: (frames, 6, 6), parts of covariances.
Covariances = Float[np.ndarray, "frames 6 6"]


def choose_agility(
    time_s: Sequence[float], poses: Sequence[CameraPose | None], params: PoseFilterParams
) -> Agility:
    """The most likely agility of a camera, by a search along both numbers in turn.

    Args:
        time_s: times of the frames, seconds.
        poses: the frames' own poses; None for a frame without one.
        params: parameters of the filter.
    """
    seen = [one for one in zip(time_s, poses, strict=True) if one[1] is not None]
    last = max(len(seen) - _WINDOW, 0)
    starts = np.unique(np.linspace(0, last, min(_MOST_WINDOWS, 1 + -(-last // _WINDOW))).astype(int))
    windows = [seen[start : start + _WINDOW] for start in starts]

    @cache
    def likelihood(along: int, about: int) -> float:
        steps = abs(along), abs(about)
        if max(steps) > _MOST_STEPS:
            return -np.inf
        total = -_STEP_COST * sum(steps)
        for window in windows:
            run = FilterRun()
            for at_s, pose in window:
                run = pose_filter.step(run, float(at_s), pose, params, _agility(along, about))
            total += run.log_likelihood
        return total

    best = (0, 0)
    for stride in _STRIDES:
        # These steps, and those that differ from them by a stride in one number.
        beside = ((0, 0), (-stride, 0), (stride, 0), (0, -stride), (0, stride))
        while True:
            around = [(best[0] + along, best[1] + about) for along, about in beside]
            better = max(around, key=lambda steps: likelihood(*steps))
            if better == best:
                break
            best = better
    return _agility(*best)


def _agility(along: int, about: int) -> Agility:
    default = Agility()
    return Agility(
        float(default.acceleration_std_m_s2 * _FACTOR**along),
        float(default.rate_change_std_rad_s * _FACTOR**about),
    )


def filter_path(
    path: CameraPath, params: PoseFilterParams | None = None, constant: Covariances | None = None
) -> CameraPath:
    """Filter a path: the estimate in each frame uses this frame and earlier ones, and the agility of the recording.

    Args:
        path: raw poses, each from its frame alone.
        params: parameters of the filter.
        constant: part of the covariances by errors that are the same in all frames; None is 0.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    params, poses = params or PoseFilterParams(), pose_filter.poses_of(path, constant)
    agility = choose_agility(path.time_s.tolist(), poses, params)
    run, estimates = FilterRun(), []
    for time_s, pose in zip(path.time_s.tolist(), poses, strict=True):
        run = pose_filter.step(run, time_s, pose, params, agility)
        estimates.append(pose_filter.expected(run, time_s, params, agility))
    return pose_filter.path_of(path, estimates)


def smooth(
    path: CameraPath, params: PoseFilterParams | None = None, constant: Covariances | None = None
) -> CameraPath:
    """Estimate every frame's pose from the poses of all frames.

    Gaps are bridged from both sides. A frame is lost if no used pose lies within `longest_gap_s` of it.

    Args:
        path: raw poses, each estimated from its frame alone. Poses of a filter already contain other frames, which
            would then count twice.
        params: parameters of the filter; None for the defaults.
        constant: part of the covariances by errors that are the same in all frames; None is 0.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    return pose_filter.path_of(
        path,
        smoothed_motions(path.time_s, pose_filter.poses_of(path, constant), params or PoseFilterParams()),
    )


def smoothed_motions(
    time_s: Float[np.ndarray, "frames"], poses: Sequence[CameraPose | None], params: PoseFilterParams
) -> list[Estimated]:
    """Smoothed pose and motion of every frame, from the frames' own poses at these times, seconds."""
    agility = choose_agility(time_s.tolist(), poses, params)
    fits, track, ambiguity, agilities = _followed(time_s, poses, params, agility)
    fits_back, _, ambiguity_back, _ = _followed(-time_s[::-1], poses[::-1], params, agility)
    fits, ambiguity = fits & fits_back[::-1], np.fmin(ambiguity, ambiguity_back[::-1])
    found = [Estimated(None)] * len(poses)
    for span in _spans(time_s, fits, track, params.longest_gap_s):
        constant = np.zeros((6, 6))
        for k, motion in zip(
            range(span.start, span.stop),
            _smooth_span(time_s, poses, fits, span, agilities),
            strict=True,
        ):
            pose = poses[k]
            constant = pose.constant if pose is not None and fits[k] else constant
            motion = replace(motion, covariance=motion.covariance + constant)
            found[k] = Estimated(motion, bool(fits[k]), float(ambiguity[k]))
    return found


def _followed(
    time_s: Float[np.ndarray, "frames"],
    poses: Sequence[CameraPose | None],
    params: PoseFilterParams,
    agility: Agility,
) -> tuple[Bool[np.ndarray, "frames"], Int[np.ndarray, "frames"], Float[np.ndarray, "frames"], list[Agility]]:
    """Run the causal filter; poses of a track that is never confirmed do not count.

    Returns:
        (frames,) each: whether the frame's pose fits the motion, judged at the end of the run; number of the track,
        which changes where the camera jumps; ambiguity of the track; and how wildly the camera may move into the frame.
    """
    count = len(poses)
    fits, track, ambiguity = np.zeros(count, bool), np.zeros(count, int), np.full(count, np.nan)
    agilities = [agility] * count
    has_pose, run, good = np.array([pose is not None for pose in poses], bool), FilterRun(), [False]
    for k, pose in enumerate(poses):
        run = pose_filter.step(run, float(time_s[k]), pose, params, agility)
        fits[k] = run.used
        if run.restarted_s is not None:
            # The poses of a rival track were gated when they came.
            since = int(np.searchsorted(time_s, run.restarted_s))
            fits[since:k] = has_pose[since:k] & ~fits[since:k]
            if run.jumped:
                good.append(False)
                track[since:k] = len(good) - 1
            agilities[since:k] = [run.agility_at(run.restarted_s, agility)] * (k - since)
        agilities[k] = run.agility_at(float(time_s[k]), agility)
        track[k], good[-1] = len(good) - 1, pose_filter.confirmed(run, params)
        if run.track is not None:
            ambiguity[k] = run.track.ambiguity
    return fits & np.array(good)[track], track, ambiguity, agilities


def _spans(
    time_s: Float[np.ndarray, "frames"],
    fits: Bool[np.ndarray, "frames"],
    track: Int[np.ndarray, "frames"],
    longest_gap_s: float,
) -> Iterator[slice]:
    """Yield the spans of frames without a jump or a long gap; a span ends `longest_gap_s` after its last used pose."""
    seen = np.flatnonzero(fits)
    is_break = (np.diff(time_s[seen]) > 2 * longest_gap_s) | (np.diff(track[seen]) != 0)
    ends = np.append(np.flatnonzero(is_break), len(seen) - 1) if len(seen) else np.array([], int)
    first = 0
    for end in ends:
        next_seen = seen[end + 1] if end + 1 < len(seen) else len(time_s)
        within_gap = int(np.searchsorted(time_s, time_s[seen[end]] + longest_gap_s, side="right"))
        yield slice(int(seen[first]), int(min(next_seen, within_gap)))
        first = end + 1


def _smooth_span(
    time_s: Float[np.ndarray, "frames"],
    poses: Sequence[CameraPose | None],
    fits: Bool[np.ndarray, "frames"],
    span: slice,
    agility: Sequence[Agility],
) -> list[pose_motion.MotionEstimate]:
    """Smoothed motions of a span of frames whose first pose fits, without constant errors."""
    first = poses[span.start]
    if first is None:
        raise ValueError("expected a pose in the first frame of a span")
    filtered = [pose_motion.initial_motion(first, agility[span.start])]
    ahead: list[tuple[Motion, pose_motion.Matrix, pose_motion.Matrix]] = []
    for k in range(span.start + 1, span.stop):
        pose = poses[k] if fits[k] else None
        ahead.append(pose_motion.predict(filtered[-1], float(time_s[k] - time_s[k - 1]), agility[k]))
        motion = ahead[-1][0]
        if pose is not None:
            found = pose_motion.innovation(motion, pose)
            right = pose_filter.probability_right(found.off, found.covariance + pose.constant, pose.ambiguity)
            motion = pose_motion.correct(motion, found, right)
        filtered.append(motion)
    later = filtered[-1]
    motions = [later]
    for now, step_ahead in zip(filtered[-2::-1], ahead[::-1], strict=True):
        later = pose_motion.smoothed(now, *step_ahead, later)
        motions.append(later)
    return [pose_motion.estimate(motion) for motion in motions[::-1]]
