"""First places of the cameras: pairs that see the board at the same instants, joined to a chain.

Each instant that two cameras share gives candidates of the transform from one camera to the other, because a plane's
pose has two solutions and a chessboard may be turned. The candidate that fits all shared instants best is kept. The
pairs with most instants that agree join the cameras (maximum spanning tree, J. B. Kruskal, 1956).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.lenses import find_board_poses
from psotrack.calibration.rig.views import BoardViews
from psotrack.errors import InputError

#: Largest number of shared instants that give candidates, and that the candidates are compared on.
_MOST_INSTANTS = 40
#: Distance in the image, as a fraction of its width, up to which a first transform fits an instant.
_FITS = 0.02


@dataclass(frozen=True)
class Chain:
    """First places of cameras and boards.

    Attributes:
        T_cam_world: (cameras, 4, 4), world to camera; the world is the first camera.
        T_world_board: (instants, 4, 4), board to world; the identity at an instant that no camera fits.
        labelling: (cameras, instants), index of the order of the corners that fits (see `Board.labellings`).
        shared: (cameras, cameras), number of instants that two cameras share.
    """

    T_cam_world: Float[np.ndarray, "cameras 4 4"]
    T_world_board: Float[np.ndarray, "instants 4 4"]
    labelling: Int[np.ndarray, "cameras instants"]
    shared: Int[np.ndarray, "cameras cameras"]


@dataclass(frozen=True)
class _Seen:
    """Views of all cameras without distortion, and candidates of the board's pose in each.

    Attributes:
        board: the board.
        rays: (cameras, instants, corners, 2), directions x / z, y / z; NaN where a corner is not seen.
        focal_widths: (cameras,), focal lengths in image widths.
        count: (cameras, instants), number of candidates.
        poses: (cameras, instants, candidates, 4, 4), board to camera; the last one is repeated.
    """

    board: Board
    rays: Float[np.ndarray, "cameras instants corners 2"]
    focal_widths: Float[np.ndarray, " cameras"]
    count: Int[np.ndarray, "cameras instants"]
    poses: Float[np.ndarray, "cameras instants candidates 4 4"]

    def errors(
        self, camera: int, instants: np.ndarray, T: Float[np.ndarray, "*batch 4 4"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Median distance, in image widths, of a view from a board at T, (..., 4, 4), board to camera.

        The last axis of the batch is that of `instants`, or has length 1.

        Returns:
            the distance for the labelling that fits best, at most 1, and the index of this labelling.
        """
        points = np.einsum("...ij,nj->...ni", T[..., :3, :3], self.board.corners_m) + T[..., None, :3, 3]
        ends = points[..., :2] / np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        rays = self.rays[camera, instants]
        each = []
        for order in self.board.labellings:
            # Corner n of a view may be corner order[n] of the board.
            distance = np.linalg.norm(ends[..., order, :] - rays, axis=-1)
            seen = np.broadcast_to(np.isfinite(rays[..., 0]), distance.shape)
            # Only seen corners have to be in front: before a wide lens the rest of the board may be beside it.
            behind = (seen & np.isnan(distance)).any(axis=-1)
            # A view with all corners behind has no median.
            distance[behind] = np.inf
            each.append(np.nanmedian(distance, axis=-1) * self.focal_widths[camera])
        stacked = np.minimum(np.stack(each), 1.0)
        return stacked.min(axis=0), stacked.argmin(axis=0)


def join_cameras(
    board: Board, views: BoardViews, models: tuple[LensModel, ...], lenses: tuple[np.ndarray, ...]
) -> Chain:
    """Find first places of all cameras.

    Args:
        board: the board.
        views: pixels of its corners.
        models: model of each camera's lens.
        lenses: vector of each camera's lens.

    Raises:
        InputError: the cameras are not all joined by shared views.
    """
    seen = _find_poses(board, views, models, lenses)
    count = len(views.names)
    there = seen.count > 0
    shared = there.astype(np.int64) @ there.T.astype(np.int64)
    cost, steps = np.zeros((count, count)), {}
    for first, second in combinations(range(count), 2):
        if shared[first, second]:
            both = np.flatnonzero(there[first] & there[second])
            T, agreeing, error = _transform(seen, first, second, both)
            steps[first, second], steps[second, first] = T, np.linalg.inv(T)
            # The error, which is below 1, decides between pairs of which equally many instants agree.
            cost[first, second] = 1 + shared.max() - agreeing + error
    order, before = breadth_first_order(minimum_spanning_tree(cost), 0, directed=False)
    check_joined(views, shared)
    T_cam_world = np.tile(np.eye(4), (count, 1, 1))
    for camera in order[1:]:
        T_cam_world[camera] = steps[before[camera], camera] @ T_cam_world[before[camera]]
    return Chain(T_cam_world, *_place_boards(seen, T_cam_world), shared)


