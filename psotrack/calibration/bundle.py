"""Bundle adjustment of lenses, cameras and targets: residuals, derivatives and normal equations.

A target is a board, a marker or a single point. Its corner X is seen at K(R_c (s R_t X + t_t) + t_c), with the camera's
pose (R_c, t_c), the target's pose (R_t, t_t) and the target's size s. The unknowns of the lenses and the poses of one
kind are shared; the poses of the other kind are blocks, which `psotrack.geometry.estimation` eliminates (B. Triggs,
P. McLauchlan, R. Hartley, A. Fitzgibbon, Bundle adjustment, a modern synthesis, 2000): a board's poses before cameras
that stand still, or a camera's poses before markers that hang on walls. A single point is a target with one corner, its
origin, whose turn nothing shows.

Where a shutter rolls, each camera's pose has six more unknowns, its motion from the image's middle row to its last one
(J. Hedborg, P.-E. Forssén, M. Felsberg, E. Ringaby, Rolling shutter bundle adjustment, CVPR 2012).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import log
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration.lens_models import LensModel
from psotrack.geometry import NEAR_M, Camera, cross_matrices, to_pixels_with_jacobian
from psotrack.geometry.estimation import (
    NormalEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    levenberg_marquardt,
)

#: A point is an outlier beyond this number of standard deviations: 4 in a million good points are.
GATE = 5.0
_MAX_STEPS = 100
#: Relative change of the cost that ends the search; the robust search only has to find the outliers.
_LEAST_GAIN, _LEAST_GAIN_ROBUST = 1e-9, 1e-4
#: Noise of a corner, pixels, below which no outlier is looked for.
LEAST_NOISE_PX = 0.02


def spread_px(distance_px: Float[np.ndarray, " residuals"], unknowns: int) -> float:
    """Estimate σ along each axis from the median of distances in the image, which may contain outliers.

    Args:
        distance_px: (residuals,), distances of a fit, pixels. With no more equations than unknowns the result is 0.
        unknowns: number of fitted unknowns.
    """
    equations = 2 * len(distance_px)
    if equations <= unknowns:
        return 0.0
    # The median of a Rayleigh distribution is σ √(2 ln 2); a fit takes the unknowns' part of the squares away.
    return float(np.median(distance_px) / np.sqrt(2 * log(2) * (1 - unknowns / equations)))


def centre_by_pose(R: Float[np.ndarray, "3 3"], t_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 6"]:
    """(3, 6), derivative of a camera's centre, -Rᵀ t, by a small turn about its axes and by its translation."""
    return np.hstack([-R.T @ cross_matrices(t_m), -R.T])


