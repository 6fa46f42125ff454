"""Marker crosses: rigid bodies of a few motion-capture markers, whose shape is learned from a recording.

Each drone of the DPJAIT dataset carries four or five markers that form an asymmetric cross. Rigid fits are least
squares (Kabsch 1976; Umeyama 1991, without scale); the shape is a generalised Procrustes mean (Gower 1975).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import InputError

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
    turned = (count >= MIN_MARKERS) & (width_m2 > _LINE_M**2)
    off_m2 = ((world - np.einsum("fij,fmj->fmi", rotation, body)) ** 2).sum(axis=-1)
    position = middle_world - np.einsum("fij,fj->fi", rotation, middle_body)
    placed = turned | (count == len(markers_m))
    return RigidFit(
        rotation=np.where(turned[:, None, None], rotation, np.nan),
        position_m=np.where(placed[:, None], position, np.nan),
        residual_m=np.where(turned, np.sqrt((share * off_m2).sum(axis=1)), np.nan),
    )


def learn_cross(
    position_m: Float[np.ndarray, "frames markers 3"], name: str = ""
) -> Float[np.ndarray, "markers 3"]:
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


def _shape_from_distances(
    position_m: Float[np.ndarray, "frames markers 3"], name: str
) -> Float[np.ndarray, "markers 3"]:
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
    limit_m = 3 * np.median(known) + NOISE_M if len(known) else 0.0
    return np.isfinite(residual_m) & (residual_m <= limit_m)


def _axes(markers_m: Float[np.ndarray, "markers 3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """(3, 3), axes of the cross's own frame as rows.

    The axes depend on the shape and the upward direction only, so that two recordings give the same frame.
    """
    z = np.linalg.svd(markers_m)[2][2]
    z = z if z @ up >= 0 else -z
    flat_m = markers_m - np.outer(markers_m @ z, z)
    x = flat_m[np.argmax(np.linalg.norm(flat_m, axis=1) > _LINE_M)]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
