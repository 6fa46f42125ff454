"""Poses of marker crosses over time: correction of labels, bridging of gaps, interpolation between frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from psotrack.recordings.mocap.marker_crosses import (
    TOLERANCE_M,
    Cross,
    fit_rigid,
    identify_markers,
    within_usual_residual,
)

#: Time before and after a gap from which the velocities at its ends are computed by parabolas, seconds.
_SLOPE_S = 0.1
#: Largest distance of a time from a frame that is ignored as rounding, in frames.
_SAME_FRAME = 1e-6


@dataclass(frozen=True)
class CrossPoses:
    """The poses of one cross.

    Attributes:
        position_m: (frames, 3), centroid of the learned cross in the world, metres; NaN if unknown. The centroid does
            not jump when a marker appears or disappears.
        orientation_wxyz: (frames, 4), unit quaternions from cross to world; NaN if unknown.
        bridged: (frames,), True where the pose is interpolated over a gap.
    """

    position_m: Float[np.ndarray, "frames 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]
    bridged: Bool[np.ndarray, "frames"]


def estimate_poses(
    cross: Cross,
    position_m: Float[np.ndarray, "frames markers 3"],
    rate_hz: float,
    *,
    max_gap_s: float = 0.5,
) -> CrossPoses:
    """Poses of a cross in every frame of a recording, by least squares; three seen markers are enough.

    In frames with an unusually large residual, the labels are corrected from the distances. Frames that do not fit even
    then are gaps. Gaps are bridged by a cubic for the position, with the velocities at the ends of the gap, and by the
    shortest turn at constant speed (slerp) for the orientation.

    Args:
        cross: cross from `learn_cross`, with its markers in the order of `position_m`.
        position_m: (frames, markers, 3), positions in the world, metres; NaN if a marker is not seen.
        rate_hz: frames per second of the recording.
        max_gap_s: longest gap that is bridged, seconds; frames before the first and after the last pose stay NaN.
    """
    fits = fit_rigid(cross.markers_m, correct_labels(cross, position_m))
    known = np.isfinite(fits.rotation[:, 0, 0])
    orientation_wxyz = np.full((len(known), 4), np.nan)
    if known.any():
        turns = Rotation.from_matrix(fits.rotation[known])
        orientation_wxyz[known] = turns.as_quat(scalar_first=True)
    with_gaps = CrossPoses(fits.position_m, orientation_wxyz, np.zeros(len(known), bool))
    return _bridge_gaps(with_gaps, rate_hz, max_gap_s)


def correct_labels(
    cross: Cross, position_m: Float[np.ndarray, "frames markers 3"]
) -> Float[np.ndarray, "frames markers 3"]:
    """(frames, markers, 3), markers with corrected labels and without stray points; NaN in frames without a fit."""
    residual_m = fit_rigid(cross.markers_m, position_m).residual_m
    corrected_m = position_m.copy()
    for frame in np.flatnonzero(np.isfinite(residual_m) & ~within_usual_residual(residual_m)):
        seen_m = position_m[frame, np.isfinite(position_m[frame]).all(axis=-1)]
        marker = identify_markers(cross, seen_m)
        if (marker >= 0).any():
            corrected_m[frame] = np.nan
            corrected_m[frame, marker[marker >= 0]] = seen_m[marker >= 0]
        elif residual_m[frame] > TOLERANCE_M:
            corrected_m[frame] = np.nan
    return corrected_m


def complete_markers(
    cross: Cross,
    position_m: Float[np.ndarray, "frames markers 3"],
    unlabelled_m: Float[np.ndarray, "frames points 3"],
) -> Float[np.ndarray, "frames markers 3"]:
    """Find markers that lost their labels among unlabelled points, by their distances.

    If a marker has kept its label, three found markers are enough; without any label, all markers must be found.

    Args:
        cross: the cross.
        position_m: (frames, markers, 3), labelled markers in the world, metres; NaN if a marker is not seen.
        unlabelled_m: (frames, points, 3), unlabelled points in the world, metres; NaN if a point is not seen.

    Returns:
        (frames, markers, 3), labelled and found markers.
    """
    seen, seen_unlabelled = (np.isfinite(points_m).all(axis=-1) for points_m in (position_m, unlabelled_m))
    reach_m = 2 * np.linalg.norm(cross.markers_m, axis=1).max() + TOLERANCE_M
    complete_m = position_m.copy()
    for frame in np.flatnonzero(~seen.all(axis=1) & seen_unlabelled.any(axis=1)):
        own_m, points_m = position_m[frame, seen[frame]], unlabelled_m[frame, seen_unlabelled[frame]]
        for marker_m in own_m:
            points_m = points_m[np.linalg.norm(points_m - marker_m, axis=1) <= reach_m]
        both_m = np.vstack([own_m, points_m])
        marker = identify_markers(cross, both_m)
        found, kept = marker >= 0, (marker[: len(own_m)] >= 0).all()
        if kept and found.sum() > len(own_m) and (len(own_m) or found.sum() == len(cross.markers_m)):
            complete_m[frame] = np.nan
            complete_m[frame, marker[found]] = both_m[found]
    return complete_m


def interpolate_poses(found: CrossPoses, rate_hz: float, time_s: Float[np.ndarray, "times"]) -> CrossPoses:
    """Interpolate poses at any times; NaN if the pose before or after the time is unknown.

    Positions are interpolated linearly, with an error of 0.05 mm at 100 Hz and 4 m/s²; orientations by slerp.

    Args:
        found: poses at the frames of the recording.
        rate_hz: frames per second of the recording, whose frame 0 is at 0 s.
        time_s: (times,), times in any order, seconds; poses outside of the recording are NaN.
    """
    before, after, share = _between(len(found.bridged), rate_hz, time_s)
    inside = before >= 0
    # For the time of a frame, `before` and `after` are both this frame.
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
        bridged=inside & found.bridged[[before, after]].any(axis=0),
    )


def _between(
    num_frames: int, rate_hz: float, time_s: Float[np.ndarray, "times"]
) -> tuple[Int[np.ndarray, "times"], Int[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """Frames before and after each time (both -1 outside of the recording), and the fraction between them, 0 to 1."""
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
    """Linear interpolation between two frames; NaN if one value is NaN or the time is outside of the recording."""
    weight = share.reshape(-1, *[1] * (values.ndim - 1))
    mixed = (1 - weight) * values[before] + weight * values[after]
    mixed[before < 0] = np.nan
    return mixed


def _bridge_gaps(with_gaps: CrossPoses, rate_hz: float, max_gap_s: float) -> CrossPoses:
    """Poses with gaps up to `max_gap_s` filled."""
    position_m, orientation_wxyz = with_gaps.position_m.copy(), with_gaps.orientation_wxyz.copy()
    bridged = with_gaps.bridged.copy()
    placed = np.flatnonzero(np.isfinite(with_gaps.position_m[:, 0]))
    steps = np.diff(placed)
    # The length of a gap is the number of missing frames: 5 missing frames at 100 Hz are 0.05 s.
    short = (steps > 1) & ((steps - 1) / rate_hz <= max_gap_s + 1e-9)
    for start, end in zip(placed[:-1][short], placed[1:][short], strict=True):
        inner = np.arange(start + 1, end)
        bridged[inner] = True
        ends = with_gaps.position_m[[start, end]]
        chord = (ends[1] - ends[0]) / (end - start)
        reach = max(1, round(_SLOPE_S * rate_hz))
        slopes = [
            _slope(with_gaps.position_m, placed[(placed <= start) & (placed >= start - reach)], start, chord),
            _slope(with_gaps.position_m, placed[(placed >= end) & (placed <= end + reach)], end, chord),
        ]
        position_m[inner] = CubicHermiteSpline([start, end], ends, slopes)(inner)
        turns = with_gaps.orientation_wxyz[[start, end]]
        if np.isfinite(turns).all():
            slerp = Slerp([start, end], Rotation.from_quat(turns, scalar_first=True))
            orientation_wxyz[inner] = slerp(inner).as_quat(scalar_first=True)
    return CrossPoses(position_m, orientation_wxyz, bridged)


def _slope(
    position_m: Float[np.ndarray, "frames 3"],
    frames: Int[np.ndarray, "near"],
    at: np.integer,
    chord: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """Velocity at one end of a gap, metres per frame; the mean velocity over the gap if only one pose is near."""
    if len(frames) < 2:
        return chord
    return np.polyfit(frames - at, position_m[frames], min(2, len(frames) - 1))[-2]
