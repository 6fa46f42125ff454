"""Poses of marker crosses over time: labels are corrected from the distances, and short gaps are bridged."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from psotrack.recordings.mocap.marker_crosses import MIN_MARKERS, NOISE_M, fit_rigid, within_usual_residual

#: Largest root mean square residual of a fit, metres: about a marker's radius. A larger one means wrong labels.
_TOLERANCE_M = 0.01
#: Smallest ratio of the second-best residual to the best residual of a unique labelling.
_UNIQUE_RATIO = 2.0
#: Longest gap that is bridged, seconds.
_MAX_GAP_S = 0.5
#: Time before and after a gap from which the velocities at its ends are computed by parabolas, seconds.
_SLOPE_S = 0.1


def cross_poses(
    markers_m: Float[np.ndarray, "markers 3"],
    position_m: Float[np.ndarray, "frames markers 3"],
    rate_hz: float,
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 4"], Bool[np.ndarray, "frames"]]:
    """Poses of a cross in every frame of a recording, by least squares; three seen markers are enough.

    Frames that do not fit, even with corrected labels, are gaps. Gaps up to half a second are bridged by a cubic for
    the position, with the velocities at the ends of the gap, and by the shortest turn at constant speed (slerp) for the
    orientation.

    Args:
        markers_m: (markers, 3), the cross, from `learn_cross`.
        position_m: (frames, markers, 3), positions in the world, metres; NaN if a marker is not seen.
        rate_hz: frames per second of the recording.

    Returns:
        (frames, 3), centroids of the cross in the world, metres; (frames, 4), unit quaternions from cross to world; and
        (frames,), True where the pose is interpolated over a gap. Unknown poses are NaN.
    """
    fits = fit_rigid(markers_m, correct_labels(markers_m, position_m))
    orientation_wxyz = np.full((len(position_m), 4), np.nan)
    known = np.isfinite(fits.rotation[:, 0, 0])
    if known.any():
        orientation_wxyz[known] = Rotation.from_matrix(fits.rotation[known]).as_quat(scalar_first=True)
    return _bridge_gaps(fits.position_m, orientation_wxyz, rate_hz)


def correct_labels(
    markers_m: Float[np.ndarray, "markers 3"], position_m: Float[np.ndarray, "frames markers 3"]
) -> Float[np.ndarray, "frames markers 3"]:
    """(frames, markers, 3), markers with corrected labels and without stray points; NaN in frames without a fit."""
    residual_m = fit_rigid(markers_m, position_m).residual_m
    corrected_m = position_m.copy()
    for frame in np.flatnonzero(np.isfinite(residual_m) & ~within_usual_residual(residual_m)):
        seen = np.isfinite(position_m[frame]).all(axis=-1)
        found_m = identify_markers(markers_m, position_m[frame, seen])
        if residual_m[frame] > _TOLERANCE_M or np.isfinite(found_m).any():
            corrected_m[frame] = found_m
    return corrected_m


def identify_markers(
    markers_m: Float[np.ndarray, "markers 3"], points_m: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "markers 3"]:
    """Find the markers of a cross among points in any order, from the distances alone.

    Returns:
        (markers, 3), the point of each marker, metres; NaN for a marker without a point. As many markers as possible
        have a point. All are NaN if no three points fit, or if another labelling fits almost as well, as for a
        symmetric cross.
    """
    point_or_none_m = np.vstack([points_m, np.full((1, 3), np.nan)])
    for count in range(min(len(points_m), len(markers_m)), MIN_MARKERS - 1, -1):
        found_m = point_or_none_m[_labellings(markers_m, points_m, count)]
        residual_m = fit_rigid(markers_m, found_m).residual_m
        best = np.argsort(residual_m)[:2]
        if not (residual_m[best[:1]] <= _TOLERANCE_M).any():
            continue
        rival_m = _UNIQUE_RATIO * residual_m[best[0]] + NOISE_M
        if (residual_m[best[1:]] <= min(rival_m, _TOLERANCE_M)).any():
            break
        return found_m[best[0]]
    return np.full_like(markers_m, np.nan)


def _labellings(
    markers_m: Float[np.ndarray, "markers 3"], points_m: Float[np.ndarray, "points 3"], count: int
) -> Int[np.ndarray, "labellings markers"]:
    """The point of each marker, for all labellings of `count` markers or more in which the distances agree.

    A marker without a point has the index after the last point.
    """
    num_markers, no_point = len(markers_m), len(points_m)
    # Markers without a point agree with every other marker.
    agree = np.ones((num_markers, num_markers, no_point + 1, no_point + 1), bool)
    off_m = _distances(markers_m)[:, :, None, None] - _distances(points_m)
    agree[:, :, :no_point, :no_point] = (np.abs(off_m) <= 2 * _TOLERANCE_M) & ~np.eye(no_point, dtype=bool)
    found = np.zeros((1, 0), int)
    for marker in range(num_markers):
        fits = np.ones((len(found), no_point + 1), bool)
        for other in range(marker):
            fits &= agree[other, marker, found[:, other]]
        rows, points = np.nonzero(fits)
        found = np.column_stack([found[rows], points])
        most = (found != no_point).sum(axis=1) + num_markers - marker - 1
        found = found[most >= count]
    return found


def _distances(points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points points"]:
    return np.linalg.norm(points_m[:, None] - points_m, axis=-1)


def _bridge_gaps(
    position_m: Float[np.ndarray, "frames 3"],
    orientation_wxyz: Float[np.ndarray, "frames 4"],
    rate_hz: float,
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 4"], Bool[np.ndarray, "frames"]]:
    """Poses with short gaps filled, and the frames that were filled."""
    bridged_m, bridged_wxyz = position_m.copy(), orientation_wxyz.copy()
    placed = np.flatnonzero(np.isfinite(position_m[:, 0]))
    steps = np.diff(placed)
    # The length of a gap is the number of missing frames: 5 missing frames at 100 Hz are 0.05 s.
    short = (steps > 1) & ((steps - 1) / rate_hz <= _MAX_GAP_S + 1e-9)
    bridged = np.zeros(len(position_m), bool)
    reach = max(1, round(_SLOPE_S * rate_hz))
    for start, end in zip(placed[:-1][short], placed[1:][short], strict=True):
        inner = np.arange(start + 1, end)
        bridged[inner] = True
        chord = (position_m[end] - position_m[start]) / (end - start)
        before = placed[(placed <= start) & (placed >= start - reach)]
        after = placed[(placed >= end) & (placed <= end + reach)]
        slopes = [_slope(position_m, before, start, chord), _slope(position_m, after, end, chord)]
        bridged_m[inner] = CubicHermiteSpline([start, end], position_m[[start, end]], slopes)(inner)
        turns = orientation_wxyz[[start, end]]
        if np.isfinite(turns).all():
            slerp = Slerp([start, end], Rotation.from_quat(turns, scalar_first=True))
            bridged_wxyz[inner] = slerp(inner).as_quat(scalar_first=True)
    return bridged_m, bridged_wxyz, bridged


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
