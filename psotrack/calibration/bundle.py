"""Bundle adjustment: cameras and points moved together until the points project to where they are seen, in float64.

Triggs, McLauchlan, Hartley & Fitzgibbon (2000), "Bundle adjustment, a modern synthesis": Levenberg-Marquardt with the
points eliminated by the Schur complement, a Cauchy loss by reweighting, and once more without on what agrees.

Pixels alone do not say where the world's origin is, how its axes are turned, or how large it is: see `gauge`.
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.bundle_equations import (
    BundleState,
    Problem,
    distance_px,
    equations_of,
    scaled,
    solved,
    weights_of,
)
from psotrack.calibration.common_errors import CommonErrors, covariance_of_common_errors
from psotrack.calibration.derivatives import centre_by_pose
from psotrack.calibration.gauge import common_motions, pose_change_metric
from psotrack.calibration.residuals import GATE, inflation, spread_px
from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.geometry import NEAR_M, Camera, CameraRig, to_camera, triangulate


@dataclass(frozen=True)
class AdjustedRig:
    """A rig that its data agree with.

    Attributes:
        rig: adjusted.
        points_m: (points, 3), world, metres; NaN where fewer than two cameras see a point.
        residual_px: (points, cameras), distances in the image, outliers too; NaN where a camera does not see a point.
        used: (points, cameras), False for outliers and what is not seen.
        covariance: (cameras, 6, 6), of a small turn about the camera's axes, rad, and of the translation, m, the rig as
            a whole being held; 0 for cameras that are fixed.
        joint_covariance: (unknowns, unknowns), the same of all cameras together; last the logarithm of the focal
            lengths' factor.
        centre_covariance_m2: (cameras, 3, 3), of the centres, world, m².
        focal_scale: what focal lengths were multiplied with; 1 where they are fixed.
        focal_scale_std: its standard deviation; 0 where they are fixed.
    """

    rig: CameraRig
    points_m: Float[np.ndarray, "points 3"]
    residual_px: Float[np.ndarray, "points cameras"]
    used: Bool[np.ndarray, "points cameras"]
    covariance: Float[np.ndarray, "cameras 6 6"]
    joint_covariance: Float[np.ndarray, "unknowns unknowns"]
    centre_covariance_m2: Float[np.ndarray, "cameras 3 3"]
    focal_scale: float
    focal_scale_std: float


def adjust(
    rig: CameraRig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float | Float[np.ndarray, "points cameras"] = 1.0,
    *,
    fixed: Ordered[str] = (),
    rescaled: Ordered[str] = (),
    common_errors: Ordered[CommonErrors] = (),
) -> AdjustedRig:
    """The rig, and the points, that explain what the cameras see.

    The covariance is that of errors of the stated noise, wider where residuals are larger than it explains, and of
    common errors: the middle of a drone's box is off in the same way for many frames.

    Args:
        rig: where the cameras are about.
        points_px: (points, cameras, 2), the same points in all cameras; NaN where a camera does not see one.
        noise_px: standard deviation along x and along y of errors that are independent, one for all or of each.
        fixed: names of cameras that stay where they are.
        rescaled: names of cameras whose focal lengths are multiplied with a common factor.
        common_errors: further errors, each of which several points have in common.

    Raises:
        SettingsError: the noise is not above 0, or a fixed camera is not in the rig.
        InputError: the points do not fix the cameras: the message names one that sees too few with others.
    """
    noise_px = np.broadcast_to(np.asarray(noise_px, np.float64), points_px.shape[:2])
    for what, names in (("fixed", fixed), ("rescaled", rescaled)):
        unknown = [name for name in names if name not in rig.names]
        if unknown:
            raise SettingsError(what, expected=f"some of {', '.join(rig.names)}", found=", ".join(unknown))
    if len(set(fixed)) == len(rig) and not rescaled:
        raise SettingsError("fixed", expected="a camera that may move", found="all of them")
    placed = np.isfinite(points_px).all(axis=-1)
    if placed.any():
        check_positive("noise_px", float(noise_px[placed].min()))
    placed &= (placed.sum(axis=1) >= 2)[:, None]
    start_m = triangulate(rig.cameras, np.where(placed[..., None], points_px, np.nan))
    placed &= (np.isfinite(start_m).all(axis=-1) & _before(rig.cameras, start_m))[:, None]
    _check_seen(rig, placed, fixed, rescaled)
    rows = np.flatnonzero(placed.any(axis=1))
    free, common = _unknowns(rig, fixed, bool(rescaled))
    given = np.asarray(rig.cameras.T_cam_world)
    held = common.T @ pose_change_metric(given)
    held /= np.sqrt(np.diag(held @ common))[:, None]
    noise = np.where(placed, noise_px, 1.0)[rows]
    zoomed = np.array([name in rescaled for name in rig.names])
    problem = Problem(rig.cameras, given, points_px[rows], noise, zoomed, free, common, held)
    state, used = BundleState(given, start_m[rows]), placed[rows]
    state = solved(problem, state, used, robust=True)
    residual_px = distance_px(problem, state)
    unknowns = free.shape[1] - common.shape[1] + 3 * len(rows)
    # The gate moves with the fit and the fit with the gate; what swings to and fro ends somewhere.
    for _ in range(5):
        sigmas = residual_px / noise
        within = placed[rows] & (sigmas <= GATE * max(1.0, spread_px(sigmas[used], unknowns)))
        # A point that one camera is left to see has no say, and no place.
        within &= (within.sum(axis=1) >= 2)[:, None]
        before, used = used, within
        state = solved(problem, state, used, robust=False)
        residual_px = distance_px(problem, state)
        if (used == before).all():
            break
    _check_seen(rig, used, fixed, rescaled)
    common_errors = [CommonErrors(kind.label[rows], kind.std_px[rows]) for kind in common_errors]
    return _adjusted(rig, problem, state, used, rows, len(points_px), common_errors)


def _check_seen(
    rig: CameraRig, placed: Bool[np.ndarray, "points cameras"], fixed: Ordered[str], rescaled: Ordered[str]
) -> None:
    for name, count in zip(rig.names, placed.sum(axis=0).tolist(), strict=True):
        # Six unknowns of the pose; with fewer points it swings freely.
        if count < 6 and name not in fixed:
            raise InputError(
                f"camera {name}",
                expected="at least 6 points that another camera sees too",
                found=f"{count}",
                remedy="leave it out, or keep it fixed",
            )
    telling = int(placed[:, [rig.names.index(name) for name in rescaled]].sum())
    if rescaled and telling < 6:
        raise InputError(
            "focal lengths",
            expected="at least 6 points that another camera sees too",
            found=f"{telling}",
            remedy="keep them",
        )


def _unknowns(
    rig: CameraRig, fixed: Ordered[str], rescaled: bool
) -> tuple[Float[np.ndarray, "unknowns free"], Float[np.ndarray, "unknowns motions"]]:
    """What is sought, of 6 unknowns per camera and the focal lengths' logarithm; and the motions that are open."""
    count = len(rig)
    sought = np.array([name not in fixed for name in rig.names])
    free = np.eye(6 * count + 1)[:, np.append(np.repeat(sought, 6), rescaled)]
    motions = common_motions(np.asarray(rig.cameras.T_cam_world))
    held = motions[np.append(np.repeat(~sought, 6), False)]
    if held.size:
        # Those that leave the fixed cameras where they are.
        _, strength, axes = np.linalg.svd(held)
        rank = int((strength > 1e-9 * strength[0]).sum())
        motions = motions @ axes[rank:].T
    return free, motions


