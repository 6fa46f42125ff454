"""Bundle adjustment of lenses, cameras and boards: residuals, derivatives and normal equations.

A corner X of the board is seen at K(R_c (R_b X + t_b) + t_c). The unknowns of the lenses and the cameras are shared by
all instants; the board's pose at an instant is a block, which `psotrack.geometry.estimation` eliminates. A single point
is a board with one corner, its origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration.lens_models import LensModel
from psotrack.geometry import cross_matrices
from psotrack.geometry.estimation import (
    NormalEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    levenberg_marquardt,
)

_MAX_STEPS = 100
#: Relative change of the cost that ends the search; the robust search only has to find the outliers.
_LEAST_GAIN, _LEAST_GAIN_ROBUST = 1e-9, 1e-4
#: Noise of a corner, pixels, below which no outlier is looked for.
LEAST_NOISE_PX = 0.02


@dataclass(frozen=True)
class CameraCorners:
    """Corners that one camera sees, in the order of the instants.

    Attributes:
        instant: (seen,), index of the instant.
        corner: (seen,), index of the corner of the board.
        points_px: (seen, 2), pixels.
    """

    instant: Int[np.ndarray, " seen"]
    corner: Int[np.ndarray, " seen"]
    points_px: Float[np.ndarray, "seen 2"]

    @cached_property
    def instants(self) -> Int[np.ndarray, " views"]:
        """(views,), the instants at which the camera sees corners."""
        return np.unique(self.instant)

    @cached_property
    def view(self) -> Int[np.ndarray, " seen"]:
        """(seen,), index of the corner's view among `instants`."""
        return np.searchsorted(self.instants, self.instant)

    @cached_property
    def rank(self) -> Int[np.ndarray, " seen"]:
        """(seen,), number of the corner among the corners of its view."""
        return np.arange(len(self.instant)) - np.searchsorted(self.instant, self.instant)

    @staticmethod
    def of(corners_px: Float[np.ndarray, "instants corners 2"]) -> CameraCorners:
        """Corners of one camera's views; NaN where a corner is not seen."""
        instant, corner = np.nonzero(np.isfinite(corners_px).all(axis=-1))
        return CameraCorners(instant, corner, corners_px[instant, corner])


@dataclass(frozen=True)
class BoardState:
    """Unknowns of the adjustment.

    Attributes:
        lenses: vector of each lens (see `lens_models`).
        T_cam_world: (cameras, 4, 4), world to camera, metres.
        T_world_board: (instants, 4, 4), board to world, metres.
    """

    lenses: tuple[np.ndarray, ...]
    T_cam_world: Float[np.ndarray, "cameras 4 4"]
    T_world_board: Float[np.ndarray, "instants 4 4"]


@dataclass(frozen=True)
class BoardProblem:
    """Data of the adjustment.

    Attributes:
        models: model of each lens.
        lens_of: (cameras,), index of each camera's lens.
        image_size_wh: (lenses, 2), width and height of the images, pixels.
        corners_m: (corners, 3), positions on the board, metres.
        seen: corners that each camera sees.
        noise_px: (cameras,), standard deviation of a pixel along x and along y.
        free_lens: for each lens, True for the unknowns that are adjusted.
        free_camera: (cameras,), True for the cameras that are adjusted.
        free_board: (instants,), True for the instants at which the board's pose is adjusted.
    """

    models: tuple[LensModel, ...]
    lens_of: Int[np.ndarray, " cameras"]
    image_size_wh: Int[np.ndarray, "lenses 2"]
    corners_m: Float[np.ndarray, "corners 3"]
    seen: tuple[CameraCorners, ...]
    noise_px: Float[np.ndarray, " cameras"]
    free_lens: tuple[np.ndarray, ...]
    free_camera: Bool[np.ndarray, " cameras"]
    free_board: Bool[np.ndarray, " instants"]

    @cached_property
    def lens_columns(self) -> tuple[np.ndarray, ...]:
        """For each lens, the index of each of its unknowns among the shared unknowns; -1 where it is not adjusted."""
        columns, first = [], 0
        for free in self.free_lens:
            columns.append(np.where(free, first + np.cumsum(free) - 1, -1))
            first += int(free.sum())
        return tuple(columns)

    @cached_property
    def camera_columns(self) -> Int[np.ndarray, "cameras 6"]:
        """(cameras, 6), indices of a camera's turn and shift among the shared unknowns; -1 where it is not adjusted."""
        first = sum(int(free.sum()) for free in self.free_lens)
        order = np.cumsum(self.free_camera) - 1
        return np.where(self.free_camera[:, None], first + 6 * order[:, None] + np.arange(6), -1)

    @cached_property
    def size(self) -> int:
        """Number of shared unknowns."""
        return sum(int(free.sum()) for free in self.free_lens) + 6 * int(self.free_camera.sum())

    def columns(self, camera: int) -> Int[np.ndarray, " unknowns"]:
        """Indices of the unknowns of a camera's lens and of its pose among the shared unknowns, or -1."""
        return np.concatenate([self.lens_columns[self.lens_of[camera]], self.camera_columns[camera]])


