"""The least squares of a bundle adjustment: Levenberg-Marquardt with the points eliminated (see `bundle`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.derivatives import reproject
from psotrack.calibration.gauge import pose_changes
from psotrack.geometry import Camera

#: Weight of a common motion of the whole rig: so large that it is none, so small that sums keep their digits.
_HELD = 1e6
#: Relative change of the cost that ends the search; of the robust one, which only finds the outliers.
_SETTLED, _SETTLED_ROBUST = 1e-10, 1e-4
_MOST_STEPS = 100


@dataclass(frozen=True)
class BundleState:
    """What is sought."""

    T_cam_world: Float[np.ndarray, "cameras 4 4"]
    points_m: Float[np.ndarray, "points 3"]
    focal_scale: float = 1.0


@dataclass(frozen=True)
class Problem:
    """What does not change while it is solved."""

    lenses: Camera
    given: Float[np.ndarray, "cameras 4 4"]
    points_px: Float[np.ndarray, "points cameras 2"]
    noise_px: Float[np.ndarray, "points cameras"]
    #: (cameras,), whose focal lengths are multiplied.
    rescaled: Bool[np.ndarray, " cameras"]
    #: (unknowns, free): from the unknowns that are sought to all of them; fixed cameras have none.
    free: Float[np.ndarray, "unknowns free"]
    #: (unknowns, motions): common motions that are open, in units of the cameras' own.
    common: Float[np.ndarray, "unknowns motions"]
    #: (motions, unknowns): projection of pose changes on the common motions, all of equal weight.
    held: Float[np.ndarray, "motions unknowns"]


@dataclass(frozen=True)
class Equations:
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


def solved(
    problem: Problem, state: BundleState, used: Bool[np.ndarray, "points cameras"], *, robust: bool
) -> BundleState:
    """Levenberg-Marquardt from a state; damping grows where a step does not help."""
    damping, cost = 1e-4, _cost(problem, state, used, robust)
    for _ in range(_MOST_STEPS):
        weights = weights_of(problem, state, used, robust)
        for _ in range(12):
            tried = _moved(problem, state, equations_of(problem, state, weights, damping))
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


def _cost(
    problem: Problem, state: BundleState, used: Bool[np.ndarray, "points cameras"], robust: bool
) -> float:
    squares = (distance_px(problem, state) / problem.noise_px)[used] ** 2
    common = problem.held @ pose_changes(problem.given, state.T_cam_world)
    loss = np.log1p(squares) if robust else squares
    return float(loss.sum() + _HELD * np.sum(common**2))


def weights_of(
    problem: Problem, state: BundleState, used: Bool[np.ndarray, "points cameras"], robust: bool
) -> Float[np.ndarray, "points cameras"]:
    """1 / variance of what counts, less where it is far off and the loss robust; else 0."""
    squares = np.where(used, distance_px(problem, state) / problem.noise_px, 0.0) ** 2
    return used / (1 + squares if robust else 1.0) / problem.noise_px**2


def distance_px(problem: Problem, state: BundleState) -> Float[np.ndarray, "points cameras"]:
    """Distances in the image between projections and what is seen."""
    columns = []
    for index, T in enumerate(state.T_cam_world):
        pixels, _, _ = reproject(state.points_m, T[:3, :3], T[:3, 3], _lens(problem, state, index))
        columns.append(np.linalg.norm(pixels - problem.points_px[:, index], axis=-1))
    return np.stack(columns, axis=-1)


def _lens(problem: Problem, state: BundleState, index: int) -> Camera:
    return (
        scaled(problem.lenses[index], state.focal_scale) if problem.rescaled[index] else problem.lenses[index]
    )


def scaled(lenses: Camera, focal_scale: float | Float[np.ndarray, " cameras"]) -> Camera:
    """Lenses with their focal lengths multiplied, by one factor or each by its own."""
    K = np.array(lenses.K)
    K[..., :2, :2] *= np.asarray(focal_scale)[..., None, None]
    return replace(lenses, K=K)


def equations_of(
    problem: Problem, state: BundleState, weights: Float[np.ndarray, "points cameras"], damping: float
) -> Equations:
    """The normal equations at a state; a share `damping` of the diagonal is added to it."""
    count, free = len(problem.given), problem.free
    points = len(state.points_m)
    of_cameras, right = np.zeros((6 * count + 1, 6 * count + 1)), np.zeros(6 * count + 1)
    of_points, point_right = np.zeros((points, 3, 3)), np.zeros((points, 3))
    mixed = np.zeros((points, 3, 6 * count + 1))
    for index in range(count):
        seen = np.flatnonzero(weights[:, index])
        if not len(seen):
            continue
        by_camera, off = slopes_of(problem, state, index, seen)
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
    right -= _HELD * held.T @ problem.held @ pose_changes(problem.given, state.T_cam_world)
    inverse = np.linalg.inv(of_points)
    back = -inverse @ mixed
    step = np.einsum("pij,pj->pi", inverse, point_right)
    reduced = of_cameras + np.einsum("pki,pkj->ij", mixed, back)
    return Equations(reduced, right - np.einsum("pki,pk->i", mixed, step), back, step)


def slopes_of(
    problem: Problem, state: BundleState, index: int, seen: Int[np.ndarray, " seen"]
) -> tuple[Float[np.ndarray, "seen 2 7"], Float[np.ndarray, "seen 2"]]:
    """Derivatives of a camera's pixels by its own six unknowns and the focal length's, and what they are off by."""
    T, lens = state.T_cam_world[index], _lens(problem, state, index)
    pixels, by_turn, by_shift = reproject(state.points_m[seen], T[:3, :3], T[:3, 3], lens)
    # Focal lengths times e^x: pixels move away from the middle of the image.
    by_focal = problem.rescaled[index] * (pixels - np.asarray(lens.K)[:2, 2])[..., None]
    return np.concatenate([by_turn, by_shift, by_focal], axis=-1), problem.points_px[seen, index] - pixels


def _moved(problem: Problem, state: BundleState, equations: Equations) -> BundleState:
    step = np.linalg.lstsq(equations.reduced, equations.right, rcond=None)[0]
    whole = problem.free @ step
    T = state.T_cam_world.copy()
    for index in range(len(T)):
        turn, shift = whole[6 * index : 6 * index + 3], whole[6 * index + 3 : 6 * index + 6]
        T[index, :3, :3] = cv2.Rodrigues(turn)[0] @ T[index, :3, :3]
        T[index, :3, 3] += shift
    return BundleState(
        T,
        state.points_m + equations.point_step + equations.back @ step,
        state.focal_scale * float(np.exp(whole[-1])),
    )
