"""Marker crosses: rigid bodies of a few mocap markers, learned from a recording, and told apart by their arms.

Each drone of the DPJAIT dataset carries four or five markers that form an asymmetric cross, with arms of other lengths
on each drone. A cross is known by the distances between its markers alone, whatever their labels say. Rigid fits are
least squares (Kabsch 1976; Umeyama 1991, without scale); the shape is a generalised Procrustes mean (Gower 1975).
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError, SettingsError

#: How far markers may be from their places, root mean square: about a marker's radius. What fits worse is another body.
TOLERANCE_M = 0.01
#: Markers that are nearer than this to one line, root mean square, leave the turn about it to the noise.
_LINE_M = 0.005
#: Two labellings, or two crosses, are told apart where the worse one's residual is beyond twice the better one's, and
#: beyond the noise of a mocap system.
_CLEARLY, _NOISE_M = 2.0, 0.001
_FEWEST = 3
_NUM_ROUNDS = 20
_SETTLED_M = 1e-7


@dataclass(frozen=True)
class Cross:
    """A rigid body of markers.

    Attributes:
        name: of the body.
        markers_m: (markers, 3), metres, in its own frame: the origin is the centroid; z is the normal of the plane
            that fits the markers best, upwards as it was flown; x points at the first marker, in a cross of four from
            the one opposite to it, otherwise from the centroid.
    """

    name: str
    markers_m: Float[np.ndarray, "markers 3"]

    def __post_init__(self) -> None:
        off_m = np.abs(self.markers_m.mean(axis=0)).max() if len(self.markers_m) else np.inf
        if not off_m < 1e-6:
            raise SettingsError(
                f"cross {self.name}", expected="markers around their centroid", found=f"it {off_m:g} m away"
            )


@dataclass(frozen=True)
class RigidFit:
    """A cross laid on its markers, frame by frame.

    Attributes:
        rotation: (frames, 3, 3), cross to world; NaN where fewer than three markers are seen, or only some on a line.
        position_m: (frames, 3), the centroid of all markers, world; NaN likewise, unless all markers are seen.
        residual_m: (frames,), root mean square distance of the markers seen from their places; NaN as the rotation.
        num_markers: (frames,), markers seen.
    """

    rotation: Float[np.ndarray, "frames 3 3"]
    position_m: Float[np.ndarray, "frames 3"]
    residual_m: Float[np.ndarray, "frames"]
    num_markers: Int[np.ndarray, "frames"]


def fit_rigid(
    markers_m: Float[np.ndarray, "markers 3"], position_m: Float[np.ndarray, "frames markers 3"]
) -> RigidFit:
    """The least-squares pose of a body in every frame, from those of its markers that are seen.

    Args:
        markers_m: (markers, 3), the body, its centroid at the origin.
        position_m: (frames, markers, 3), world; NaN where a marker is not seen.
    """
    seen = np.isfinite(position_m).all(axis=-1)
    count = seen.sum(axis=1)
    share = seen / np.maximum(count, 1)[:, None]
    world_m = np.where(seen[..., None], position_m, 0.0)
    middle_body = share @ markers_m
    middle_world = np.einsum("fm,fmi->fi", share, world_m)
    body, world = markers_m - middle_body[:, None], world_m - middle_world[:, None]
    left, _, right = np.linalg.svd(np.einsum("fm,fmi,fmj->fij", share, world, body))
    # The nearest rotation, never a reflection: a flat cross has one as near.
    right[:, 2] *= np.linalg.det(left @ right)[:, None]
    rotation = left @ right
    # Eigenvalues of the spread of the markers seen: the second is how far they are from a line.
    width_m2 = np.linalg.eigvalsh(np.einsum("fm,fmi,fmj->fij", share, body, body))[:, 1]
    turned = (count >= _FEWEST) & (width_m2 > _LINE_M**2)
    off_m2 = ((world - np.einsum("fij,fmj->fmi", rotation, body)) ** 2).sum(axis=-1)
    position = middle_world - np.einsum("fij,fj->fi", rotation, middle_body)
    placed = turned | (count == len(markers_m))
    return RigidFit(
        rotation=np.where(turned[:, None, None], rotation, np.nan),
        position_m=np.where(placed[:, None], position, np.nan),
        residual_m=np.where(turned, np.sqrt((share * off_m2).sum(axis=1)), np.nan),
        num_markers=count,
    )


def learn_cross(position_m: Float[np.ndarray, "frames markers 3"], name: str = "") -> Cross:
    """The cross that was recorded: a generalised Procrustes mean over the frames whose markers fit.

    It starts from the medians of all distances, so that swapped labels and strays in less than half of the frames
    change nothing, and no frame needs to see all markers.

    Args:
        position_m: (frames, markers, 3), world; NaN where a marker is not seen.
        name: of the body.

    Raises:
        InputError: two of the markers are never seen together.
    """
    markers_m = _from_distances(position_m, name)
    fitted = _better_hand(markers_m, position_m)
    if fitted is None:
        return Cross(name, markers_m)
    markers_m, pose = fitted
    for _ in range(_NUM_ROUNDS):
        before_m, markers_m = markers_m, _mean_shape(markers_m, pose, position_m)
        pose = fit_rigid(markers_m, position_m)
        if np.abs(markers_m - before_m).max() < _SETTLED_M:
            break
    axes = _axes(markers_m, up=np.nanmean(pose.rotation[:, 2], axis=0))
    return Cross(name, markers_m @ axes.T)


def identify_markers(cross: Cross, points_m: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, "points"]:
    """Which marker of a cross each point is, from the distances alone; points in any order, strays among them.

    Returns:
        (points,), indices of markers, -1 for points that are none. All are -1 where no three points fit, or where
        they fit almost as well in another way, as those of a symmetric cross do.
    """
    nobody = np.full(len(points_m), -1)
    labellings, residual_m = _labellings(cross, points_m)
    if not len(labellings) or not _is_clear(residual_m):
        return nobody
    best = labellings[np.argmin(residual_m)]
    nobody[best[best >= 0]] = np.flatnonzero(best >= 0)
    return nobody


def identify_cross(crosses: Ordered[Cross], points_m: Float[np.ndarray, "points 3"]) -> int | None:
    """Which cross a set of points is, from the lengths of its arms; of a recording, ask for what `learn_cross` made.

    Returns:
        The index of the cross that has most of the points, and fits best; None where none fits, or two do.
    """
    fits = [_labellings(cross, points_m) for cross in crosses]
    counts = np.array([(found >= 0).sum(axis=1).max(initial=0) for found, _ in fits])
    most = np.flatnonzero((counts == counts.max(initial=0)) & (counts > 0))
    residual_m = np.array([fits[index][1].min() for index in most])
    return int(most[np.argmin(residual_m)]) if len(most) and _is_clear(residual_m) else None


def _labellings(
    cross: Cross, points_m: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, "labellings markers"], Float[np.ndarray, "labellings"]]:
    """The point that is each marker, -1 for none, in every way that fits most of them; with the residuals."""
    num_points, num_markers = len(points_m), len(cross.markers_m)
    # The last row and column are for markers that no point is: they go with everything.
    nobody = num_points
    agree = np.ones((num_markers, num_markers, num_points + 1, num_points + 1), bool)
    off_m = _distances(cross.markers_m)[:, :, None, None] - _distances(points_m)
    agree[:, :, :nobody, :nobody] = (np.abs(off_m) <= 2 * TOLERANCE_M) & ~np.eye(num_points, dtype=bool)
    found = np.zeros((1, 0), int)
    for marker in range(num_markers):
        fits = np.ones((len(found), num_points + 1), bool)
        for other in range(marker):
            fits &= agree[other, marker, found[:, other]]
        rows, points = np.nonzero(fits)
        found = np.column_stack([found[rows], points])
        left = num_markers - marker - 1
        found = found[(found != nobody).sum(axis=1) + left >= min(_FEWEST, num_markers)]
    points_or_none = np.vstack([points_m, np.full((1, 3), np.nan)])
    residual_m = fit_rigid(cross.markers_m, points_or_none[found]).residual_m
    fitting = residual_m <= TOLERANCE_M
    found, residual_m = np.where(found == nobody, -1, found)[fitting], residual_m[fitting]
    count = (found >= 0).sum(axis=1)
    most = count == count.max(initial=0)
    return found[most], residual_m[most]


def _is_clear(residual_m: Float[np.ndarray, "candidates"]) -> bool:
    """Whether the best of some candidates is far better than the next."""
    if len(residual_m) < 2:
        return True
    best, second = np.sort(residual_m)[:2]
    return bool(second > _CLEARLY * best + _NOISE_M)


def _distances(points_m: Float[np.ndarray, "*frames points 3"]) -> Float[np.ndarray, "*frames points points"]:
    return np.linalg.norm(points_m[..., :, None, :] - points_m[..., None, :, :], axis=-1)


def _from_distances(
    position_m: Float[np.ndarray, "frames markers 3"], name: str
) -> Float[np.ndarray, "markers 3"]:
    """The shape with the median distances, by classical scaling (Torgerson 1952); it may be a mirror image."""
    distances_m = _distances(position_m)
    together = np.isfinite(distances_m).any(axis=0)
    if not together.all():
        one, other = np.argwhere(~together)[0] + 1
        raise InputError(
            f"cross {name}",
            expected="every two markers seen together in some frame",
            found=f"{one} and {other} never" if one != other else f"marker {one} never seen",
        )
    squares = np.nanmedian(distances_m, axis=0) ** 2
    centring = np.eye(len(squares)) - 1 / len(squares)
    values, vectors = np.linalg.eigh(-0.5 * centring @ squares @ centring)
    shape = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, ::-1][:, :3]
    return np.pad(shape - shape.mean(axis=0), ((0, 0), (0, max(0, 3 - len(squares)))))


def _better_hand(
    markers_m: Float[np.ndarray, "markers 3"], position_m: Float[np.ndarray, "frames markers 3"]
) -> tuple[Float[np.ndarray, "markers 3"], RigidFit] | None:
    """Of a shape and its mirror image, the one that fits; None where markers lie on a line."""
    hands = [(hand_m, fit_rigid(hand_m, position_m)) for hand_m in (markers_m, markers_m * [1.0, 1.0, -1.0])]
    if np.isnan(hands[0][1].residual_m).all():
        return None
    return min(hands, key=lambda hand: float(np.nanmedian(hand[1].residual_m)))


def _mean_shape(
    markers_m: Float[np.ndarray, "markers 3"],
    pose: RigidFit,
    position_m: Float[np.ndarray, "frames markers 3"],
) -> Float[np.ndarray, "markers 3"]:
    """The mean of the markers in the body's frame over the frames that fit; centred."""
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
    """Where a residual is what it mostly is in this recording, up to its noise; not where it is NaN."""
    known = residual_m[np.isfinite(residual_m)]
    limit_m = 3 * np.median(known) + _NOISE_M if len(known) else 0.0
    return np.isfinite(residual_m) & (residual_m <= limit_m)


