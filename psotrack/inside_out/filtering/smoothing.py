"""Smoothed camera poses: every frame estimated from the poses of all frames.

The causal filter runs once forwards and once backwards in time. A pose is used if it fits in both directions. Both runs
estimate how violently the camera moves, and how good the poses are, at any time. With these estimates a
Rauch-Tung-Striebel smoother on the manifold of poses (`psotrack.geometry.estimation`) gives the path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry.estimation import backward_step
from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.manifold import right_jacobian_inverse
from psotrack.inside_out.filtering.motion import MOTION, POSE, Levels, Motion
from psotrack.inside_out.filtering.multiple_models import LEVELS, acceleration_rms, probability_right
from psotrack.inside_out.filtering.path_rows import (
    PoseRow,
    estimated_row,
    join_rows,
    lost_row,
    measured_pose,
    split_path,
)
from psotrack.inside_out.filtering.pose_filter import FilterRun, confirmed, step
from psotrack.inside_out.filtering.records import PoseEstimate, PoseFilterParams


@dataclass(frozen=True)
class _FilterFindings:
    """Findings of one run of the filter, apart from poses.

    Attributes:
        fits: (frames,), True if the frame's pose fits the motion, judged at the end of the run.
        jumps: (frames,), number of times up to the frame that the filter restarted at another place.
        log_levels: (frames, 2), logarithms of the densities of the jerk and of the angular acceleration.
        log_noise_scale: (frames,), logarithm of the factor on the covariances of measured poses.
        ambiguity: (frames,), ambiguity of the filter's state.
    """

    fits: Bool[np.ndarray, "frames"]
    jumps: Int[np.ndarray, "frames"]
    log_levels: Float[np.ndarray, "frames 2"]
    log_noise_scale: Float[np.ndarray, "frames"]
    ambiguity: Float[np.ndarray, "frames"]


@dataclass(frozen=True)
class MotionModel:
    """All that the smoother needs to know about a path, apart from the poses.

    Attributes:
        fits: (frames,), True if the smoother uses the frame's pose.
        jumps: (frames,), number of times up to the frame that the camera jumped; the path is not drawn across a jump.
        jerk_density_m2_s5: (frames,), power spectral density of the jerk along each axis.
        wobble_density_rad2_s3: (frames,), power spectral density of the angular acceleration about each axis.
        noise_scale: (frames,), factor on the covariances of the measured poses.
        ambiguity: (frames,), probability that the path shows another camera pose that looks the same.
    """

    fits: Bool[np.ndarray, "frames"]
    jumps: Int[np.ndarray, "frames"]
    jerk_density_m2_s5: Float[np.ndarray, "frames"]
    wobble_density_rad2_s3: Float[np.ndarray, "frames"]
    noise_scale: Float[np.ndarray, "frames"]
    ambiguity: Float[np.ndarray, "frames"]


@dataclass(frozen=True)
class _FilteredFrame:
    """One frame of the forward pass.

    Attributes:
        predicted: motion before the frame's pose.
        F, Q: (1, n, n), transition matrix and process noise from the previous frame.
        motion: motion after the frame's pose.
    """

    predicted: Motion
    F: Float[np.ndarray, "1 n n"]
    Q: Float[np.ndarray, "1 n n"]
    motion: Motion


def smooth(
    path: CameraPath, params: PoseFilterParams | None = None, model: MotionModel | None = None
) -> CameraPath:
    """Estimate every frame's pose from the poses of all frames.

    Gaps are bridged from both sides. A frame is lost if no used pose lies within `longest_gap_s` of it.

    Args:
        path: raw poses, each estimated from its frame alone. Poses from `filter_path` already contain other frames,
            which would then count twice.
        params: parameters of the filter; None for the defaults.
        model: what is known about the motion; None for `estimate_motion_model(path, params)`.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    params = params or PoseFilterParams()
    rows = split_path(path)
    if not rows:
        return path
    model = model or estimate_motion_model(path, params)
    smoothed = [lost_row(row, gated=row.has_pose) for row in rows]
    for span in _spans(path.time_s, model, params.longest_gap_s):
        poses = _smooth_span(rows, model, span)
        for k, pose in zip(range(span.start, span.stop), poses, strict=True):
            smoothed[k] = estimated_row(rows[k], pose, float(model.ambiguity[k]), used=bool(model.fits[k]))
    return join_rows(smoothed)


