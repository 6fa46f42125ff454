"""Poses of marker crosses over time: labels put right, gaps bridged and flagged, any moment in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from psotrack.recordings.marker_crosses import (
    TOLERANCE_M,
    Cross,
    fit_rigid,
    identify_markers,
    within_usual_residual,
)

#: Velocities at the ends of a gap are those of parabolas through what is seen in so long.
_SLOPE_S = 0.1
#: Times that are nearer to a frame than this share of the time between two are that frame's: their rounding.
_SAME_FRAME = 1e-6


@dataclass(frozen=True)
class CrossPoses:
    """The poses of one cross.

    Attributes:
        position_m: (frames, 3), the centroid of the whole cross as it was learned, world; NaN where it is not known. It
            does not jump when a marker comes or goes.
        orientation_wxyz: (frames, 4), unit quaternions, cross to world; NaN where they are not known.
        residual_m: (frames,), root mean square distance of the markers seen from their places; NaN without a fit.
        num_markers: (frames,), markers seen that belong to the fit.
        bridged: (frames,), where the pose is that between the ends of a gap.
    """

    position_m: Float[np.ndarray, "frames 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]
    residual_m: Float[np.ndarray, "frames"]
    num_markers: Int[np.ndarray, "frames"]
    bridged: Bool[np.ndarray, "frames"]


def estimate_poses(
    cross: Cross,
    position_m: Float[np.ndarray, "frames markers 3"],
    rate_hz: float,
    *,
    max_gap_s: float = 0.5,
) -> CrossPoses:
    """The pose of a cross in every frame of a recording, by least squares; three of its markers are enough.

    In frames that fit worse than the others, labels are told from the distances anew; what does not fit even then is
    a gap. Gaps are bridged by a cubic for the position, with the velocities at their ends, and the shortest turn at
    constant speed (slerp) for the orientation.

    Args:
        cross: as `learn_cross` made it, its markers in the order of `position_m`.
        position_m: (frames, markers, 3), world; NaN where a marker is not seen.
        rate_hz: frames per second.
        max_gap_s: longer gaps stay NaN, as do those before the first pose and after the last.
    """
    found = fit_rigid(cross.markers_m, correct_labels(cross, position_m))
    known = np.isfinite(found.rotation[:, 0, 0])
    orientation_wxyz = np.full((len(known), 4), np.nan)
    if known.any():
        turns = Rotation.from_matrix(found.rotation[known])
        orientation_wxyz[known] = turns.as_quat(scalar_first=True)
    gappy = CrossPoses(
        found.position_m, orientation_wxyz, found.residual_m, found.num_markers, np.zeros(len(known), bool)
    )
    return _bridged(gappy, rate_hz, max_gap_s)


def correct_labels(
    cross: Cross, position_m: Float[np.ndarray, "frames markers 3"]
) -> Float[np.ndarray, "frames markers 3"]:
    """The markers with swapped labels put right, and strays taken out; frames in which nothing fits are NaN."""
    residual_m = fit_rigid(cross.markers_m, position_m).residual_m
    right_m = position_m.copy()
    for frame in np.flatnonzero(np.isfinite(residual_m) & ~within_usual_residual(residual_m)):
        seen_m = position_m[frame, np.isfinite(position_m[frame]).all(axis=-1)]
        marker = identify_markers(cross, seen_m)
        if (marker >= 0).any():
            right_m[frame] = np.nan
            right_m[frame, marker[marker >= 0]] = seen_m[marker >= 0]
        elif residual_m[frame] > TOLERANCE_M:
            right_m[frame] = np.nan
    return right_m


def complete_markers(
    cross: Cross,
    position_m: Float[np.ndarray, "frames markers 3"],
    unlabelled_m: Float[np.ndarray, "frames points 3"],
) -> Float[np.ndarray, "frames markers 3"]:
    """The markers, with those that lost their labels found among unlabelled points by their distances.

    Beside markers that kept their labels, three in all are enough; without any, the whole cross must be there.
    """
    seen, there = (np.isfinite(points_m).all(axis=-1) for points_m in (position_m, unlabelled_m))
    reach_m = 2 * np.linalg.norm(cross.markers_m, axis=1).max() + TOLERANCE_M
    whole_m = position_m.copy()
    for frame in np.flatnonzero(~seen.all(axis=1) & there.any(axis=1)):
        own_m, points_m = position_m[frame, seen[frame]], unlabelled_m[frame, there[frame]]
        for one_m in own_m:
            points_m = points_m[np.linalg.norm(points_m - one_m, axis=1) <= reach_m]
        both_m = np.vstack([own_m, points_m])
        marker = identify_markers(cross, both_m)
        found, kept = marker >= 0, (marker[: len(own_m)] >= 0).all()
        if kept and found.sum() > len(own_m) and (len(own_m) or found.sum() == len(cross.markers_m)):
            whole_m[frame] = np.nan
            whole_m[frame, marker[found]] = both_m[found]
    return whole_m


def interpolate_poses(found: CrossPoses, rate_hz: float, time_s: Float[np.ndarray, "times"]) -> CrossPoses:
    """The poses at other times than the recording's frames: between two of them, NaN where one is not known.

    Positions are interpolated linearly, which at 100 Hz and 4 m/s² is 0.05 mm off; orientations by slerp.

    Args:
        found: the poses.
        rate_hz: of the recording, whose frame 0 is at 0 s.
        time_s: (times,), in any order; outside of the recording there are none.
    """
    before, after, share = _between(len(found.bridged), rate_hz, time_s)
    inside = before >= 0
    # Where a time is a frame's, `after` is that frame too.
    position_m = _lerp(found.position_m, before, after, share)
    orientation_wxyz = np.full((len(time_s), 4), np.nan)
    turned = inside & np.isfinite(found.orientation_wxyz[[before, after], 0]).all(axis=0)
    if turned.any():
        start, end = (
            Rotation.from_quat(found.orientation_wxyz[index[turned]], scalar_first=True)
            for index in (before, after)
        )
        step = Rotation.from_rotvec((start.inv() * end).as_rotvec() * share[turned, None])
        orientation_wxyz[turned] = (start * step).as_quat(scalar_first=True)
    return CrossPoses(
        position_m=position_m,
        orientation_wxyz=orientation_wxyz,
        residual_m=np.where(inside, found.residual_m[[before, after]].max(axis=0), np.nan),
        num_markers=np.where(inside, found.num_markers[[before, after]].min(axis=0), 0),
        bridged=inside & found.bridged[[before, after]].any(axis=0),
    )


def _between(
    num_frames: int, rate_hz: float, time_s: Float[np.ndarray, "times"]
) -> tuple[Int[np.ndarray, "times"], Int[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """The frames before and after each time, both -1 outside of the recording, and the share of the way between."""
    index = time_s * rate_hz
    nearest = np.round(index)
    index = np.where(np.abs(index - nearest) < _SAME_FRAME, nearest, index)
    before, after = np.floor(index), np.ceil(index)
    outside = (before < 0) | (after > num_frames - 1)
    return (
        np.where(outside, -1, before).astype(int),
        np.where(outside, -1, after).astype(int),
        np.where(outside, 0.0, index - before),
    )


def _lerp(
    values: Float[np.ndarray, "frames *rest"],
    before: Int[np.ndarray, "times"],
    after: Int[np.ndarray, "times"],
    share: Float[np.ndarray, "times"],
) -> Float[np.ndarray, "times *rest"]:
    """The values between two frames; NaN where one is NaN, or there is no such frame."""
    weight = share.reshape(-1, *[1] * (values.ndim - 1))
    mixed = (1 - weight) * values[before] + weight * values[after]
    mixed[before < 0] = np.nan
    return mixed


def _bridged(gappy: CrossPoses, rate_hz: float, max_gap_s: float) -> CrossPoses:
    """Gaps that are not too long filled."""
    position_m, orientation_wxyz = gappy.position_m.copy(), gappy.orientation_wxyz.copy()
    bridged = gappy.bridged.copy()
    placed = np.flatnonzero(np.isfinite(gappy.position_m[:, 0]))
    steps = np.diff(placed)
    # 5 frames missing of 100 Hz are 0.05 s unseen.
    short = (steps > 1) & ((steps - 1) / rate_hz <= max_gap_s + 1e-9)
    for start, end in zip(placed[:-1][short], placed[1:][short], strict=True):
        inner = np.arange(start + 1, end)
        bridged[inner] = True
        ends = gappy.position_m[[start, end]]
        chord = (ends[1] - ends[0]) / (end - start)
        reach = max(1, round(_SLOPE_S * rate_hz))
        slopes = [
            _slope(gappy.position_m, placed[(placed <= start) & (placed >= start - reach)], start, chord),
            _slope(gappy.position_m, placed[(placed >= end) & (placed <= end + reach)], end, chord),
        ]
        position_m[inner] = CubicHermiteSpline([start, end], ends, slopes)(inner)
        turns = gappy.orientation_wxyz[[start, end]]
        if np.isfinite(turns).all():
            slerp = Slerp([start, end], Rotation.from_quat(turns, scalar_first=True))
            orientation_wxyz[inner] = slerp(inner).as_quat(scalar_first=True)
    return CrossPoses(position_m, orientation_wxyz, gappy.residual_m, gappy.num_markers, bridged)


def _slope(
    position_m: Float[np.ndarray, "frames 3"],
    frames: Int[np.ndarray, "near"],
    at: np.integer,
    chord: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """Metres per frame at one end of a gap; that of the gap's chord where a single pose is near."""
    if len(frames) < 2:
        return chord
    return np.polyfit(frames - at, position_m[frames], min(2, len(frames) - 1))[-2]