@dataclass(frozen=True)
class KnownLens:
    """A lens that is known: its unknowns, if there are any, do not change it."""

    camera: Camera

    def project(self, lens: Any, points_m: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `LensModel.project`: pixels of points in the camera's axes, and derivatives by points and lens."""
        return *to_pixels_with_jacobian(self.camera, points_m), np.zeros((len(points_m), 2, len(lens)))


#: A lens as a vector of unknowns, which may be empty.
Projection = LensModel | KnownLens


@dataclass(frozen=True)
class BundleState:
    """Values of all unknowns.

    Attributes:
        lenses: vector of each lens.
        T_cam_world: (cameras, 4, 4), world to camera, metres.
        T_world_target: (targets, 4, 4), target to world, metres.
        size: (targets,), factor of the target's corners.
        motion: (cameras, 6), turn about the camera's axes (rad) and shift along them (m) from an image's middle row to
            its last one; None of a global shutter.
    """

    lenses: tuple[np.ndarray, ...]
    T_cam_world: Float[np.ndarray, "cameras 4 4"]
    T_world_target: Float[np.ndarray, "targets 4 4"]
    size: Float[np.ndarray, " targets"]
    motion: Float[np.ndarray, "cameras 6"] | None = None


@dataclass(frozen=True)
class BundleProblem:
    """Data of the adjustment. A sighting is one target in one image.

    Attributes:
        models: model of each lens.
        priors: for each lens, a value of its unknowns before any sighting, and the information about them.
        corners_m: (corners, 3), positions on a target of size 1, metres.
        lens, camera, target: (sightings,), indices of a sighting's lens, pose of the camera, and target.
        corners_px: (sightings, corners, 2), pixels; NaN where a corner is not seen.
        noise_px: (sightings,), standard deviation of a corner along x and along y.
        free_lens: for each lens, True for the unknowns that are adjusted.
        free_camera: (cameras,), True for the poses that are adjusted.
        free_target: (targets, 7), True for the unknowns that are adjusted: turn, shift, logarithm of the size.
        cameras_are_blocks: whether the cameras' poses are eliminated, instead of the targets'.
        is_whole: whether a robust loss is of a whole sighting, instead of one corner.
        inward: (sightings, corners, 2), shift of the corners by the only unknown of each lens, its inset; None if the
            lenses have none.
        row: (sightings, corners), rows of the corners, -1 for an image's middle to 1; None of a global shutter.
        motion_std: (cameras, 6), standard deviations of the motion.
    """

    models: tuple[Projection, ...]
    priors: tuple[tuple[np.ndarray, np.ndarray], ...]
    corners_m: Float[np.ndarray, "corners 3"]
    lens: Int[np.ndarray, " sightings"]
    camera: Int[np.ndarray, " sightings"]
    target: Int[np.ndarray, " sightings"]
    corners_px: Float[np.ndarray, "sightings corners 2"]
    noise_px: Float[np.ndarray, " sightings"]
    free_lens: tuple[np.ndarray, ...]
    free_camera: Bool[np.ndarray, " cameras"]
    free_target: Bool[np.ndarray, "targets 7"]
    cameras_are_blocks: bool = False
    is_whole: bool = False
    inward: Float[np.ndarray, "sightings corners 2"] | None = None
    row: Float[np.ndarray, "sightings corners"] | None = None
    motion_std: Float[np.ndarray, "cameras 6"] | None = None

    @cached_property
    def _numbers(self) -> tuple[tuple[np.ndarray, ...], Int[np.ndarray, "poses unknowns"]]:
        free = self.free_target if self.cameras_are_blocks else np.tile(self.free_camera, (6, 1)).T
        flat = np.concatenate([*self.free_lens, free.ravel()])
        number = np.where(flat, np.cumsum(flat) - 1, -1)
        ends = np.cumsum([len(of_lens) for of_lens in self.free_lens])
        *lenses, poses = np.split(number, ends)
        return tuple(lenses), poses.reshape(free.shape)

    @property
    def lens_columns(self) -> tuple[np.ndarray, ...]:
        """For each lens, the index of each of its unknowns among the shared unknowns; -1 where it is not adjusted."""
        return self._numbers[0]

    @property
    def pose_columns(self) -> Int[np.ndarray, "poses unknowns"]:
        """(poses, unknowns), indices of the unknowns of the shared poses among the shared unknowns, or -1."""
        return self._numbers[1]

    @cached_property
    def size(self) -> int:
        """Number of shared unknowns."""
        return 1 + max(int(columns.max(initial=-1)) for columns in (*self.lens_columns, self.pose_columns))

    @property
    def block(self) -> Int[np.ndarray, " sightings"]:
        """(sightings,), index of the block."""
        return self.camera if self.cameras_are_blocks else self.target

    @cached_property
    def columns(self) -> Int[np.ndarray, "sightings unknowns"]:
        """(sightings, unknowns), indices of a sighting's unknowns, lens and pose, among the shared unknowns, or -1."""
        widest = max(map(len, self.lens_columns))
        lenses = np.array(
            [np.pad(one, (0, widest - len(one)), constant_values=-1) for one in self.lens_columns]
        )
        pose = self.target if self.cameras_are_blocks else self.camera
        return np.concatenate([lenses[self.lens], self.pose_columns[pose]], axis=1)


@dataclass(frozen=True)
class SightingEquations:
    """Parts of the normal equations, one for each sighting.

    Attributes:
        columns: (sightings, unknowns), indices among the shared unknowns; the number of these where not adjusted.
        shared: (sightings, unknowns, unknowns), information about the shared unknowns.
        coupling: (sightings, m, unknowns), between the block's and the shared unknowns.
        block: (sightings, m, m), information about the block.
        shared_right: (sightings, unknowns), right-hand side of the shared unknowns.
        block_right: (sightings, m), right-hand side of the block.
        cost: (sightings,), sum of the losses.
        slip: (sightings, 6), turn and shift of the target against its pose, as this sighting has it.
        slip_covariance: (sightings, 6, 6), covariance of the slip.
    """

    columns: Int[np.ndarray, "sightings unknowns"]
    shared: Float[np.ndarray, "sightings unknowns unknowns"]
    coupling: Float[np.ndarray, "sightings m unknowns"]
    block: Float[np.ndarray, "sightings m m"]
    shared_right: Float[np.ndarray, "sightings unknowns"]
    block_right: Float[np.ndarray, "sightings m"]
    cost: Float[np.ndarray, " sightings"]
    slip: Float[np.ndarray, "sightings 6"]
    slip_covariance: Float[np.ndarray, "sightings 6 6"]


@dataclass(frozen=True)
class Bundle:
    """A state with its residuals, `estimation.least_squares.Linearised`.

    Attributes:
        problem: data of the adjustment.
        state: values of the unknowns.
        used: (sightings, corners), True for the corners that count.
        is_robust: whether the loss is Cauchy's instead of the squared residual; only without slips.
        slip_std: (sightings, 2), standard deviations of a sighting's slip, turn in rad and shift in m; None for
            sightings that all show a target at the same pose.
    """

    problem: BundleProblem
    state: BundleState
    used: Bool[np.ndarray, "sightings corners"]
    is_robust: bool = False
    slip_std: Float[np.ndarray, "sightings 2"] | None = None

    @staticmethod
    def of_views(
        models: tuple[Projection, ...],
        state: BundleState,
        corners_m: Float[np.ndarray, "corners 3"],
        views_px: Float[np.ndarray, "cameras targets corners 2"],
        *,
        free: tuple[Bool[np.ndarray, " cameras"], Bool[np.ndarray, " targets"]],
        noise_px: float = 1.0,
    ) -> Bundle:
        """The adjustment, with a robust loss, of cameras and targets whose lenses are known as yet.

        Args:
            models: model of each camera's lens.
            state: first values of the unknowns.
            corners_m: positions on a target.
            views_px: pixels; NaN where a corner is not seen.
            free: True for the cameras, and for the targets, that are adjusted.
            noise_px: standard deviation of a corner along x and along y.
        """
        camera, target = np.nonzero(np.isfinite(views_px[..., 0]).any(axis=-1))
        problem = BundleProblem(
            models=models,
            priors=tuple((lens, np.zeros((len(lens), len(lens)))) for lens in state.lenses),
            corners_m=corners_m,
            lens=camera,
            camera=camera,
            target=target,
            corners_px=views_px[camera, target],
            noise_px=np.full(len(camera), noise_px),
            free_lens=tuple(np.zeros(len(lens), bool) for lens in state.lenses),
            free_camera=free[0],
            free_target=np.tile(free[1], (7, 1)).T,
        )
        return Bundle(problem, state, np.isfinite(problem.corners_px).all(axis=-1), is_robust=True)

    @cached_property
    def slopes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals, measured less projected, infinite behind the camera; derivatives by shared and block unknowns."""
        problem, state = self.problem, self.state
        T, place = state.T_cam_world[problem.camera, None], state.T_world_target[problem.target, None]
        size = state.size[problem.target, None, None]
        arm = size * np.matvec(place[..., :3, :3], problem.corners_m)
        turned = np.matvec(T[..., :3, :3], arm + place[..., :3, 3])
        in_camera = turned + T[..., :3, 3]
        if problem.row is not None and state.motion is not None:
            # The turn and the shift since the middle row follow the pose of the middle row.
            moved = problem.row[..., None] * state.motion[problem.camera, None]
            R_row = Rotation.from_rotvec(moved[..., :3].reshape(-1, 3)).as_matrix()
            in_camera = np.matvec(R_row.reshape(*turned.shape, 3), in_camera) + moved[..., 3:]
        off, by_point = np.empty(problem.corners_px.shape), np.empty((*turned.shape[:2], 2, 3))
        by_lens = np.zeros((*turned.shape[:2], 2, max(map(len, state.lenses))))
        for index, (model, lens) in enumerate(zip(problem.models, state.lenses, strict=True)):
            rows = problem.lens == index
            if rows.any():
                shape = off[rows].shape
                pixels, slope, of_lens = model.project(lens, in_camera[rows].reshape(-1, 3))
                off[rows] = problem.corners_px[rows] - pixels.reshape(shape)
                by_point[rows] = slope.reshape(*shape, 3)
                by_lens[rows, ..., : of_lens.shape[-1]] = of_lens.reshape(*shape, of_lens.shape[-1])
        off[(in_camera[..., 2] <= NEAR_M) & np.isfinite(off[..., 0])] = np.inf
        if problem.inward is not None:
            off -= np.ravel(state.lenses)[problem.lens, None, None] * problem.inward
            by_lens[..., 0] = problem.inward
        # A turn by w moves a point q by w x q = -[q] w; a larger size moves a point along the arm.
        by_camera = [-by_point @ cross_matrices(turned), by_point]
        if problem.row is not None:
            row = problem.row[..., None, None]
            by_camera += [-row * by_point @ cross_matrices(in_camera), row * by_point]
        by_world = by_point @ T[..., :3, :3]
        by_target = [-by_world @ cross_matrices(arm), by_world]
        if problem.cameras_are_blocks:
            by_target.append(by_world @ arm[..., None])
            by_shared, by_block, is_free = [by_lens, *by_target], by_camera, problem.free_camera[:, None]
        else:
            by_shared, by_block, is_free = [by_lens, *by_camera], by_target, problem.free_target[:, :6]
        of_block = np.concatenate(by_block, axis=-1) * is_free[problem.block, None, None]
        return off, np.concatenate(by_shared, axis=-1), of_block

    @cached_property
    def distance_px(self) -> Float[np.ndarray, "sightings corners"]:
        """(sightings, corners), distances in the image; NaN where not seen, infinite behind the camera."""
        return np.asarray(np.linalg.norm(self.slopes[0], axis=-1))

    @property
    def own_distance_px(self) -> Float[np.ndarray, "sightings corners"]:
        """The same distances with each sighting's slip taken away."""
        off, _, by_block = self.slopes
        return np.asarray(np.linalg.norm(off - np.matvec(by_block, self.sightings.slip[:, None]), axis=-1))

    @property
    def weight(self) -> Float[np.ndarray, "sightings corners"]:
        """(sightings, corners), weights of the squared residuals, px⁻²; 0 where not used."""
        squares, width = self._squares
        weight = cauchy_weight(squares, width) if self.is_robust else np.ones_like(squares)
        return self.used * weight / self.problem.noise_px[:, None] ** 2

    @property
    def _squares(self) -> tuple[np.ndarray, float]:
        """Squares of used distances in standard deviations, of each corner or of a whole sighting; their number."""
        squares = np.where(self.used, self.distance_px / self.problem.noise_px[:, None], 0.0) ** 2
        if not self.problem.is_whole:
            return squares, 1.0
        return squares.sum(axis=1, keepdims=True), 2.0 * squares.shape[1]

    @cached_property
    def sightings(self) -> SightingEquations:
        """Parts of the normal equations of each sighting."""
        off, by_shared, by_block = self.slopes
        is_free = (self.problem.columns >= 0).any(axis=0)
        columns, size, m = self.problem.columns[:, is_free], int(is_free.sum()), by_block.shape[-1]
        # One product of matrices for each sighting, of all derivatives and residuals.
        known = np.where((self.used & np.isfinite(self.distance_px))[..., None], off, 0.0)
        parts = np.concatenate([by_shared[..., is_free], by_block, known[..., None]], axis=-1)
        rows = (np.sqrt(self.weight)[..., None, None] * parts).reshape(len(off), -1, size + m + 1)
        products = rows.swapaxes(-1, -2) @ rows
        shared, coupling, block = (
            products[:, :size, :size],
            products[:, size:-1, :size],
            products[:, size:-1, size:-1],
        )
        shared_right, block_right = products[:, :size, -1], products[:, size:-1, -1]
        squares, width = self._squares
        cost = (cauchy_loss(squares, width) if self.is_robust else squares).sum(axis=1)
        slip, covariance = np.zeros((len(off), 6)), np.zeros((len(off), 6, 6))
        if self.slip_std is not None:
            # A sighting's slip is an unknown of its own, with a normal distribution: it is eliminated here.
            precision = np.repeat(self.slip_std**-2, 3, axis=-1)
            covariance = _inverses(block + precision[:, None, :] * np.eye(6))
            slip, gain = np.matvec(covariance, block_right), covariance @ coupling
            shared = shared - coupling.swapaxes(-1, -2) @ gain
            shared_right = shared_right - np.matvec(coupling.swapaxes(-1, -2), slip)
            # Below 0 only where a step that is tried puts a target into a camera: no such step is taken.
            rest = cost - np.vecdot(block_right, slip)
            cost = np.where(rest < -1e-6 * cost, np.inf, np.maximum(rest, 0.0))
            # I - block @ covariance is precision @ covariance, which loses no digits.
            block = precision[..., None] * (covariance @ block)
            coupling, block_right = precision[..., None] * gain, precision * slip
        columns = np.where(columns < 0, self.problem.size, columns)
        return SightingEquations(
            columns, shared, coupling, block, shared_right, block_right, cost, slip, covariance
        )

    @cached_property
    def cost(self) -> float:
        """Sum of the losses, and what is known before any sighting."""
        known = sum(
            float((value - lens) @ information @ (value - lens))
            for lens, (value, information) in zip(self.state.lenses, self.problem.priors, strict=True)
        )
        if self.state.motion is not None:
            known += float(np.sum((self.state.motion / self.problem.motion_std) ** 2))
        return float(self.sightings.cost.sum()) + known

    @cached_property
    def by_block(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For each block, coupling to the shared unknowns, information about its own, and their right-hand side."""
        problem, parts = self.problem, self.sightings
        size, m = problem.size, parts.block.shape[-1]
        count = len(self.state.T_cam_world if problem.cameras_are_blocks else self.state.T_world_target)
        block, own = problem.block[:, None, None], np.arange(m)
        coupling = summed(parts.coupling, (block, own[:, None], parts.columns[:, None]), (count, m, size + 1))
        blocks = summed(parts.block, (block, own[:, None], own), (count, m, m))
        return coupling[..., :-1], blocks, summed(parts.block_right, (block[..., 0], own), (count, m))

    def equations(self) -> NormalEquations:
        """Normal equations."""
        problem, parts, column, size = self.problem, self.sightings, self.sightings.columns, self.problem.size
        coupling, blocks, block_right = self.by_block
        blocks, block_right = blocks.copy(), block_right.copy()
        information = summed(parts.shared, (column[:, :, None], column[:, None]), (size + 1, size + 1))
        right = summed(parts.shared_right, (column,), (size + 1,))
        for columns, lens, (value, known) in zip(
            problem.lens_columns, self.state.lenses, problem.priors, strict=True
        ):
            free = columns >= 0
            information[np.ix_(columns[free], columns[free])] += known[np.ix_(free, free)]
            right[columns[free]] += (known @ (value - lens))[free]
        # What is not adjusted or not seen stays as it is: a target, or the turn of a single point.
        diagonal = np.einsum("bii->bi", blocks)
        diagonal[diagonal == 0] = 1.0
        if self.state.motion is not None and problem.motion_std is not None:
            diagonal[:, 6:] += problem.motion_std**-2.0
            block_right[:, 6:] -= self.state.motion / problem.motion_std**2
        return NormalEquations(
            information[:-1, :-1], right[:-1], blocks, block_right, np.ascontiguousarray(coupling)
        )

    def moved(self, step: Step) -> Bundle:
        """Change the lenses, turn and shift cameras and targets, and change sizes and motions."""
        if step.blocks is None:
            raise TypeError("expected a step with blocks, found none")
        problem, state, shared = self.problem, self.state, np.append(step.shared, 0.0)
        poses, blocks = shared[problem.pose_columns], step.blocks
        of_cameras, of_targets = (blocks, poses) if problem.cameras_are_blocks else (poses, blocks)
        size, motion = state.size, state.motion
        if problem.cameras_are_blocks:
            size = size * np.exp(np.clip(of_targets[:, 6], -1, 1))
            motion = None if motion is None else motion + of_cameras[:, 6:]
        moved = BundleState(
            tuple(
                lens + shared[columns]
                for lens, columns in zip(state.lenses, problem.lens_columns, strict=True)
            ),
            _moved(state.T_cam_world, of_cameras),
            _moved(state.T_world_target, of_targets),
            size,
            motion,
        )
        return replace(self, state=moved)

    def solved(self) -> Bundle:
        """Lower the cost from this state. A corner that is behind a camera at the start does not count."""
        least_gain = _LEAST_GAIN_ROBUST if self.is_robust else _LEAST_GAIN
        start = replace(self, used=self.used & np.isfinite(self.distance_px))
        found = levenberg_marquardt(start, max_steps=_MAX_STEPS, least_gain=least_gain)
        return replace(found, used=self.used)


def summed(
    values: Float[np.ndarray, "*values"], index: tuple[np.ndarray, ...], shape: tuple[int, ...]
) -> np.ndarray:
    """An array of a shape with the sums of all values that have the same index."""
    flat = np.broadcast_to(np.ravel_multi_index(np.broadcast_arrays(*index), shape), values.shape)
    sums: np.ndarray = np.bincount(flat.ravel(), values.ravel(), minlength=int(np.prod(shape)))
    return sums.reshape(shape).astype(np.float64)


def _moved(
    T: Float[np.ndarray, "poses 4 4"], change: Float[np.ndarray, "poses unknowns"]
) -> Float[np.ndarray, "poses 4 4"]:
    """Turn poses by small turns about the axes that they lead to, rad, and shift them, metres: turns first."""
    moved = T.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(change[:, :3]).as_matrix() @ T[:, :3, :3]
    moved[:, :3, 3] += change[:, 3:6]
    return moved


def _inverses(matrices: Float[np.ndarray, "sightings 6 6"]) -> Float[np.ndarray, "sightings 6 6"]:
    """Inverses of symmetric matrices; pseudo-inverses if one is singular to rounding, after a step that is far off."""
    try:
        inverses: np.ndarray = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        inverses = np.linalg.pinv(matrices, hermitian=True)
    return inverses


def median_by_camera(bundle: Bundle, distance_px: Float[np.ndarray, "sightings corners"]) -> np.ndarray:
    """(sightings,), the median distance of all corners that a sighting's camera sees, at least `LEAST_NOISE_PX`."""
    camera = bundle.problem.camera
    medians = np.full(len(camera), LEAST_NOISE_PX)
    for index in np.unique(camera):
        medians[camera == index] = max(LEAST_NOISE_PX, np.nanmedian(distance_px[camera == index]))
    return medians


def solve_robustly(bundle: Bundle, rounds: int = 3) -> Bundle:
    """Lower a robust cost whose width is the residuals' own: wide at a poor start, narrow near the solution."""
    for _ in range(rounds):
        noise_px = median_by_camera(bundle, bundle.distance_px)
        problem = replace(bundle.problem, noise_px=noise_px)
        bundle = replace(bundle, problem=problem, is_robust=True).solved()
    return bundle