@dataclass(frozen=True)
class ViewEquations:
    """Parts of the normal equations, one for each view of one camera.

    Attributes:
        instant: (views,), index of the instant.
        unknowns: (unknowns,), indices of the camera's adjusted unknowns, lens and pose, among the shared unknowns.
        shared: (views, unknowns, unknowns), information about the camera's unknowns.
        coupling: (views, 6, unknowns), between the board's pose and the camera's unknowns.
        board: (views, 6, 6), information about the board's pose.
        shared_right: (views, unknowns), right-hand side of the camera's unknowns.
        board_right: (views, 6), right-hand side of the board's pose.
        cost: (views,), sum of the losses.
        slip: (views, 6), turn and shift of the board against its pose at the instant, as this view has it.
        slip_covariance: (views, 6, 6), covariance of the slip.
    """

    instant: Int[np.ndarray, " views"]
    unknowns: Int[np.ndarray, " unknowns"]
    shared: Float[np.ndarray, "views unknowns unknowns"]
    coupling: Float[np.ndarray, "views 6 unknowns"]
    board: Float[np.ndarray, "views 6 6"]
    shared_right: Float[np.ndarray, "views unknowns"]
    board_right: Float[np.ndarray, "views 6"]
    cost: Float[np.ndarray, " views"]
    slip: Float[np.ndarray, "views 6"]
    slip_covariance: Float[np.ndarray, "views 6 6"]


