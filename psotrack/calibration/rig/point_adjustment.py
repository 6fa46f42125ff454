"""Adjustment of cameras with known lenses and the points that they see.

A point is a target with a single corner (`calibration.bundle`), whose turn nothing shows. The first camera stays where
it is; the unit of length is open, and damped steps hardly change it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.bundle import Bundle, BundleProblem, BundleState
from psotrack.calibration.lens_models import known_lenses
from psotrack.calibration.residuals import GATE, spread_px
from psotrack.errors import InputError
from psotrack.geometry import NEAR_M, Camera, Rig, to_camera, triangulate_linearly

#: Smallest number of points per camera: a pose has six unknowns, and fewer points leave it almost free.
_LEAST_POINTS = 6
#: Smallest information about a combination of the cameras' unknowns, against the largest one.
_LEAST_INFORMATION = 1e-13


@dataclass(frozen=True)
class AdjustedRig:
    """Result of an adjustment.

    Attributes:
        rig: the adjusted cameras.
        points_m: (points, 3), world, in the rig's unit of length; NaN where fewer than two cameras see a point.
        residual_px: (points, cameras), distances in the image, also of outliers; NaN where a camera does not see a
            point.
        used: (points, cameras), False for outliers and for unseen points.
    """

    rig: Rig
    points_m: Float[np.ndarray, "points 3"]
    residual_px: Float[np.ndarray, "points cameras"]
    used: Bool[np.ndarray, "points cameras"]


def adjust(rig: Rig, points_px: Float[np.ndarray, "points cameras 2"], noise_px: float) -> AdjustedRig:
    """Adjust the cameras of a rig, and triangulate the points, so that projections agree with measured pixels.

    Args:
        rig: approximate cameras; the first one stays.
        points_px: (points, cameras, 2), pixels of the same points in all cameras; NaN where a camera does not see a
            point.
        noise_px: standard deviation of a pixel along x and along y.

    Raises:
        InputError: the points do not determine the cameras; the message names a camera that sees too few points.
        SettingsError: a lens has skew.
        numpy.linalg.LinAlgError: a point went to infinity.
    """
    placed = np.isfinite(points_px).all(axis=-1)
    placed &= (placed.sum(axis=1) >= 2)[:, None]
    start_m = triangulate_linearly(rig.cameras, np.where(placed[..., None], points_px, np.nan))
    placed &= (np.isfinite(start_m).all(axis=-1) & _is_in_front(rig.cameras, start_m))[:, None]
    _check_seen(rig, placed)
    seen_px = np.where(placed[..., None], points_px, np.nan)
    bundle = _start(rig, start_m, seen_px, noise_px).solved()
    seen, unknowns = (
        (bundle.problem.target, bundle.problem.camera),
        6 * len(rig) - 7 + 3 * int(placed.any(axis=1).sum()),
    )
    used = placed
    # The gate depends on the fit and the fit on the gate. The loop ends if they alternate.
    for _ in range(5):
        distance_px = _distances(bundle, placed.shape)
        inliers = distance_px <= GATE * max(noise_px, spread_px(distance_px[used], unknowns))
        # A point that only one camera sees has no position.
        inliers &= (inliers.sum(axis=1) >= 2)[:, None]
        before, used = used, inliers
        bundle = replace(bundle, used=used[seen][:, None], is_robust=False).solved()
        if (used == before).all():
            break
    _check_seen(rig, used)
    _check_connected(bundle)
    cameras = replace(rig.cameras, T_cam_world=bundle.state.T_cam_world)
    points_m = np.where(used.any(axis=1)[:, None], bundle.state.T_world_target[:, :3, 3], np.nan)
    return AdjustedRig(Rig(rig.names, cameras), points_m, _distances(bundle, placed.shape), used)


def _start(
    rig: Rig,
    points_m: Float[np.ndarray, "points 3"],
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float,
) -> Bundle:
    """The adjustment's first state, with a robust loss."""
    models, lenses = zip(*known_lenses(rig).values(), strict=True)
    point, camera = np.nonzero(np.isfinite(points_px[..., 0]))
    problem = BundleProblem(
        models=models,
        priors=tuple((lens, np.zeros((len(lens), len(lens)))) for lens in lenses),
        corners_m=np.zeros((1, 3)),
        lens=camera,
        camera=camera,
        target=point,
        corners_px=points_px[point, camera, None],
        noise_px=np.full(len(point), noise_px),
        free_lens=tuple(np.zeros(model.size, bool) for model in models),
        free_camera=np.arange(len(rig)) > 0,
        free_target=np.ones((len(points_m), 7), bool),
    )
    points = np.tile(np.eye(4), (len(points_m), 1, 1))
    points[:, :3, 3] = points_m
    state = BundleState(lenses, np.asarray(rig.cameras.T_cam_world), points, np.ones(len(points)))
    return Bundle(problem, state, np.ones((len(point), 1), bool), is_robust=True)


def _distances(bundle: Bundle, shape: tuple[int, ...]) -> Float[np.ndarray, "points cameras"]:
    """Distances in the image, NaN where a camera does not see a point."""
    distance_px = np.full(shape, np.nan)
    distance_px[bundle.problem.target, bundle.problem.camera] = bundle.distance_px[:, 0]
    return distance_px


def _check_seen(rig: Rig, seen: Bool[np.ndarray, "points cameras"]) -> None:
    for name, count in zip(rig.names, seen.sum(axis=0).tolist(), strict=True):
        if count < _LEAST_POINTS:
            raise InputError(
                f"camera {name}",
                expected=f"at least {_LEAST_POINTS} points that another camera sees too",
                found=f"{count}",
                remedy="leave the camera out",
            )


def _check_connected(bundle: Bundle) -> None:
    """Check that points determine the cameras but for the unit of length, which has no information."""
    information = bundle.equations().reduced().information
    scale = np.sqrt(np.diag(information))
    strength = np.linalg.eigvalsh(information / np.outer(scale, scale))
    if strength[1] < _LEAST_INFORMATION * strength[-1]:
        raise InputError(
            "cameras",
            expected="points that connect all cameras",
            found="cameras that share no points with the others",
        )


def _is_in_front(cameras: Camera, points_m: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """(points,), True where a point is in front of most cameras."""
    return np.median(to_camera(cameras, points_m[:, None, :])[..., 2], axis=-1) > NEAR_M
