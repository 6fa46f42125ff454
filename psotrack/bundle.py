"""Bundle adjustment: cameras and points moved together until the points project to where they are seen, in float64.

Triggs, McLauchlan, Hartley & Fitzgibbon (2000), "Bundle adjustment, a modern synthesis": Levenberg-Marquardt with the
points eliminated by the Schur complement, a Cauchy loss by reweighting, and once more without on what agrees.

Pixels alone do not say where the world's origin is, how its axes are turned, or how large it is: see `gauge`.
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration import GATE, centre_by_pose, inflation, reproject, spread_px
from psotrack.cameras import NEAR_M, Camera, CameraRig, to_camera
from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.gauge import common_motions, departure, metric
from psotrack.triangulation import triangulate

#: Weight of a common motion of the whole rig: so large that it is none, so small that sums keep their digits.
_HELD = 1e6
#: Relative change of the cost that ends the search; of the robust one, which only finds the outliers.
_SETTLED, _SETTLED_ROBUST = 1e-10, 1e-4
_MOST_STEPS = 100


@dataclass(frozen=True)
class Adjusted:
    """A rig that its data agree with.

    Attributes:
        rig: adjusted.
        points_m: (points, 3), world, metres; NaN where fewer than two cameras see a point.
        residual_px: (points, cameras), distances in the image, outliers too; NaN where a camera does not see a point.
        used: (points, cameras), False for outliers and what is not seen.
        covariance: (cameras, 6, 6), of a small turn about the camera's axes, rad, and of the translation, m, the rig as
            a whole being held; 0 for cameras that are fixed.
        centre_covariance_m2: (cameras, 3, 3), of the centres, world, m².
        focal_scale: what all focal lengths were multiplied with; 1 where they are fixed.
        focal_scale_std: its standard deviation; 0 where they are fixed.
    """

    rig: CameraRig
    points_m: Float[np.ndarray, "points 3"]
    residual_px: Float[np.ndarray, "points cameras"]
    used: Bool[np.ndarray, "points cameras"]
    covariance: Float[np.ndarray, "cameras 6 6"]
    centre_covariance_m2: Float[np.ndarray, "cameras 3 3"]
    focal_scale: float
    focal_scale_std: float


@dataclass(frozen=True)
class _State:
    T_cam_world: Float[np.ndarray, "cameras 4 4"]
    points_m: Float[np.ndarray, "points 3"]
    focal_scale: float = 1.0


@dataclass(frozen=True)
class _Problem:
    """What does not change while it is solved."""

    lenses: Camera
    given: Float[np.ndarray, "cameras 4 4"]
    points_px: Float[np.ndarray, "points cameras 2"]
    noise_px: float
    #: (unknowns, free): from the unknowns that are sought to all of them; fixed cameras have none.
    free: Float[np.ndarray, "unknowns free"]
    #: (unknowns, motions): common motions that are open, in units of the cameras' own.
    common: Float[np.ndarray, "unknowns motions"]
    #: (motions, unknowns): from a departure to how much of it is common, in units in which all motions count alike.
    held: Float[np.ndarray, "motions unknowns"]


def adjust(
    rig: CameraRig,
    points_px: Float[np.ndarray, "points cameras 2"],
    noise_px: float = 1.0,
    *,
    fixed: Ordered[str] = (),
    refine_focal_length: bool = False,
    groups: Int[np.ndarray, " points"] | None = None,
) -> Adjusted:
    """The rig, and the points, that explain what the cameras see.

    The covariance takes errors in the images for independent between groups of points, and lets the residuals tell how
    much alike they are within: the middle of a drone's box is off in the same way for many frames.

    Args:
        rig: where the cameras are about.
        points_px: (points, cameras, 2), the same points in all cameras; NaN where a camera does not see one.
        noise_px: standard deviation along x and along y.
        fixed: names of cameras that stay where they are.
        refine_focal_length: multiply all focal lengths with a common factor, too.
        groups: (points,), number of each point's group; None where all errors are independent.

    Raises:
        SettingsError: the noise is not above 0, or a fixed camera is not in the rig.
        InputError: the points do not fix the cameras: the message names one that sees too few with others.
    """
    check_positive("noise_px", noise_px)
    unknown = [name for name in fixed if name not in rig.names]
    if unknown:
        raise SettingsError("fixed", expected=f"some of {', '.join(rig.names)}", found=", ".join(unknown))
    if len(set(fixed)) == len(rig) and not refine_focal_length:
        raise SettingsError("fixed", expected="a camera that may move", found="all of them")
    placed = np.isfinite(points_px).all(axis=-1)
    placed &= (placed.sum(axis=1) >= 2)[:, None]
    start_m = triangulate(rig.cameras, np.where(placed[..., None], points_px, np.nan))
    placed &= (np.isfinite(start_m).all(axis=-1) & _before(rig.cameras, start_m))[:, None]
    _check_seen(rig, placed, fixed)
    rows = np.flatnonzero(placed.any(axis=1))
    free, common = _unknowns(rig, fixed, refine_focal_length)
    given = np.asarray(rig.cameras.T_cam_world)
    held = common.T @ metric(given)
    held /= np.sqrt(np.diag(held @ common))[:, None]
    problem = _Problem(rig.cameras, given, points_px[rows], noise_px, free, common, held)
    state, used = _State(given, start_m[rows]), placed[rows]
    state = _solved(problem, state, used, robust=True)
    residual_px = _distance_px(problem, state)
    unknowns = free.shape[1] - common.shape[1] + 3 * len(rows)
    # The gate moves with the fit and the fit with the gate; what swings to and fro ends somewhere.
    for _ in range(5):
        sigma_px = max(noise_px, spread_px(residual_px[used], unknowns))
        within = placed[rows] & (residual_px <= GATE * sigma_px)
        # A point that one camera is left to see has no say, and no place.
        within &= (within.sum(axis=1) >= 2)[:, None]
        before, used = used, within
        state = _solved(problem, state, used, robust=False)
        residual_px = _distance_px(problem, state)
        if (used == before).all():
            break
    _check_seen(rig, used, fixed)
    return _adjusted(rig, problem, state, used, rows, len(points_px), groups)


def _check_seen(rig: CameraRig, placed: Bool[np.ndarray, "points cameras"], fixed: Ordered[str]) -> None:
    for name, count in zip(rig.names, placed.sum(axis=0).tolist(), strict=True):
        # Six unknowns of the pose; with fewer points it swings freely.
        if count < 6 and name not in fixed:
            raise InputError(
                f"camera {name}",
                expected="at least 6 points that another camera sees too",
                found=f"{count}",
                remedy="leave it out, or keep it fixed",
            )


def _unknowns(
    rig: CameraRig, fixed: Ordered[str], refine_focal_length: bool
) -> tuple[Float[np.ndarray, "unknowns free"], Float[np.ndarray, "unknowns motions"]]:
    """What is sought, of 6 unknowns per camera and the focal lengths' logarithm; and the motions that are open."""
    count = len(rig)
    sought = np.array([name not in fixed for name in rig.names])
    free = np.eye(6 * count + 1)[:, np.append(np.repeat(sought, 6), refine_focal_length)]
    motions = common_motions(np.asarray(rig.cameras.T_cam_world))
    held = motions[np.append(np.repeat(~sought, 6), False)]
    if held.size:
        # Those that leave the fixed cameras where they are.
        _, strength, axes = np.linalg.svd(held)
        rank = int((strength > 1e-9 * strength[0]).sum())
        motions = motions @ axes[rank:].T
    return free, motions