def _adjusted(
    rig: CameraRig,
    problem: Problem,
    state: BundleState,
    used: Bool[np.ndarray, "rows cameras"],
    rows: Int[np.ndarray, " rows"],
    num_points: int,
    common_errors: Ordered[CommonErrors],
) -> AdjustedRig:
    """The answer for all points, with the covariance of the cameras."""
    weights = weights_of(problem, state, used, robust=False)
    equations = equations_of(problem, state, weights, damping=0.0)
    reduced = equations.reduced
    scale = np.sqrt(np.diag(reduced))
    if scale.size and np.linalg.cond(reduced / np.outer(scale, scale)) > 1e14:
        raise InputError(
            "cameras",
            expected="points that tie all cameras together",
            found="some that see none of the others' points",
        )
    residual_px = distance_px(problem, state)
    kept = used.any(axis=1)
    unknowns = problem.free.shape[1] - problem.common.shape[1] + 3 * int(kept.sum())
    squares = float(np.sum((residual_px / problem.noise_px)[used] ** 2))
    covariance = inflation(squares, 2 * int(used.sum()) - unknowns) * np.linalg.inv(reduced)
    covariance += covariance_of_common_errors(problem, state, weights, equations, common_errors)
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
        CameraRig(rig.names, replace(scaled(rig.cameras, factor), T_cam_world=state.T_cam_world)),
        points_m,
        all_residual_px,
        all_used,
        np.stack(by_camera),
        covariance,
        np.stack(centres),
        state.focal_scale,
        state.focal_scale * float(np.sqrt(covariance[-1, -1])),
    )


def _before(cameras: Camera, points_m: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Points that are in front of most cameras."""
    return np.median(to_camera(cameras, points_m[:, None, :])[..., 2], axis=-1) > NEAR_M
