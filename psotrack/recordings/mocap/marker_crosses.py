"""Marker crosses: rigid bodies of a few motion-capture markers, whose shape is learned from a recording.

Each drone of the DPJAIT dataset carries four or five markers that form an asymmetric cross. Rigid fits are least
squares (Kabsch 1976; Umeyama 1991, without scale); the shape is a generalised Procrustes mean (Gower 1975). In the
poses over time, labels are corrected from the distances, and short gaps are bridged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from psotrack.errors import InputError

#: A cross in its own frame, and its recorded markers in the world, metres; NaN if a marker is not seen.
Cross = Float[np.ndarray, "markers 3"]
Seen = Float[np.ndarray, "frames markers 3"]
_Points = Float[np.ndarray, "frames 3"]
_Candidates = Float[np.ndarray, "points 3"]
_Frames = Bool[np.ndarray, "frames"]
#: Centroids in the world, metres; unit quaternions from cross to world; and where the pose is interpolated over a gap.
Poses = tuple[_Points, Float[np.ndarray, "frames 4"], _Frames]

#: Smallest root mean square distance of markers from a line, metres; nearer markers do not determine the turn about it.
_LINE_M = 0.005
#: Noise of a motion-capture system, metres, added where residuals are compared.
NOISE_M = 0.001
#: Smallest number of markers that determines a pose.
MIN_MARKERS = 3
#: Largest number of iterations of the Procrustes mean.
_NUM_ROUNDS = 20
#: Largest change of a marker in the last iteration of the Procrustes mean, metres.
_CONVERGED_M = 1e-7


@dataclass(frozen=True)
class RigidFit:
    """Rigid fits of a cross to its seen markers in every frame.

    Attributes:
        rotation: (frames, 3, 3), rotation from cross to world; NaN if fewer than three markers are seen, or if all
            seen markers lie on a line.
        position_m: (frames, 3), centroid of all markers in the world, metres; NaN like the rotation, but known if all
            markers are seen.
        residual_m: (frames,), root mean square distance of the seen markers from the fitted cross, metres; NaN like
            the rotation.
    """

    rotation: Float[np.ndarray, "frames 3 3"]
    position_m: _Points
    residual_m: Float[np.ndarray, "frames"]


def fit_rigid(markers_m: Cross, position_m: Seen) -> RigidFit:
    """Least-squares poses of a body in every frame, from its seen markers.

    Args:
        markers_m: (markers, 3), markers in the body's frame with the centroid at the origin, metres.
        position_m: (frames, markers, 3), positions in the world, metres; NaN if a marker is not seen.
    """
    seen = np.isfinite(position_m).all(axis=-1)
    count = seen.sum(axis=1)
    share = seen / np.maximum(count, 1)[:, None]
    world_m = np.where(seen[..., None], position_m, 0.0)
    middle_body = share @ markers_m
    middle_world = np.einsum("fm,fmi->fi", share, world_m)
    body, world = markers_m - middle_body[:, None], world_m - middle_world[:, None]
    left, _, right = np.linalg.svd(np.einsum("fm,fmi,fmj->fij", share, world, body))
    # Reflections are excluded: for a flat cross a reflection fits as well as the rotation.
    right[:, 2] *= np.linalg.det(left @ right)[:, None]
    rotation = left @ right
    # The second eigenvalue of the seen markers' covariance is their mean squared distance from a line.
    width_m2 = np.linalg.eigvalsh(np.einsum("fm,fmi,fmj->fij", share, body, body))[:, 1]
    turned = (count >= MIN_MARKERS) & (width_m2 > _LINE_M**2)
    off_m2 = ((world - np.einsum("fij,fmj->fmi", rotation, body)) ** 2).sum(axis=-1)
    position = middle_world - np.einsum("fij,fj->fi", rotation, middle_body)
    placed = turned | (count == len(markers_m))
    return RigidFit(
        rotation=np.where(turned[:, None, None], rotation, np.nan),
        position_m=np.where(placed[:, None], position, np.nan),
        residual_m=np.where(turned, np.sqrt((share * off_m2).sum(axis=1)), np.nan),
    )


def learn_cross(position_m: Seen, name: str = "") -> Cross:
    """Learn the shape of a recorded cross: a generalised Procrustes mean over the frames whose markers fit.

    The mean starts from the medians of all distances. Swapped labels and stray markers in less than half of the frames
    therefore have no influence, and no frame needs to see all markers.

    Args:
        position_m: (frames, markers, 3), positions in the world, metres; NaN if a marker is not seen.
        name: name of the body, for messages.

    Returns:
        (markers, 3), positions of the markers in the body's frame, metres. The origin is the centroid. z is the normal
        of the plane that fits the markers best and points upwards in flight. x points to the first marker.

    Raises:
        InputError: two of the markers are never seen together.
    """
    markers_m = _shape_from_distances(position_m, name)
    fitted = _better_mirror_image(markers_m, position_m)
    if fitted is None:
        return markers_m
    markers_m, pose = fitted
    for _ in range(_NUM_ROUNDS):
        before_m, markers_m = markers_m, _mean_shape(markers_m, pose, position_m)
        pose = fit_rigid(markers_m, position_m)
        if np.abs(markers_m - before_m).max() < _CONVERGED_M:
            break
    axes = _axes(markers_m, up=np.nanmean(pose.rotation[:, 2], axis=0))
    return markers_m @ axes.T


def _shape_from_distances(position_m: Seen, name: str) -> Cross:
    """Shape with the median distances, by classical scaling (Torgerson 1952); it may be a mirror image."""
    distances_m = np.linalg.norm(position_m[:, :, None] - position_m[:, None], axis=-1)
    together = np.isfinite(distances_m).any(axis=0)
    if not together.all():
        first, second = np.argwhere(~together)[0] + 1
        raise InputError(
            f"cross {name}",
            expected="every two markers seen together in some frame",
            found=f"{first} and {second} never" if first != second else f"marker {first} never seen",
        )
    squares = np.nanmedian(distances_m, axis=0) ** 2
    centring = np.eye(len(squares)) - 1 / len(squares)
    values, vectors = np.linalg.eigh(-0.5 * centring @ squares @ centring)
    shape = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, ::-1][:, :3]
    return np.pad(shape - shape.mean(axis=0), ((0, 0), (0, max(0, 3 - len(squares)))))


def _better_mirror_image(markers_m: Cross, position_m: Seen) -> tuple[Cross, RigidFit] | None:
    """The better of a shape and its mirror image, with its fits; None if the markers lie on a line."""
    mirrored_m = markers_m * [1.0, 1.0, -1.0]
    fits = [(shape_m, fit_rigid(shape_m, position_m)) for shape_m in (markers_m, mirrored_m)]
    if np.isnan(fits[0][1].residual_m).all():
        return None
    return min(fits, key=lambda fit: float(np.nanmedian(fit[1].residual_m)))


def _mean_shape(markers_m: Cross, pose: RigidFit, position_m: Seen) -> Cross:
    """Mean of the markers in the body's frame over the frames that fit, with the centroid at the origin."""
    fitting: _Frames = within_usual_residual(pose.residual_m)
    in_body = np.einsum(
        "fji,fmj->fmi", pose.rotation[fitting], position_m[fitting] - pose.position_m[fitting, None]
    )
    seen = np.isfinite(in_body).all(axis=-1)
    total = np.where(seen[..., None], in_body, 0.0).sum(axis=0)
    count = seen.sum(axis=0)[:, None]
    mean_m = np.where(count > 0, total / np.maximum(count, 1), markers_m)
    return mean_m - mean_m.mean(axis=0)