@dataclass(frozen=True)
class _Equations:
    """The normal equations with the points eliminated.

    Attributes:
        reduced: (free, free), the Schur complement, the rig as a whole being held.
        right: (free,).
        back: (points, 3, free): from the cameras' steps to those of the points.
        point_step: (points, 3), of the points where the cameras stand still.
    """

    reduced: Float[np.ndarray, "free free"]
    right: Float[np.ndarray, " free"]
    back: Float[np.ndarray, "points 3 free"]
    point_step: Float[np.ndarray, "points 3"]


def _solved(
    problem: _Problem, state: _State, used: Bool[np.ndarray, "points cameras"], *, robust: bool
) -> _State:
    """Levenberg-Marquardt from a state; damping grows where a step does not help."""
    damping, cost = 1e-4, _cost(problem, state, used, robust)
    for _ in range(_MOST_STEPS):
        weights = _weights(problem, state, used, robust)
        for _ in range(12):
            tried = _moved(problem, state, _equations(problem, state, weights, damping))
            tried_cost = _cost(problem, tried, used, robust)
            if tried_cost <= cost:
                break
            damping = max(damping, 1e-6) * 10
        else:
            return state
        gained, cost, state = cost - tried_cost, tried_cost, tried
        damping *= 0.1
        if gained <= (_SETTLED_ROBUST if robust else _SETTLED) * cost:
            return state
    return state


