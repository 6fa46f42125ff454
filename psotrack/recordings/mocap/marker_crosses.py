"""Marker crosses: rigid bodies of a few motion-capture markers, learned from a recording and identified by shape.

Each drone of the DPJAIT dataset carries four or five markers that form an asymmetric cross, whose arms have different
lengths on each drone. The distances between the markers identify a cross, even if labels are wrong. Rigid fits are
least squares (Kabsch 1976; Umeyama 1991, without scale); the shape is a generalised Procrustes mean (Gower 1975).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError, SettingsError

#: Largest root mean square residual of a fit, metres: about a marker's radius. A larger one means another body.
TOLERANCE_M = 0.01
#: Smallest root mean square distance of markers from a line, metres; nearer markers do not determine the turn about it.
_LINE_M = 0.005
#: Smallest ratio of the second-best residual to the best residual of a unique solution.
_UNIQUE_RATIO = 2.0
#: Noise of a motion-capture system, metres, added where residuals are compared.
_NOISE_M = 0.001
#: Smallest number of markers that determines a pose.
_MIN_MARKERS = 3
#: Largest number of iterations of the Procrustes mean.
_NUM_ROUNDS = 20
#: Largest change of a marker in the last iteration of the Procrustes mean, metres.
_CONVERGED_M = 1e-7


@dataclass(frozen=True)
class Cross:
    """A rigid body of markers.

    Attributes:
        name: name of the body.
        markers_m: (markers, 3), positions of the markers in the body's frame, metres. The origin is the centroid. z is
            the normal of the plane that fits the markers best and points upwards in flight. x points to the first
            marker: from the opposite marker in a cross of four markers, otherwise from the centroid.
    """

    name: str
    markers_m: Float[np.ndarray, "markers 3"]

    def __post_init__(self) -> None:
        centroid_m = np.abs(self.markers_m.mean(axis=0)).max() if len(self.markers_m) else np.inf
        if not centroid_m < 1e-6:
            raise SettingsError(
                f"cross {self.name}",
                expected="markers with their centroid at the origin",
                found=f"a centroid {centroid_m:g} m away",
            )


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
    position_m: Float[np.ndarray, "frames 3"]
    residual_m: Float[np.ndarray, "frames"]


def fit_rigid(
    markers_m: Float[np.ndarray, "markers 3"], position_m: Float[np.ndarray, "frames markers 3"]
) -> RigidFit:
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
    turned = (count >= _MIN_MARKERS) & (width_m2 > _LINE_M**2)
    off_m2 = ((world - np.einsum("fij,fmj->fmi", rotation, body)) ** 2).sum(axis=-1)
    position = middle_world - np.einsum("fij,fj->fi", rotation, middle_body)
    placed = turned | (count == len(markers_m))
    return RigidFit(
        rotation=np.where(turned[:, None, None], rotation, np.nan),
        position_m=np.where(placed[:, None], position, np.nan),
        residual_m=np.where(turned, np.sqrt((share * off_m2).sum(axis=1)), np.nan),
    )


def learn_cross(position_m: Float[np.ndarray, "frames markers 3"], name: str = "") -> Cross:
    """Learn the shape of a recorded cross: a generalised Procrustes mean over the frames whose markers fit.

    The mean starts from the medians of all distances. Swapped labels and stray markers in less than half of the frames
    therefore have no influence, and no frame needs to see all markers.

    Args:
        position_m: (frames, markers, 3), positions in the world, metres; NaN if a marker is not seen.
        name: name of the body.

    Raises:
        InputError: two of the markers are never seen together.
    """
    markers_m = _shape_from_distances(position_m, name)
    fitted = _better_mirror_image(markers_m, position_m)
    if fitted is None:
        return Cross(name, markers_m)
    markers_m, pose = fitted
    for _ in range(_NUM_ROUNDS):
        before_m, markers_m = markers_m, _mean_shape(markers_m, pose, position_m)
        pose = fit_rigid(markers_m, position_m)
        if np.abs(markers_m - before_m).max() < _CONVERGED_M:
            break
    axes = _axes(markers_m, up=np.nanmean(pose.rotation[:, 2], axis=0))
    return Cross(name, markers_m @ axes.T)


def identify_markers(cross: Cross, points_m: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, "points"]:
    """Identify the markers of a cross among points, from the distances alone.

    Args:
        cross: the cross.
        points_m: (points, 3), positions in the world, metres, in any order; some may be stray points.

    Returns:
        (points,), index of the marker of each point, -1 for stray points. All are -1 if no three points fit, or if
        another solution fits almost as well, as for a symmetric cross.
    """
    marker_of_point = np.full(len(points_m), -1)
    labellings, residual_m = _labellings(cross, points_m)
    if not len(labellings) or not _is_unique(residual_m):
        return marker_of_point
    best = labellings[np.argmin(residual_m)]
    marker_of_point[best[best >= 0]] = np.flatnonzero(best >= 0)
    return marker_of_point


def _labellings(
    cross: Cross, points_m: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, "labellings markers"], Float[np.ndarray, "labellings"]]:
    """All labellings that fit the largest number of markers, and their residuals in metres.

    A labelling holds the index of the point for each marker, or -1 for a marker without point.
    """
    num_points, num_markers = len(points_m), len(cross.markers_m)
    # The last row and column stand for markers without a point, which agree with every other marker.
    no_point = num_points
    agree = np.ones((num_markers, num_markers, num_points + 1, num_points + 1), bool)
    off_m = _distances(cross.markers_m)[:, :, None, None] - _distances(points_m)
    agree[:, :, :no_point, :no_point] = (np.abs(off_m) <= 2 * TOLERANCE_M) & ~np.eye(num_points, dtype=bool)
    found = np.zeros((1, 0), int)
    for marker in range(num_markers):
        fits = np.ones((len(found), num_points + 1), bool)
        for other in range(marker):
            fits &= agree[other, marker, found[:, other]]
        rows, points = np.nonzero(fits)
        found = np.column_stack([found[rows], points])
        left = num_markers - marker - 1
        found = found[(found != no_point).sum(axis=1) + left >= min(_MIN_MARKERS, num_markers)]
    points_or_none = np.vstack([points_m, np.full((1, 3), np.nan)])
    residual_m = fit_rigid(cross.markers_m, points_or_none[found]).residual_m
    fitting = residual_m <= TOLERANCE_M
    found, residual_m = np.where(found == no_point, -1, found)[fitting], residual_m[fitting]
    count = (found >= 0).sum(axis=1)
    most = count == count.max(initial=0)
    return found[most], residual_m[most]


def _is_unique(residual_m: Float[np.ndarray, "candidates"]) -> bool:
    """Whether the best candidate is much better than the second-best candidate."""
    if len(residual_m) < 2:
        return True
    best, second = np.sort(residual_m)[:2]
    return bool(second > _UNIQUE_RATIO * best + _NOISE_M)


def _distances(points_m: Float[np.ndarray, "*frames points 3"]) -> Float[np.ndarray, "*frames points points"]:
    return np.linalg.norm(points_m[..., :, None, :] - points_m[..., None, :, :], axis=-1)


def _shape_from_distances(
    position_m: Float[np.ndarray, "frames markers 3"], name: str
) -> Float[np.ndarray, "markers 3"]:
    """Shape with the median distances, by classical scaling (Torgerson 1952); it may be a mirror image."""
    distances_m = _distances(position_m)
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


def _better_mirror_image(
    markers_m: Float[np.ndarray, "markers 3"], position_m: Float[np.ndarray, "frames markers 3"]
) -> tuple[Float[np.ndarray, "markers 3"], RigidFit] | None:
    """The better of a shape and its mirror image, with its fits; None if the markers lie on a line."""
    mirrored_m = markers_m * [1.0, 1.0, -1.0]
    fits = [(shape_m, fit_rigid(shape_m, position_m)) for shape_m in (markers_m, mirrored_m)]
    if np.isnan(fits[0][1].residual_m).all():
        return None
    return min(fits, key=lambda fit: float(np.nanmedian(fit[1].residual_m)))


def _mean_shape(
    markers_m: Float[np.ndarray, "markers 3"],
    pose: RigidFit,
    position_m: Float[np.ndarray, "frames markers 3"],
) -> Float[np.ndarray, "markers 3"]:
    """Mean of the markers in the body's frame over the frames that fit, with the centroid at the origin."""
    fitting: Bool[np.ndarray, "frames"] = within_usual_residual(pose.residual_m)
    in_body = np.einsum(
        "fji,fmj->fmi", pose.rotation[fitting], position_m[fitting] - pose.position_m[fitting, None]
    )
    seen = np.isfinite(in_body).all(axis=-1)
    total = np.where(seen[..., None], in_body, 0.0).sum(axis=0)
    count = seen.sum(axis=0)[:, None]
    mean_m = np.where(count > 0, total / np.maximum(count, 1), markers_m)
    return mean_m - mean_m.mean(axis=0)