@dataclass(frozen=True)
class BoardBundle:
    """A state of the problem with its residuals, `estimation.least_squares.Linearised`.

    Attributes:
        problem: data of the adjustment.
        state: values of the unknowns.
        used: for each camera, (seen,), True for the corners that count.
        robust: whether the loss is Cauchy's instead of the squared residual; only without slips.
        slip_std: for each camera, (instants, 2), standard deviations of a view's slip, turn in rad and shift in m; None
            for views that all show the board at the same pose.
    """

    problem: BoardProblem
    state: BoardState
    used: tuple[np.ndarray, ...]
    robust: bool = False
    slip_std: tuple[np.ndarray, ...] | None = None

    @cached_property
    def _projected(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """For each camera: residuals, measured minus projected; derivatives by lens and camera, and by the board."""
        parts = []
        for camera, seen in enumerate(self.problem.seen):
            T, boards = self.state.T_cam_world[camera], self.state.T_world_board[seen.instant]
            turned = np.einsum("nij,nj->ni", boards[:, :3, :3], self.problem.corners_m[seen.corner])
            in_world = turned + boards[:, :3, 3]
            in_camera = in_world @ T[:3, :3].T
            lens = int(self.problem.lens_of[camera])
            pixels, by_point, by_lens = self.problem.models[lens].project(
                self.state.lenses[lens], in_camera + T[:3, 3]
            )
            by_camera = np.concatenate([by_lens, by_point @ -cross_matrices(in_camera), by_point], axis=-1)
            by_world = by_point @ T[:3, :3]
            by_board = np.concatenate([by_world @ -cross_matrices(turned), by_world], axis=-1)
            parts.append((seen.points_px - pixels, by_camera, by_board))
        return parts

    @cached_property
    def distance_px(self) -> list[Float[np.ndarray, " seen"]]:
        """For each camera, (seen,), distances in the image between projections and measured pixels."""
        return [np.linalg.norm(off, axis=-1) for off, _, _ in self._projected]

    @property
    def own_distance_px(self) -> list[Float[np.ndarray, " seen"]]:
        """The same distances with each view's slip taken away."""
        distances = []
        for seen, view, (off, _, by_board) in zip(
            self.problem.seen, self.views, self._projected, strict=True
        ):
            slip = np.zeros((len(self.state.T_world_board), 6))
            slip[view.instant] = view.slip
            distances.append(np.linalg.norm(off - np.matvec(by_board, slip[seen.instant]), axis=-1))
        return distances

    @cached_property
    def views(self) -> list[ViewEquations]:
        """Parts of the normal equations of each camera's views."""
        return [self._views_of(camera) for camera in range(len(self.problem.seen))]

    def _views_of(self, camera: int) -> ViewEquations:
        problem, seen = self.problem, self.problem.seen[camera]
        off, by_camera, by_board = self._projected[camera]
        squares = np.where(self.used[camera], np.sum(off**2, axis=-1) / problem.noise_px[camera] ** 2, 0.0)
        weight = (
            self.used[camera]
            * (cauchy_weight(squares) if self.robust else 1.0)
            / problem.noise_px[camera] ** 2
        )
        columns = problem.columns(camera)
        by_camera = by_camera[..., columns >= 0]
        by_board = by_board * problem.free_board[seen.instant][:, None, None]
        there, size = seen.instants, by_camera.shape[-1]
        # One product of matrices for each view, of all derivatives and residuals: rows of unseen corners are 0.
        rows = np.zeros((len(there), int(seen.rank.max(initial=-1)) + 1, 2, size + 7))
        parts = np.concatenate([by_camera, by_board, off[..., None]], axis=-1)
        rows[seen.view, seen.rank] = np.sqrt(weight)[:, None, None] * parts
        rows = rows.reshape(len(there), -1, size + 7)
        products = rows.swapaxes(-1, -2) @ rows
        shared, coupling = products[:, :size, :size], products[:, size:-1, :size]
        board = products[:, size:-1, size:-1]
        shared_right, board_right = products[:, :size, -1], products[:, size:-1, -1]
        cost = np.bincount(seen.view, cauchy_loss(squares) if self.robust else squares, minlength=len(there))
        slip = np.zeros((len(there), 6))
        covariance: np.ndarray = np.zeros((len(there), 6, 6))
        if self.slip_std is not None:
            # A view's slip is an unknown of this view alone, with a normal distribution: it is eliminated here.
            precision = np.repeat(self.slip_std[camera][there] ** -2, 3, axis=-1)
            covariance = _inverses(board + precision[:, None, :] * np.eye(6))
            slip, gain = np.matvec(covariance, board_right), covariance @ coupling
            shared = shared - coupling.swapaxes(-1, -2) @ gain
            shared_right = shared_right - np.matvec(coupling.swapaxes(-1, -2), slip)
            # Below 0 only where a step that is tried puts a board into a camera: no such step is taken.
            rest = cost - np.vecdot(board_right, slip)
            cost = np.where(rest < -1e-6 * cost, np.inf, np.maximum(rest, 0.0))
            # I - board @ covariance is precision @ covariance, which loses no digits.
            board = precision[..., None] * (covariance @ board)
            coupling, board_right = precision[..., None] * gain, precision * slip
        return ViewEquations(
            there,
            columns[columns >= 0],
            shared,
            coupling,
            board,
            shared_right,
            board_right,
            cost,
            slip,
            covariance,
        )

    @cached_property
    def _from_prior(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each lens: how far it is below the value expected before any view, and the information about it."""
        parts = []
        for model, lens, size_wh in zip(
            self.problem.models, self.state.lenses, self.problem.image_size_wh, strict=True
        ):
            value, information = model.prior((int(size_wh[0]), int(size_wh[1])))
            parts.append((value - lens, information))
        return parts

    @cached_property
    def cost(self) -> float:
        """Sum of the losses, and what is known of the lenses before any view."""
        known = sum(float(below @ information @ below) for below, information in self._from_prior)
        return float(sum(view.cost.sum() for view in self.views)) + known

    def equations(self) -> NormalEquations:
        """Normal equations; the board's poses are the blocks."""
        size, instants = self.problem.size, len(self.state.T_world_board)
        information, right = np.zeros((size, size)), np.zeros(size)
        blocks, block_right = np.zeros((instants, 6, 6)), np.zeros((instants, 6))
        coupling = np.zeros((instants, 6, size))
        for view in self.views:
            information[np.ix_(view.unknowns, view.unknowns)] += view.shared.sum(axis=0)
            right[view.unknowns] += view.shared_right.sum(axis=0)
            blocks[view.instant] += view.board
            block_right[view.instant] += view.board_right
            coupling[np.ix_(view.instant, np.arange(6), view.unknowns)] += view.coupling
        for columns, (below, known) in zip(self.problem.lens_columns, self._from_prior, strict=True):
            free = columns >= 0
            information[np.ix_(columns[free], columns[free])] += known[np.ix_(free, free)]
            right[columns[free]] += (known @ below)[free]
        # What is not adjusted or not seen stays as it is: a board, or the turn of a board with a single corner.
        own = np.einsum("bii->bi", blocks)
        own[own == 0] = 1.0
        return NormalEquations(information, right, blocks, block_right, coupling)

    def moved(self, step: Step) -> BoardBundle:
        """Change the lenses, and turn and shift cameras and boards."""
        if step.blocks is None:
            raise TypeError("expected a step with blocks, found none")
        lenses = tuple(
            lens + np.where(columns >= 0, np.append(step.shared, 0.0)[columns], 0.0)
            for lens, columns in zip(self.state.lenses, self.problem.lens_columns, strict=True)
        )
        cameras = np.append(step.shared, 0.0)[self.problem.camera_columns] * self.problem.free_camera[:, None]
        state = BoardState(
            lenses,
            _moved(self.state.T_cam_world, cameras),
            _moved(self.state.T_world_board, step.blocks),
        )
        return replace(self, state=state)

    def solved(self) -> BoardBundle:
        """Lower the cost from this state."""
        least_gain = _LEAST_GAIN_ROBUST if self.robust else _LEAST_GAIN
        return levenberg_marquardt(self, max_steps=_MAX_STEPS, least_gain=least_gain)


def _moved(
    T: Float[np.ndarray, "poses 4 4"], change: Float[np.ndarray, "poses 6"]
) -> Float[np.ndarray, "poses 4 4"]:
    """Turn poses by small turns about the target's axes, rad, and shift them, metres: turns first."""
    moved = T.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(change[:, :3]).as_matrix() @ T[:, :3, :3]
    moved[:, :3, 3] += change[:, 3:]
    return moved


def _inverses(matrices: Float[np.ndarray, "views 6 6"]) -> Float[np.ndarray, "views 6 6"]:
    """Inverses of symmetric matrices; pseudo-inverses if one is singular to rounding, after a step that is far off."""
    try:
        inverses: np.ndarray = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        inverses = np.linalg.pinv(matrices, hermitian=True)
    return inverses


def solve_robustly(bundle: BoardBundle, rounds: int = 3) -> BoardBundle:
    """Lower a robust cost whose width is the residuals' own: wide at a poor start, narrow near the solution."""
    for _ in range(rounds):
        noise_px = np.array(
            [
                max(LEAST_NOISE_PX, float(np.median(distance))) if len(distance) else 1.0
                for distance in bundle.distance_px
            ]
        )
        problem = replace(bundle.problem, noise_px=noise_px)
        bundle = replace(bundle, problem=problem, robust=True).solved()
    return bundle