def _cost(problem: _Problem, state: _State, used: Bool[np.ndarray, "points cameras"], robust: bool) -> float:
    squares = (_distance_px(problem, state)[used] / problem.noise_px) ** 2
    common = problem.held @ departure(problem.given, state.T_cam_world)
    loss = np.log1p(squares) if robust else squares
    return float(loss.sum() + _HELD * np.sum(common**2))


def _weights(
    problem: _Problem, state: _State, used: Bool[np.ndarray, "points cameras"], robust: bool
) -> Float[np.ndarray, "points cameras"]:
    squares = np.where(used, _distance_px(problem, state) / problem.noise_px, 0.0) ** 2
    return used / (1 + squares if robust else 1.0) / problem.noise_px**2


def _distance_px(problem: _Problem, state: _State) -> Float[np.ndarray, "points cameras"]:
    columns = []
    for index, T in enumerate(state.T_cam_world):
        pixels, _, _ = reproject(state.points_m, T[:3, :3], T[:3, 3], _lens(problem, state, index))
        columns.append(np.linalg.norm(pixels - problem.points_px[:, index], axis=-1))
    return np.stack(columns, axis=-1)


def _lens(problem: _Problem, state: _State, index: int) -> Camera:
    return _scaled(problem.lenses[index], state.focal_scale)


def _scaled(lenses: Camera, focal_scale: float) -> Camera:
    K = np.array(lenses.K)
    K[..., :2, :2] *= focal_scale
    return replace(lenses, K=K)


def _equations(
    problem: _Problem, state: _State, weights: Float[np.ndarray, "points cameras"], damping: float
) -> _Equations:
    count, free = len(problem.given), problem.free
    points = len(state.points_m)
    of_cameras, right = np.zeros((6 * count + 1, 6 * count + 1)), np.zeros(6 * count + 1)
    of_points, point_right = np.zeros((points, 3, 3)), np.zeros((points, 3))
    mixed = np.zeros((points, 3, 6 * count + 1))
    for index in range(count):
        seen = np.flatnonzero(weights[:, index])
        if not len(seen):
            continue
        by_camera, off = _slopes(problem, state, index, seen)
        by_point = by_camera[..., 3:6] @ state.T_cam_world[index, :3, :3]
        weight = weights[seen, index]
        columns = np.append(np.arange(6 * index, 6 * index + 6), 6 * count)
        of_cameras[np.ix_(columns, columns)] += np.einsum("p,pki,pkj->ij", weight, by_camera, by_camera)
        right[columns] += np.einsum("p,pki,pk->i", weight, by_camera, off)
        of_points[seen] += np.einsum("p,pki,pkj->pij", weight, by_point, by_point)
        point_right[seen] += np.einsum("p,pki,pk->pi", weight, by_point, off)
        mixed[np.ix_(seen, np.arange(3), columns)] += np.einsum("p,pki,pkj->pij", weight, by_point, by_camera)
    of_points += np.eye(3) * damping * np.einsum("pii->p", of_points)[:, None, None] / 3
    # A point that nobody is left to see stays where it is.
    of_points[np.einsum("pii->p", of_points) == 0] = np.eye(3)
    of_cameras, right, mixed = free.T @ of_cameras @ free, free.T @ right, mixed @ free
    of_cameras += np.diag(damping * np.diag(of_cameras))
    held = problem.held @ free
    of_cameras += _HELD * held.T @ held
    right -= _HELD * held.T @ problem.held @ departure(problem.given, state.T_cam_world)
    inverse = np.linalg.inv(of_points)
    back = -inverse @ mixed
    step = np.einsum("pij,pj->pi", inverse, point_right)
    reduced = of_cameras + np.einsum("pki,pkj->ij", mixed, back)
    return _Equations(reduced, right - np.einsum("pki,pk->i", mixed, step), back, step)


def _slopes(
    problem: _Problem, state: _State, index: int, seen: Int[np.ndarray, " seen"]
) -> tuple[Float[np.ndarray, "seen 2 7"], Float[np.ndarray, "seen 2"]]:
    """Derivatives of a camera's pixels by its own six unknowns and the focal lengths', and what they are off by."""
    T, lens = state.T_cam_world[index], _lens(problem, state, index)
    pixels, by_turn, by_shift = reproject(state.points_m[seen], T[:3, :3], T[:3, 3], lens)
    # All focal lengths times e^x: pixels move away from the middle of the image.
    by_focal = (pixels - np.asarray(lens.K)[:2, 2])[..., None]
    return np.concatenate([by_turn, by_shift, by_focal], axis=-1), problem.points_px[seen, index] - pixels


