"""Bundle adjustment: move cameras and points together until the points project to their measured pixels, in float64.

Triggs, McLauchlan, Hartley & Fitzgibbon (2000), "Bundle adjustment, a modern synthesis": Levenberg-Marquardt with the
points eliminated (`psotrack.geometry.estimation`), first with a robust loss, then with squared residuals of the
inliers.

Pixels do not determine the world's origin, the directions of its axes, or its scale: see `gauge`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.bundles.points import PointBundle, PointProblem, PointState, scale_focal_lengths
from psotrack.calibration.common_errors import CommonErrors, covariance_of_common_errors
from psotrack.calibration.derivatives import centre_by_pose
from psotrack.calibration.gauge import common_motions, pose_change_metric
from psotrack.calibration.residuals import GATE, inflation, spread_px
from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.geometry import NEAR_M, Camera, Rig, to_camera, triangulate_linearly


@dataclass(frozen=True)
class AdjustedRig:
    """Result of a bundle adjustment.

    Attributes:
        rig: the adjusted cameras.
        points_m: (points, 3), world, metres; NaN where fewer than two cameras see a point.
        residual_px: (points, cameras), distances in the image, also of outliers; NaN where a camera does not see a
            point.
        used: (points, cameras), False for outliers and for unseen points.
        covariance: (cameras, 6, 6), covariance of a small turn about the camera's axes, rad, and of the translation, m,
            without common motions of the whole rig; 0 for fixed cameras.
        joint_covariance: (unknowns, unknowns), covariance of the unknowns of all cameras, and of the logarithm of the
            focal lengths' factor, which is last.
        centre_covariance_m2: (cameras, 3, 3), covariances of the camera centres, world, m².
        focal_scale: factor on the focal lengths; 1 where they are fixed.
        focal_scale_std: standard deviation of the factor; 0 where the focal lengths are fixed.
    """

    rig: Rig
    points_m: Float[np.ndarray, "points 3"]
    residual_px: Float[np.ndarray, "points cameras"]
    used: Bool[np.ndarray, "points cameras"]
    covariance: Float[np.ndarray, "cameras 6 6"]
    joint_covariance: Float[np.ndarray, "unknowns unknowns"]
    centre_covariance_m2: Float[np.ndarray, "cameras 3 3"]
    focal_scale: float
    focal_scale_std: float


def adjust(
    rig: Rig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float | Float[np.ndarray, "points cameras"] = 1.0,
    *,
    fixed: Sequence[str] = (),
    rescaled: Sequence[str] = (),
    common_errors: Sequence[CommonErrors] = (),
) -> AdjustedRig:
    """Adjust the cameras of a rig, and triangulate the points, so that projections agree with measured pixels.

    The covariance has two parts. The first part comes from independent errors with the stated noise, or with larger
    noise if the residuals are larger. The second part comes from common errors: for example, the middle of a drone's
    box has the same error in many frames.

    Args:
        rig: approximate cameras.
        points_px: (points, cameras, 2), pixels of the same points in all cameras; NaN where a camera does not see a
            point.
        noise_px: standard deviation of independent errors along x and along y, pixels: one number, or (points,
            cameras).
        fixed: names of cameras that do not move.
        rescaled: names of cameras whose focal lengths are multiplied by a common factor.
        common_errors: errors that several points have in common.

    Raises:
        SettingsError: the noise is not above 0, or `fixed` or `rescaled` names a camera that is not in the rig,
            or all cameras are fixed and none is rescaled.
        InputError: the points do not determine the cameras; the message names a camera that sees too few points.
    """
    noise_px = np.broadcast_to(np.asarray(noise_px, np.float64), points_px.shape[:2])
    for argument, names in (("fixed", fixed), ("rescaled", rescaled)):
        unknown = [name for name in names if name not in rig.names]
        if unknown:
            raise SettingsError(
                argument, expected=f"some of {', '.join(rig.names)}", found=", ".join(unknown)
            )
    if len(set(fixed)) == len(rig) and not rescaled:
        raise SettingsError("fixed", expected="a camera that may move", found="all cameras")
    placed = np.isfinite(points_px).all(axis=-1)
    if placed.any():
        check_positive("noise_px", float(noise_px[placed].min()))
    placed &= (placed.sum(axis=1) >= 2)[:, None]
    start_m = triangulate_linearly(rig.cameras, np.where(placed[..., None], points_px, np.nan))
    placed &= (np.isfinite(start_m).all(axis=-1) & _is_in_front(rig.cameras, start_m))[:, None]
    _check_seen(rig, placed, fixed, rescaled)
    rows = np.flatnonzero(placed.any(axis=1))
    free, common = _unknowns(rig, fixed, bool(rescaled))
    given = np.asarray(rig.cameras.T_cam_world)
    held = common.T @ pose_change_metric(given)
    held /= np.sqrt(np.diag(held @ common))[:, None]
    noise = np.where(placed, noise_px, 1.0)[rows]
    is_rescaled = np.array([name in rescaled for name in rig.names])
    problem = PointProblem(rig.cameras, given, points_px[rows], noise, is_rescaled, free, common, held)
    bundle = PointBundle(problem, PointState(given, start_m[rows]), placed[rows], robust=True).solved()
    unknowns = free.shape[1] - common.shape[1] + 3 * len(rows)
    # The gate depends on the fit and the fit on the gate. The loop ends if they alternate.
    for _ in range(5):
        sigmas = bundle.distance_px / noise
        inliers = placed[rows] & (sigmas <= GATE * max(1.0, spread_px(sigmas[bundle.used], unknowns)))
        # A point that only one camera sees has no position.
        inliers &= (inliers.sum(axis=1) >= 2)[:, None]
        before, bundle = bundle, replace(bundle, used=inliers, robust=False).solved()
        if (bundle.used == before.used).all():
            break
    _check_seen(rig, bundle.used, fixed, rescaled)
    common_errors = [CommonErrors(kind.label[rows], kind.std_px[rows]) for kind in common_errors]
    return _adjusted(rig, bundle, rows, len(points_px), common_errors)


def _check_seen(
    rig: Rig, placed: Bool[np.ndarray, "points cameras"], fixed: Sequence[str], rescaled: Sequence[str]
) -> None:
    """Check that every camera that may move sees enough points."""
    for name, count in zip(rig.names, placed.sum(axis=0).tolist(), strict=True):
        # A pose has six unknowns, and fewer points leave it almost free.
        if count < 6 and name not in fixed:
            raise InputError(
                f"camera {name}",
                expected="at least 6 points that another camera sees too",
                found=f"{count}",
                remedy="leave the camera out, or keep it fixed",
            )
    observations = int(placed[:, [rig.names.index(name) for name in rescaled]].sum())
    if rescaled and observations < 6:
        raise InputError(
            "focal lengths",
            expected="at least 6 points that another camera sees too",
            found=f"{observations}",
            remedy="do not rescale the focal lengths",
        )


def _unknowns(
    rig: Rig, fixed: Sequence[str], rescaled: bool
) -> tuple[Float[np.ndarray, "unknowns free"], Float[np.ndarray, "unknowns motions"]]:
    """Select the free unknowns, and the common motions that fixed cameras leave free.

    Unknowns are six per camera and the logarithm of the focal lengths' factor.
    """
    count = len(rig)
    is_free = np.array([name not in fixed for name in rig.names])
    free = np.eye(6 * count + 1)[:, np.append(np.repeat(is_free, 6), rescaled)]
    motions = common_motions(np.asarray(rig.cameras.T_cam_world))
    held = motions[np.append(np.repeat(~is_free, 6), False)]
    if held.size:
        # Keep the motions that do not move the fixed cameras.
        _, strength, axes = np.linalg.svd(held)
        rank = int((strength > 1e-9 * strength[0]).sum())
        motions = motions @ axes[rank:].T
    return free, motions


def _adjusted(
    rig: Rig,
    bundle: PointBundle,
    rows: Int[np.ndarray, " rows"],
    num_points: int,
    common_errors: Sequence[CommonErrors],
) -> AdjustedRig:
    """Make the result for all points, with the covariance of the cameras."""
    problem, state, used = bundle.problem, bundle.state, bundle.used
    equations = bundle.equations().reduced()
    information = equations.information
    scale = np.sqrt(np.diag(information))
    if scale.size and np.linalg.cond(information / np.outer(scale, scale)) > 1e14:
        raise InputError(
            "cameras",
            expected="points that connect all cameras",
            found="cameras that share no points with the others",
        )
    residual_px = bundle.distance_px
    kept = used.any(axis=1)
    unknowns = problem.free.shape[1] - problem.common.shape[1] + 3 * int(kept.sum())
    squares = float(np.sum((residual_px / problem.noise_px)[used] ** 2))
    covariance = inflation(squares, 2 * int(used.sum()) - unknowns) * np.linalg.inv(information)
    covariance += covariance_of_common_errors(bundle, equations, common_errors)
    covariance = problem.free @ covariance @ problem.free.T
    by_camera, centres = [], []
    for index, T in enumerate(state.T_cam_world):
        block = covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]
        by_pose = centre_by_pose(T[:3, :3], T[:3, 3])
        by_camera.append(block)
        centres.append(by_pose @ block @ by_pose.T)
    factor = np.where(problem.rescaled, state.focal_scale, 1.0)
    points_m = np.full((num_points, 3), np.nan)
    points_m[rows[kept]] = state.points_m[kept]
    all_residual_px = np.full((num_points, len(rig)), np.nan)
    all_residual_px[rows] = residual_px
    all_used = np.zeros((num_points, len(rig)), bool)
    all_used[rows] = used
    return AdjustedRig(
        Rig(rig.names, replace(scale_focal_lengths(rig.cameras, factor), T_cam_world=state.T_cam_world)),
        points_m,
        all_residual_px,
        all_used,
        np.stack(by_camera),
        covariance,
        np.stack(centres),
        state.focal_scale,
        state.focal_scale * float(np.sqrt(covariance[-1, -1])),
    )


def _is_in_front(cameras: Camera, points_m: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """(points,), True where a point is in front of most cameras."""
    return np.median(to_camera(cameras, points_m[:, None, :])[..., 2], axis=-1) > NEAR_M