def _find_poses(
    board: Board, views: BoardViews, models: tuple[LensModel, ...], lenses: tuple[np.ndarray, ...]
) -> _Seen:
    rays = np.full(views.corners_px.shape, np.nan)
    for camera, (model, lens) in enumerate(zip(models, lenses, strict=True)):
        there = views.seen[camera]
        pixels = views.corners_px[camera, there]
        rays[camera, there] = model.normalise(lens, pixels.reshape(-1, 2)).reshape(pixels.shape)
    found = [[find_board_poses(board, of_view) for of_view in of_camera] for of_camera in rays]
    count = np.array([list(map(len, of_camera)) for of_camera in found])
    poses = np.tile(np.eye(4), (*count.shape, max(int(count.max()), 1), 1, 1))
    for camera, instant in np.argwhere(count > 0).tolist():
        number = np.minimum(np.arange(poses.shape[2]), count[camera, instant] - 1)
        poses[camera, instant] = found[camera][instant][number]
    focal_widths = np.array([lens[0] for lens in lenses]) / views.image_size_wh.max(axis=1)
    return _Seen(board, rays, focal_widths, count, poses)


def _transform(
    seen: _Seen, first: int, second: int, shared: Int[np.ndarray, " instants"]
) -> tuple[Float[np.ndarray, "4 4"], int, float]:
    """Transform from a camera to another, the number of instants that it fits, and its mean error in image widths."""
    some = shared[np.linspace(0, len(shared) - 1, min(len(shared), _MOST_INSTANTS)).round().astype(np.int64)]
    here, there = seen.poses[first, some], seen.poses[second, some]
    candidates = (there[:, :, None] @ np.linalg.inv(here)[:, None]).reshape(-1, 4, 4)
    errors = seen.errors(second, some, candidates[:, None, None] @ here.swapaxes(0, 1))[0].min(axis=1)
    total = np.minimum(errors, 5 * _FITS).mean(axis=1)
    best = int(total.argmin())
    # All shared instants count, not only those that gave candidates.
    agreeing = round(float((errors[best] < _FITS).mean()) * len(shared))
    return candidates[best], agreeing, float(total[best])


def _place_boards(
    seen: _Seen, T_cam_world: Float[np.ndarray, "cameras 4 4"]
) -> tuple[Float[np.ndarray, "instants 4 4"], Int[np.ndarray, "cameras instants"]]:
    """Place the board at each instant where it fits all cameras that see it best, and order the corners."""
    cameras, instants = seen.rays.shape[:2]
    boards = np.tile(np.eye(4), (instants, 1, 1))
    labelling = np.zeros((cameras, instants), np.int64)
    for instant in range(instants):
        there = np.flatnonzero(seen.count[:, instant]).tolist()
        if not there:
            continue
        candidates = np.linalg.inv(T_cam_world[there])[:, None] @ seen.poses[there, instant]
        candidates = candidates.reshape(-1, 4, 4)
        found = [
            seen.errors(camera, np.array([instant]), (T_cam_world[camera] @ candidates)[:, None])
            for camera in there
        ]
        best = int(np.sum([np.minimum(error[:, 0], 5 * _FITS) for error, _ in found], axis=0).argmin())
        boards[instant] = candidates[best]
        for camera, (_, order) in zip(there, found, strict=True):
            labelling[camera, instant] = order[best, 0]
    return boards, labelling


def check_joined(views: BoardViews, shared: Int[np.ndarray, "cameras cameras"] | None = None) -> None:
    """Check that instants at which two cameras see the board join all cameras.

    Args:
        views: the views.
        shared: number of instants that two cameras share; None: those at which both see enough corners.

    Raises:
        InputError: the cameras are not all joined.
    """
    seen = views.seen.astype(np.int64)
    count, group = connected_components(seen @ seen.T if shared is None else shared, directed=False)
    if count > 1:
        first, second = ([views.names[index] for index in np.flatnonzero(group == one)] for one in (0, 1))
        parts = f"one of {', '.join(first)} and one of {', '.join(second)}"
        raise InputError(
            "board",
            expected="instants that join all cameras, pair by pair",
            found=f"no instant at which {parts} see the board together",
            remedy=f"film the board where {first[0]} and {second[0]} both see it",
        )