def _design_effect(
    problem: _Problem,
    state: _State,
    weights: Float[np.ndarray, "points cameras"],
    inverse: Float[np.ndarray, "free free"],
    groups: Int[np.ndarray, " points"],
) -> float:
    """How much larger the variances are than of independent errors of the stated noise, on average (Kish 1965).

    From the sum of each group's pull on the cameras, whose errors may be alike; groups are independent.
    """
    count = len(problem.given)
    pulls = np.zeros((len(weights), 6 * count + 1))
    for index in range(count):
        seen = np.flatnonzero(weights[:, index])
        by_camera, off = _slopes(problem, state, index, seen)
        columns = np.append(np.arange(6 * index, 6 * index + 6), 6 * count)
        pulls[np.ix_(seen, columns)] += np.einsum("p,pki,pk->pi", weights[seen, index], by_camera, off)
    _, group = np.unique(groups, return_inverse=True)
    of_groups = np.zeros((group.max() + 1, problem.free.shape[1]))
    np.add.at(of_groups, group, pulls @ problem.free)
    num_groups = len(of_groups)
    if num_groups < 2:
        return 1.0
    total = np.einsum("gi,ij,gj->", of_groups, inverse, of_groups)
    return float(total / (problem.free.shape[1] - problem.common.shape[1]) * num_groups / (num_groups - 1))


def _moved(problem: _Problem, state: _State, equations: _Equations) -> _State:
    step = np.linalg.lstsq(equations.reduced, equations.right, rcond=None)[0]
    whole = problem.free @ step
    T = state.T_cam_world.copy()
    for index in range(len(T)):
        turn, shift = whole[6 * index : 6 * index + 3], whole[6 * index + 3 : 6 * index + 6]
        T[index, :3, :3] = cv2.Rodrigues(turn)[0] @ T[index, :3, :3]
        T[index, :3, 3] += shift
    return _State(
        T,
        state.points_m + equations.point_step + equations.back @ step,
        state.focal_scale * float(np.exp(whole[-1])),
    )


def _adjusted(
    rig: CameraRig,
    problem: _Problem,
    state: _State,
    used: Bool[np.ndarray, "rows cameras"],
    rows: Int[np.ndarray, " rows"],
    num_points: int,
    groups: Int[np.ndarray, " points"] | None,
) -> Adjusted:
    """The answer for all points, with the covariance of the cameras."""
    weights = _weights(problem, state, used, robust=False)
    reduced = _equations(problem, state, weights, damping=0.0).reduced
    scale = np.sqrt(np.diag(reduced))
    if scale.size and np.linalg.cond(reduced / np.outer(scale, scale)) > 1e14:
        raise InputError(
            "cameras",
            expected="points that tie all cameras together",
            found="some that see none of the others' points",
        )
    residual_px = _distance_px(problem, state)
    kept = used.any(axis=1)
    unknowns = problem.free.shape[1] - problem.common.shape[1] + 3 * int(kept.sum())
    squares = float(np.sum((residual_px[used] / problem.noise_px) ** 2))
    covariance = np.linalg.inv(reduced)
    factor = inflation(squares, 2 * int(used.sum()) - unknowns)
    if groups is not None:
        factor = max(factor, _design_effect(problem, state, weights, covariance, groups[rows]))
    covariance = factor * covariance
    covariance = problem.free @ covariance @ problem.free.T
    by_camera, centres = [], []
    for index, T in enumerate(state.T_cam_world):
        block = covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]
        by_pose = centre_by_pose(T[:3, :3], T[:3, 3])
        by_camera.append(block)
        centres.append(by_pose @ block @ by_pose.T)
    points_m = np.full((num_points, 3), np.nan)
    points_m[rows[kept]] = state.points_m[kept]
    all_residual_px = np.full((num_points, len(rig)), np.nan)
    all_residual_px[rows] = residual_px
    all_used = np.zeros((num_points, len(rig)), bool)
    all_used[rows] = used
    return Adjusted(
        CameraRig(rig.names, replace(_scaled(rig.cameras, state.focal_scale), T_cam_world=state.T_cam_world)),
        points_m,
        all_residual_px,
        all_used,
        np.stack(by_camera),
        np.stack(centres),
        state.focal_scale,
        state.focal_scale * float(np.sqrt(covariance[-1, -1])),
    )


def _before(cameras: Camera, points_m: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Points that are in front of most cameras."""
    return np.median(to_camera(cameras, points_m[:, None, :])[..., 2], axis=-1) > NEAR_M