def within_usual_residual(residual_m: Float[np.ndarray, "frames"]) -> Bool[np.ndarray, "frames"]:
    """True where a residual is at most three times the recording's median plus noise; False where it is NaN."""
    known = residual_m[np.isfinite(residual_m)]
    limit_m = 3 * np.median(known) + _NOISE_M if len(known) else 0.0
    return np.isfinite(residual_m) & (residual_m <= limit_m)


def _axes(markers_m: Float[np.ndarray, "markers 3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """(3, 3), axes of the cross's own frame as rows.

    The axes depend on the shape and the upward direction only, so that two recordings give the same frame.
    """
    z = np.linalg.svd(markers_m)[2][2]
    z = z if z @ up >= 0 else -z
    flat_m = markers_m - np.outer(markers_m @ z, z)
    first = int(np.argmax(np.linalg.norm(flat_m, axis=1) > _LINE_M))
    opposite = _opposite(flat_m, z, first)
    x = flat_m[first] if opposite is None else flat_m[first] - flat_m[opposite]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _opposite(flat_m: Float[np.ndarray, "markers 3"], z: Float[np.ndarray, "3"], first: int) -> int | None:
    """The marker opposite to the first marker in a cross of four, where two beams cross; None for other crosses."""

    def separates(start: int, end: int, left: int, right: int) -> bool:
        """Whether the line from `start` to `end` runs between the markers `left` and `right`."""
        sides = np.cross(flat_m[end] - flat_m[start], flat_m[[left, right]] - flat_m[start]) @ z
        return bool(sides[0] * sides[1] < 0)

    others = [marker for marker in range(len(flat_m)) if marker != first]
    for opposite in others if len(flat_m) == 4 else ():
        left, right = (marker for marker in others if marker != opposite)
        if separates(first, opposite, left, right) and separates(left, right, first, opposite):
            return opposite
    return None