def within_usual_residual(residual_m: Float[np.ndarray, "frames"]) -> _Frames:
    """True where a residual is at most three times the recording's median plus noise; False where it is NaN."""
    known = residual_m[np.isfinite(residual_m)]
    limit_m = 3 * np.median(known) + NOISE_M if len(known) else 0.0
    return np.isfinite(residual_m) & (residual_m <= limit_m)


def _axes(markers_m: Cross, up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """(3, 3), axes of the cross's own frame as rows.

    The axes depend on the shape and the upward direction only, so that two recordings give the same frame.
    """
    z = np.linalg.svd(markers_m)[2][2]
    z = z if z @ up >= 0 else -z
    flat_m = markers_m - np.outer(markers_m @ z, z)
    x = flat_m[np.argmax(np.linalg.norm(flat_m, axis=1) > _LINE_M)]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


#: Largest root mean square residual of a fit, metres: about a marker's radius. A larger one means wrong labels.
_TOLERANCE_M = 0.01
#: Smallest ratio of the second-best residual to the best residual of a unique labelling.
_UNIQUE_RATIO = 2.0
#: Longest gap that is bridged, seconds.
_MAX_GAP_S = 0.5
#: Time before and after a gap from which the velocities at its ends are computed by parabolas, seconds.
_SLOPE_S = 0.1


def cross_poses(markers_m: Cross, position_m: Seen, rate_hz: float) -> Poses:
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


def correct_labels(markers_m: Cross, position_m: Seen) -> Seen:
    """(frames, markers, 3), markers with corrected labels and without stray points; NaN in frames without a fit."""
    residual_m = fit_rigid(markers_m, position_m).residual_m
    corrected_m = position_m.copy()
    for frame in np.flatnonzero(np.isfinite(residual_m) & ~within_usual_residual(residual_m)):
        seen = np.isfinite(position_m[frame]).all(axis=-1)
        found_m = identify_markers(markers_m, position_m[frame, seen])
        if residual_m[frame] > _TOLERANCE_M or np.isfinite(found_m).any():
            corrected_m[frame] = found_m
    return corrected_m


def identify_markers(markers_m: Cross, points_m: _Candidates) -> Cross:
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


def _labellings(markers_m: Cross, points_m: _Candidates, count: int) -> Int[np.ndarray, "labellings markers"]:
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


def _distances(points_m: _Candidates) -> Float[np.ndarray, "points points"]:
    return np.linalg.norm(points_m[:, None] - points_m, axis=-1)


def _bridge_gaps(
    position_m: _Points, orientation_wxyz: Float[np.ndarray, "frames 4"], rate_hz: float
) -> Poses:
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
    position_m: _Points, frames: Int[np.ndarray, "near"], at: np.integer, chord: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Velocity at one end of a gap, metres per frame; the mean velocity over the gap if only one pose is near."""
    if len(frames) < 2:
        return chord
    return np.polyfit(frames - at, position_m[frames], min(2, len(frames) - 1))[-2]