def first_estimate(path: CameraPath, params: PoseFilterParams) -> tuple[float, PoseEstimate] | None:
    """Time (seconds) and smoothed estimate of the first used pose of a path; None if no pose is used."""
    model = estimate_motion_model(path, params)
    span = next(_spans(path.time_s, model, params.longest_gap_s), None)
    if span is None:
        return None
    return float(path.time_s[span.start]), _smooth_span(split_path(path), model, span)[0]


def estimate_motion_model(path: CameraPath, params: PoseFilterParams) -> MotionModel:
    """Estimate from raw poses how the camera moves and which poses fit: the causal filter in both directions of time.

    Args:
        path: raw poses, each estimated from its frame alone.
        params: parameters of the filter.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    rows = split_path(path)
    forward = _run_filter(rows, params)
    backward = _run_filter([row.backwards() for row in reversed(rows)], params)
    log_levels = (forward.log_levels + backward.log_levels[::-1]) / 2
    return MotionModel(
        fits=forward.fits & backward.fits[::-1],
        jumps=forward.jumps,
        jerk_density_m2_s5=np.exp(log_levels[:, 0]),
        wobble_density_rad2_s3=np.exp(log_levels[:, 1]),
        noise_scale=np.exp((forward.log_noise_scale + backward.log_noise_scale[::-1]) / 2),
        ambiguity=np.fmin(forward.ambiguity, backward.ambiguity[::-1]),
    )


def _run_filter(rows: Sequence[PoseRow], params: PoseFilterParams) -> _FilterFindings:
    """Run the causal filter; a frame without a state gets the findings of the last frame that had one."""
    time_s = np.array([row.time_s for row in rows])
    has_pose = np.array([row.has_pose for row in rows], bool)
    fits, jumped = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
    # A new track begins where the filter starts or jumps; poses of a track that is never confirmed do not count.
    track, is_confirmed = np.zeros(len(rows), int), [False]
    run, found = FilterRun(), []
    latest = _mean_log_levels(_uniform_log_weights()), 0.0, np.nan
    for k, row in enumerate(rows):
        run, _ = step(run, row, params)
        state, rival, recalled = run.state, run.adopted, run.restored
        if recalled is not None:
            # The filter went back to an earlier state, so the poses since then were wrong.
            fits[np.searchsorted(time_s, recalled.seen_s, side="right") : k] = False
        if state is not None:
            # The poses of a rival track were gated when they came.
            since = k if rival is None else int(np.searchsorted(time_s, rival.since_s))
            jumped[since] |= rival is not None and not rival.continuous
            if state.support == 1 or jumped[since]:
                is_confirmed.append(False)
            track[since : k + 1], is_confirmed[-1] = len(is_confirmed) - 1, confirmed(run, params)
            fits[since : k + 1] = has_pose[since : k + 1] & (state.seen_s == row.time_s)
            latest = _mean_log_levels(state.log_weight), float(np.log(state.noise_scale)), state.ambiguity
        found.append(latest)
    log_levels, log_noise_scale, ambiguity = (np.array(values) for values in zip(*found, strict=True))
    fits &= np.array(is_confirmed)[track]
    return _FilterFindings(fits, np.cumsum(jumped), log_levels, log_noise_scale, ambiguity)


def _spans(time_s: Float[np.ndarray, "frames"], model: MotionModel, longest_gap_s: float) -> Iterator[slice]:
    """Yield the spans of frames without a jump or a long gap; a span ends `longest_gap_s` after its last used pose."""
    seen = np.flatnonzero(model.fits)
    is_break = (np.diff(time_s[seen]) > 2 * longest_gap_s) | (np.diff(model.jumps[seen]) != 0)
    ends = np.append(np.flatnonzero(is_break), len(seen) - 1) if len(seen) else np.array([], int)
    first = 0
    for end in ends:
        next_seen = seen[end + 1] if end + 1 < len(seen) else len(time_s)
        within_gap = int(np.searchsorted(time_s, time_s[seen[end]] + longest_gap_s, side="right"))
        yield slice(int(seen[first]), int(min(next_seen, within_gap)))
        first = end + 1


def _smooth_span(rows: Sequence[PoseRow], model: MotionModel, span: slice) -> list[PoseEstimate]:
    """Smoothed poses of a span of frames whose first pose fits."""
    frames = _filter(rows, model, span)
    later = frames[-1].motion
    wobble = model.wobble_density_rad2_s3[span]
    poses = [_estimate(later, float(wobble[-1]))]
    for now, ahead, density in zip(frames[-2::-1], frames[:0:-1], wobble[-2::-1], strict=True):
        later = _smoothed(now.motion, ahead, later)
        poses.append(_estimate(later, float(density)))
    return poses[::-1]


def _filter(rows: Sequence[PoseRow], model: MotionModel, span: slice) -> list[_FilteredFrame]:
    """Forward pass of the smoother over a span of frames."""
    frames: list[_FilteredFrame] = []
    for k in range(span.start, span.stop):
        row = rows[k]
        levels = Levels(model.jerk_density_m2_s5[k : k + 1], model.wobble_density_rad2_s3[k : k + 1])
        pose = measured_pose(row).scaled(float(model.noise_scale[k]))
        if not frames:
            motion = pose_motion.initial_motion(
                pose.position_m, pose.orientation_wxyz, pose.covariance, pose.common, levels, pose.motion
            )
            zeros = np.zeros_like(motion.covariance)
            frames.append(_FilteredFrame(motion, zeros, zeros, motion))
            continue
        dt_s = row.time_s - rows[k - 1].time_s
        predicted, F = pose_motion.predict(frames[-1].motion, dt_s, levels)
        motion = predicted
        if model.fits[k]:
            innovation = pose_motion.innovation(
                predicted,
                pose.position_m,
                pose.orientation_wxyz,
                pose.covariance,
                pose.common,
                pose.motion,
            )
            of_pose = innovation.off[0, :6], innovation.whole_covariance[0, :6, :6]
            right = probability_right(*of_pose, pose.ambiguity)
            motion = pose_motion.correct(predicted, innovation, right)
        frames.append(_FilteredFrame(predicted, F, pose_motion.process_noise(dt_s, levels), motion))
    return frames


def _smoothed(now: Motion, ahead: _FilteredFrame, later: Motion) -> Motion:
    """Smooth one frame.

    Args:
        now: filtered motion of the frame.
        ahead: the next frame of the forward pass.
        later: smoothed motion of the next frame.
    """
    change = pose_motion.difference(ahead.predicted, later)
    # The covariance of `later` is about its own camera axes; the step needs it about those of the predicted camera.
    J = np.eye(pose_motion.SIZE)[None]
    J[:, 9:12, 9:12] = right_jacobian_inverse(change[:, 9:12])
    # The gain corrects the effects of the constant errors (`common`) like the state.
    deviation = np.concatenate([change[..., None], J @ later.common - ahead.predicted.common], axis=-1)
    correction, covariance = map(
        np.asarray,
        backward_step(
            now.covariance,
            ahead.F,
            ahead.Q,
            ahead.predicted.covariance,
            J @ later.covariance @ J.swapaxes(1, 2),
            deviation,
        ),
    )
    smoothed = replace(now, covariance=covariance, common=now.common + correction[..., 1:])
    return pose_motion.retract(smoothed, correction[..., 0])


def _estimate(motion: Motion, wobble_density_rad2_s3: float) -> PoseEstimate:
    """Pose of a motion of one level; the covariance includes the constant errors."""
    common = motion.common[0]
    covariance = motion.covariance[0] + common @ common.T
    return PoseEstimate(
        motion.position_m[0],
        motion.orientation_wxyz[0],
        covariance[np.ix_(POSE, POSE)],
        motion.velocity_m_s[0],
        motion.rate_rad_s[0],
        covariance[np.ix_(MOTION, MOTION)],
        acceleration_rms(motion, covariance),
        wobble_density_rad2_s3,
    )


def _mean_log_levels(log_weight: Float[np.ndarray, "levels"]) -> Float[np.ndarray, "2"]:
    """Weighted means of the log densities of the jerk and of the angular acceleration, over the filter's levels."""
    densities = np.stack([LEVELS.jerk_density_m2_s5, LEVELS.wobble_density_rad2_s3])
    return np.log(densities) @ np.exp(log_weight)


def _uniform_log_weights() -> Float[np.ndarray, "levels"]:
    """Logarithms of equal weights of all levels."""
    return np.full(len(LEVELS.jerk_density_m2_s5), -np.log(len(LEVELS.jerk_density_m2_s5)))
