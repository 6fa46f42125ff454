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

from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.board_poses import find_board_poses
from psotrack.calibration.rig.views import BoardViews
from psotrack.errors import InputError

#: Largest number of shared instants that give candidates, and that the candidates are compared on.
_MOST_INSTANTS = 40
#: Distance in the image, as a share of its width, up to which a first transform fits an instant.
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
        poses: by camera and instant, (candidates, 4, 4), board to camera.
    """

    board: Board
    rays: Float[np.ndarray, "cameras instants corners 2"]
    focal_widths: Float[np.ndarray, " cameras"]
    poses: list[list[np.ndarray]]

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
    there = np.array([[len(candidates) > 0 for candidates in of_camera] for of_camera in seen.poses])
    shared = there.astype(np.int64) @ there.T.astype(np.int64)
    pairs = []
    for first, second in combinations(range(count), 2):
        if shared[first, second]:
            T, agreeing, error = _transform(seen, first, second, np.flatnonzero(there[first] & there[second]))
            pairs.append((-agreeing, error, first, second, T))
    group = list(range(count))
    tree: dict[int, list[tuple[int, np.ndarray]]] = {camera: [] for camera in range(count)}
    for _, _, first, second, T in sorted(pairs, key=lambda pair: pair[:4]):
        if group[first] != group[second]:
            tree[first].append((second, T))
            tree[second].append((first, np.linalg.inv(T)))
            group = [group[first] if one == group[second] else one for one in group]
    if len(set(group)) > 1:
        raise _not_joined(views, group)
    placed = {0: np.eye(4)}
    waiting = [0]
    while waiting:
        camera = waiting.pop()
        for other, T in tree[camera]:
            if other not in placed:
                placed[other] = T @ placed[camera]
                waiting.append(other)
    T_cam_world = np.array([placed[camera] for camera in range(count)])
    return Chain(T_cam_world, *_place_boards(seen, T_cam_world), shared)


def _find_poses(
    board: Board, views: BoardViews, models: tuple[LensModel, ...], lenses: tuple[np.ndarray, ...]
) -> _Seen:
    rays = np.stack(
        [
            model.normalise(lens, corners_px.reshape(-1, 2)).reshape(corners_px.shape)
            for model, lens, corners_px in zip(models, lenses, views.corners_px, strict=True)
        ]
    )
    poses = [
        [
            find_board_poses(board, of_view) if is_seen else np.zeros((0, 4, 4))
            for of_view, is_seen in zip(of_camera, seen, strict=True)
        ]
        for of_camera, seen in zip(rays, views.seen, strict=True)
    ]
    widths = views.image_size_wh.max(axis=1)
    return _Seen(board, rays, np.array([lens[0] for lens in lenses]) / widths, poses)


def _transform(
    seen: _Seen, first: int, second: int, shared: Int[np.ndarray, " instants"]
) -> tuple[Float[np.ndarray, "4 4"], int, float]:
    """Transform from a camera to another, the number of instants that it fits, and its mean error in image widths."""
    some = shared[np.linspace(0, len(shared) - 1, min(len(shared), _MOST_INSTANTS)).round().astype(np.int64)]
    candidates = np.array(
        [
            there @ np.linalg.inv(here)
            for instant in some
            for here in seen.poses[first][instant]
            for there in seen.poses[second][instant]
        ]
    )
    errors = np.full((len(candidates), len(some)), 1.0)
    most = max(len(seen.poses[first][instant]) for instant in some)
    for rank in range(most):
        # The rank-th pose of each instant; instants with fewer poses repeat their last one.
        here = np.array(
            [seen.poses[first][instant][min(rank, len(seen.poses[first][instant]) - 1)] for instant in some]
        )
        found, _ = seen.errors(second, some, candidates[:, None] @ here)
        errors = np.minimum(errors, found)
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
        there = [camera for camera in range(cameras) if len(seen.poses[camera][instant])]
        if not there:
            continue
        candidates = np.concatenate(
            [np.linalg.inv(T_cam_world[camera]) @ seen.poses[camera][instant] for camera in there]
        )
        found = [
            seen.errors(camera, np.array([instant]), (T_cam_world[camera] @ candidates)[:, None])
            for camera in there
        ]
        best = int(np.sum([np.minimum(error[:, 0], 5 * _FITS) for error, _ in found], axis=0).argmin())
        boards[instant] = candidates[best]
        for camera, (_, order) in zip(there, found, strict=True):
            labelling[camera, instant] = order[best, 0]
    return boards, labelling


def check_joined(views: BoardViews) -> None:
    """Check that instants at which two cameras see the board join all cameras: before lenses are looked for.

    Raises:
        InputError: the cameras are not all joined.
    """
    seen = views.seen.astype(np.int64)
    group = list(range(len(views.names)))
    for first, second in zip(*np.nonzero(seen @ seen.T), strict=True):
        group = [group[first] if one == group[second] else one for one in group]
    if len(set(group)) > 1:
        raise _not_joined(views, group)


def _not_joined(views: BoardViews, group: list[int]) -> InputError:
    """Error of cameras that no shared view joins to the others."""
    parts = [
        ", ".join(name for name, of in zip(views.names, group, strict=True) if of == one)
        for one in sorted(set(group))
    ]
    return InputError(
        "board",
        expected="instants that join all cameras, pair by pair",
        found=f"no instant at which one of {parts[0]} and one of {parts[1]} see the board together",
        remedy=f"film the board where {parts[0].split(', ')[0]} and {parts[1].split(', ')[0]} both see it",
    )