def _axes(markers_m: Float[np.ndarray, "markers 3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """(3, 3), rows: the axes of a cross's own frame. They depend on its shape alone, so that two recordings agree."""
    z = np.linalg.svd(markers_m)[2][2]
    z = z if z @ up >= 0 else -z
    flat_m = markers_m - np.outer(markers_m @ z, z)
    first = int(np.argmax(np.linalg.norm(flat_m, axis=1) > _LINE_M))
    opposite = _opposite(flat_m, z, first)
    x = flat_m[first] if opposite is None else flat_m[first] - flat_m[opposite]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _opposite(flat_m: Float[np.ndarray, "markers 3"], z: Float[np.ndarray, "3"], first: int) -> int | None:
    """The marker at the other end of the beam of a cross of four: the two beams part each other's ends."""

    def part(start: int, end: int, one: int, other: int) -> bool:
        sides = np.cross(flat_m[end] - flat_m[start], flat_m[[one, other]] - flat_m[start]) @ z
        return bool(sides[0] * sides[1] < 0)

    others = [marker for marker in range(len(flat_m)) if marker != first]
    for opposite in others if len(flat_m) == 4 else ():
        one, other = (marker for marker in others if marker != opposite)
        if part(first, opposite, one, other) and part(one, other, first, opposite):
            return opposite
    return None
