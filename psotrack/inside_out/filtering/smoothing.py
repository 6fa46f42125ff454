"""Where a camera was, after the fact: what the frames after say of the frames before.

The causal filter runs once forwards and once backwards: poses count that fit in both directions, and both tell how
wildly the camera moved, and how good poses are, at any time. With these known, a forward-backward smoother on the
manifold gives the best pose of every frame from all poses (H. E. Rauch, F. Tung, C. T. Striebel, Maximum likelihood
estimates of linear dynamic systems, AIAA Journal 3(8), 1965).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.bank import LEVELS, right_pose
from psotrack.inside_out.filtering.manifold import right_jacobian_inverse
from psotrack.inside_out.filtering.motion import POSE, Levels, Motion
from psotrack.inside_out.filtering.path_rows import PoseRow, lost, measured, path_of, rows_of, told_row
from psotrack.inside_out.filtering.pose_filter import FilterRun, confirmed, step
from psotrack.inside_out.filtering.records import PoseEstimate, PoseFilterParams


@dataclass(frozen=True)
class _Learned:
    """What a run of the filter tells beside poses.

    Attributes:
        counts: (frames,), whether the frame's pose fits, as is known in the end.
        jumps: (frames,), how often the camera was found to be elsewhere up to the frame.
        log_levels: (frames, 2), logarithms of the densities of jerk and wobble.
        log_noise_scale: (frames,), logarithm of what covariances of poses are multiplied with.
        ambiguity: (frames,), of the state.
    """

    counts: Bool[np.ndarray, "frames"]
    jumps: Int[np.ndarray, "frames"]
    log_levels: Float[np.ndarray, "frames 2"]
    log_noise_scale: Float[np.ndarray, "frames"]
    ambiguity: Float[np.ndarray, "frames"]


@dataclass(frozen=True)
class _Pass:
    """One frame of the forward pass: as foretold from the frame before, with F and Q of that, and as corrected."""

    foretold: Motion
    F: Float[np.ndarray, "1 n n"]
    Q: Float[np.ndarray, "1 n n"]
    corrected: Motion


def smooth(path: CameraPath, params: PoseFilterParams | None = None) -> CameraPath:
    """The best estimate of every frame from all frames.

    Gaps are bridged from both sides; frames that are farther from all poses that count than `longest_gap_s` are lost.

    Args:
        path: raw poses, each from its frame alone; not those of `follow`, which would count twice.
        params: of the filter.

    Raises:
        InputError: a pose's covariance is not positive definite.
    """
    params = params or PoseFilterParams()
    rows = rows_of(path)
    if not rows:
        return path
    forth = _learned(rows, params)
    back = _learned([replace(row, time_s=-row.time_s) for row in reversed(rows)], params)
    counts = forth.counts & back.counts[::-1]
    log_levels = (forth.log_levels + back.log_levels[::-1]) / 2
    noise_scale = np.exp((forth.log_noise_scale + back.log_noise_scale[::-1]) / 2)
    ambiguity = np.fmin(forth.ambiguity, back.ambiguity[::-1])
    smoothed = [lost(row, gated=row.has_pose) for row in rows]
    for span in _spans(path.time_s, counts, forth.jumps, params.longest_gap_s):
        poses = _smoothed(rows[span], counts[span], log_levels[span], noise_scale[span])
        for k, told in zip(range(span.start, span.stop), poses, strict=True):
            smoothed[k] = told_row(rows[k], told, float(ambiguity[k]), used=bool(counts[k]))
    return path_of(smoothed)


def _learned(rows: Sequence[PoseRow], params: PoseFilterParams) -> _Learned:
    """What the causal filter finds out on its way; where it knows nothing, what it knew last."""
    time_s = np.array([row.time_s for row in rows])
    has_pose = np.array([row.has_pose for row in rows], bool)
    counts, jumped = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
    start = np.zeros(len(rows), int)
    told, found = [False], []
    following, known = FilterRun(), (_log_levels(_evenly()), 0.0, np.nan)
    for k, raw in enumerate(rows):
        following, _ = step(following, raw, params)
        state, rival, recalled = following.state, following.overthrown, following.recalled
        if recalled is not None:
            # What was believed meanwhile was wrong.
            counts[np.searchsorted(time_s, recalled.seen_s, side="right") : k] = False
        if state is not None:
            # The poses of a rival were gated when they came.
            since = k if rival is None else int(np.searchsorted(time_s, rival.since_s))
            jumped[since] |= rival is not None and not rival.goes_on
            if state.support == 1 or jumped[since]:
                told.append(False)
            start[since : k + 1], told[-1] = len(told) - 1, confirmed(following, params)
            counts[since : k + 1] = has_pose[since : k + 1] & (state.seen_s == raw.time_s)
            known = _log_levels(state.log_weight), float(np.log(state.noise_scale)), state.ambiguity
        found.append(known)
    log_levels, log_noise_scale, ambiguity = (np.array(values) for values in zip(*found, strict=True))
    counts &= np.array(told)[start]
    return _Learned(counts, np.cumsum(jumped), log_levels, log_noise_scale, ambiguity)


def _spans(
    time_s: Float[np.ndarray, "frames"],
    counts: Bool[np.ndarray, "frames"],
    jumps: Int[np.ndarray, "frames"],
    longest_gap_s: float,
) -> Iterator[slice]:
    """Frames without a jump or too long a gap, from a pose that counts to where it is too long ago."""
    seen = np.flatnonzero(counts)
    apart = (np.diff(time_s[seen]) > 2 * longest_gap_s) | (np.diff(jumps[seen]) != 0)
    ends = np.append(np.flatnonzero(apart), len(seen) - 1) if len(seen) else np.array([], int)
    first = 0
    for end in ends:
        after = seen[end + 1] if end + 1 < len(seen) else len(time_s)
        told = int(np.searchsorted(time_s, time_s[seen[end]] + longest_gap_s, side="right"))
        yield slice(int(seen[first]), int(min(after, told)))
        first = end + 1


def _smoothed(
    rows: Sequence[PoseRow],
    counts: Bool[np.ndarray, "frames"],
    log_levels: Float[np.ndarray, "frames 2"],
    noise_scale: Float[np.ndarray, "frames"],
) -> list[PoseEstimate]:
    """The poses of frames, of which the first counts, from all of them that count."""
    passes = _forward(rows, counts, log_levels, noise_scale)
    later = passes[-1].corrected
    poses = [_estimate(later)]
    for now, ahead in zip(passes[-2::-1], passes[:0:-1], strict=True):
        later = _earlier(now.corrected, ahead, later)
        poses.append(_estimate(later))
    return poses[::-1]


def _forward(
    rows: Sequence[PoseRow],
    counts: Bool[np.ndarray, "frames"],
    log_levels: Float[np.ndarray, "frames 2"],
    noise_scale: Float[np.ndarray, "frames"],
) -> list[_Pass]:
    passes: list[_Pass] = []
    for k, raw in enumerate(rows):
        levels = Levels(np.exp(log_levels[k, :1]), np.exp(log_levels[k, 1:]))
        pose = measured(raw)
        covariance = noise_scale[k] * pose.covariance
        if not passes:
            motion = pose_motion.begun(
                pose.position_m, pose.orientation_wxyz, covariance, pose.common, levels
            )
            nothing = np.zeros_like(motion.covariance)
            passes.append(_Pass(motion, nothing, nothing, motion))
            continue
        dt_s = raw.time_s - rows[k - 1].time_s
        foretold, F = pose_motion.foretold(passes[-1].corrected, dt_s, levels)
        corrected = foretold
        if counts[k]:
            told = pose_motion.innovation(
                foretold, pose.position_m, pose.orientation_wxyz, covariance, pose.common
            )
            right = right_pose(told.pose[0], told.whole_covariance[0], pose.ambiguity)
            corrected = pose_motion.corrected(foretold, told, right)
        passes.append(_Pass(foretold, F, pose_motion.process_noise(dt_s, levels), corrected))
    return passes


def _earlier(now: Motion, ahead: _Pass, later: Motion) -> Motion:
    """A frame by all frames, from it by those up to it, and the next one by all."""
    gain = _gain(ahead.F @ now.covariance, ahead.foretold.covariance)
    change = pose_motion.difference(ahead.foretold, later)
    # Its covariance is about the axes of the camera as it is turned there; here, as it was foretold.
    J = np.eye(pose_motion.SIZE)[None]
    J[:, 9:12, 9:12] = right_jacobian_inverse(change[:, 9:12])
    # P + G (P_later - P_ahead) Gᵀ would be a difference, and negative after many frames. This is a sum.
    kept = np.eye(pose_motion.SIZE) - gain @ ahead.F
    added = ahead.Q + J @ later.covariance @ J.swapaxes(1, 2)
    spread = kept @ now.covariance @ kept.swapaxes(1, 2) + gain @ added @ gain.swapaxes(1, 2)
    off = now.common + gain @ (J @ later.common - ahead.foretold.common)
    return pose_motion.moved(
        replace(now, covariance=(spread + spread.swapaxes(1, 2)) / 2, common=off),
        (gain @ change[:, :, None])[:, :, 0],
    )


def _gain(
    transported: Float[np.ndarray, "1 n n"], ahead: Float[np.ndarray, "1 n n"]
) -> Float[np.ndarray, "1 n n"]:
    """P Fᵀ P_ahead⁻¹ of F P and P_ahead, in standard deviations, so that metres and radians count alike."""
    unit = np.sqrt(np.einsum("lii->li", ahead))[:, :, None]
    correlation = ahead / (unit * unit.swapaxes(1, 2))
    return (np.linalg.solve(correlation, transported / unit) / unit).swapaxes(1, 2)


def _estimate(motion: Motion) -> PoseEstimate:
    common = motion.common[0, POSE]
    covariance = motion.covariance[0][np.ix_(POSE, POSE)] + common @ common.T
    return PoseEstimate(motion.position_m[0], motion.orientation_wxyz[0], covariance, motion.velocity_m_s[0])


def _log_levels(log_weight: Float[np.ndarray, "levels"]) -> Float[np.ndarray, "2"]:
    """Logarithms of the densities of jerk and wobble that these weights amount to."""
    densities = np.stack([LEVELS.jerk_density_m2_s5, LEVELS.wobble_density_rad2_s3])
    return np.log(densities) @ np.exp(log_weight)


def _evenly() -> Float[np.ndarray, "levels"]:
    """Logarithms of weights that are all the same."""
    return np.full(len(LEVELS.jerk_density_m2_s5), -np.log(len(LEVELS.jerk_density_m2_s5)))
