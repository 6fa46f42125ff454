"""Where an adjustment starts: poses of a board in single views, lenses by one camera's views, the cameras' places.

**Lenses.** The model is the simplest one whose lenses show views that were left out about as well as any model's. Each
model is fitted to two thirds of the views of a board and measured on the others, three times. A model with more
coefficients is taken only if it is certainly better, by two standard errors over the views (in the manner of the
one-standard-error rule of L. Breiman et al., Classification and Regression Trees, 1984), and visibly better, by 2 % of
the error: coefficients that nothing is gained by are free to do harm where the board was not seen.

**Places.** Pairs of cameras that see the board at the same instants are joined to a chain. Each instant that two
cameras share gives candidates of the transform from one camera to the other, because a plane's pose has two solutions
and a chessboard may be turned. The candidate that fits all shared instants best is kept. The pairs with most instants
that agree join the cameras (maximum spanning tree, J. B. Kruskal, 1956).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from psotrack.calibration.boards import Board
from psotrack.calibration.bundle import Bundle, BundleState, solve_robustly
from psotrack.calibration.extrinsics import ray_distances, solve_pnp
from psotrack.calibration.lens_models import PINHOLE, LensModel
from psotrack.calibration.rig.views import BoardViews
from psotrack.errors import InputError
from psotrack.support import Advance, evenly_spread

#: Focal lengths from which the search for a lens starts, in image widths: 90 to 14 degrees; a fisheye's, to 200.
_FOCAL_WIDTHS, _FOCAL_WIDTHS_FISHEYE = (0.5, 0.8, 1.2, 2.0, 4.0), (0.25, 0.35, 0.5, 0.8)
#: Largest number of views for a first lens, evenly spread.
_MOST_VIEWS = 30
#: Models that are compared, the simplest first.
_MODELS = (LensModel(5), LensModel(4, fisheye=True), LensModel(8), LensModel(12), LensModel(14))
#: Number of parts of the views, and smallest number of views for a comparison.
_FOLDS, LEAST_VIEWS = 3, 9
#: Largest number of fits of a comparison, for a display of the progress.
MOST_FITS = len(_MODELS) * _FOLDS
#: Standard errors, and fraction of the median error, by which a model must be better than a simpler one.
_CERTAIN, _VISIBLE = 2.0, 0.02
#: Largest number of views that are used: a comparison of five models takes 15 fits.
_MOST_COMPARED = 45
#: Largest number of shared instants that give candidates, and that the candidates are compared on.
_MOST_INSTANTS = 40
#: Distance in the image, as a fraction of its width, up to which a first transform fits an instant.
_FITS = 0.02


def find_board_poses(board: Board, rays: Float[np.ndarray, "corners 2"]) -> Float[np.ndarray, "poses 4 4"]:
    """Poses, board to camera, that fit a view: up to two of a plane, for each labelling of the corners.

    Args:
        board: the board.
        rays: (corners, 2), directions x / z, y / z in which the corners are seen; NaN where one is not seen, or where
            the lens cannot be inverted.

    Returns:
        The poses, that of smallest error first; none if the rays of most corners are not known.
    """
    found: list[tuple[float, np.ndarray]] = []
    for order in board.labellings:
        if np.isfinite(rays[:, 0]).sum() < board.least_corners:
            break
        points_m = board.corners_m[order]
        for T in solve_pnp(points_m, rays, "ippe"):
            found.append((float(np.nanmean(ray_distances(points_m, rays, T) ** 2)), T))
    found.sort(key=lambda one: one[0])
    return np.array([T for _, T in found]).reshape(-1, 4, 4)


@dataclass(frozen=True)
class LensViews:
    """Views of a board by one camera.

    Attributes:
        board: the board.
        corners_px: (views, corners, 2), pixels; NaN where a corner is not seen.
        image_size_wh: width and height of the images, pixels.
    """

    board: Board
    corners_px: Float[np.ndarray, "views corners 2"]
    image_size_wh: tuple[int, int]

    def __len__(self) -> int:
        return len(self.corners_px)

    def select(self, chosen: np.ndarray | slice) -> LensViews:
        """Chosen views."""
        return replace(self, corners_px=self.corners_px[chosen])


def find_lens(
    views: LensViews, model: LensModel, focal_px: float | None = None
) -> Float[np.ndarray, " unknowns"] | None:
    """Find a first lens of one camera from its views of a board: an adjustment from several focal lengths.

    Args:
        views: the views.
        model: model of the lens.
        focal_px: the only focal length from which the search starts, pixels, where it is known roughly.

    Returns:
        Vector of the lens, or None if no view fits.
    """
    usable = np.flatnonzero(np.isfinite(views.corners_px[..., 0]).sum(axis=1) >= views.board.least_corners)
    chosen = views.select(usable[evenly_spread(len(usable), _MOST_VIEWS)])
    found: list[tuple[float, np.ndarray]] = []
    widths = _FOCAL_WIDTHS_FISHEYE if model.fisheye else _FOCAL_WIDTHS
    starts_px = [width * views.image_size_wh[0] for width in widths] if focal_px is None else [focal_px]
    for start_px in starts_px:
        bundle = _adjust_lens(chosen, model, model.start(start_px, views.image_size_wh))
        if bundle is not None:
            cost = float(np.nansum(np.minimum(bundle.distance_px, 20.0)))
            found.append((cost, bundle.state.lenses[0]))
    return min(found, key=lambda one: one[0])[1] if found else None


def fit_boards(
    views: LensViews, model: LensModel, lens: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, "views corners"] | None:
    """Fit the board's pose to each view with a known lens.

    Returns:
        Distances of the corners, pixels; NaN in views that the lens cannot show. None if there is no other view.
    """
    prepared = _problem(views, model, lens)
    if prepared is None:
        return None
    bundle, fits = prepared
    distance_px = np.full(views.corners_px.shape[:2], np.nan)
    distance_px[fits] = solve_robustly(bundle).distance_px
    return distance_px


def _adjust_lens(views: LensViews, model: LensModel, lens: Float[np.ndarray, " unknowns"]) -> Bundle | None:
    """Adjust a lens and the board's poses: first the focal lengths and the first coefficient, then all."""
    prepared = _problem(views, model, lens)
    if prepared is None:
        return None
    bundle, number = prepared[0], np.arange(model.size)
    try:
        for free, rounds in ((np.isin(number, (0, 1, PINHOLE)), 2), (number >= 0, 3)):
            problem = replace(bundle.problem, free_lens=(free,))
            bundle = solve_robustly(replace(bundle, problem=problem), rounds)
    except np.linalg.LinAlgError:
        return None
    return bundle


def _problem(
    views: LensViews, model: LensModel, lens: Float[np.ndarray, " unknowns"]
) -> tuple[Bundle, Bool[np.ndarray, " views"]] | None:
    """Adjustment of one lens, and the views that it can show; None if it can show none."""
    views_px = views.corners_px
    rays = model.normalise(lens, views_px.reshape(-1, 2)).reshape(views_px.shape)
    poses = [find_board_poses(views.board, of_view) for of_view in rays]
    fits = np.array([len(candidates) > 0 for candidates in poses])
    if not fits.any():
        return None
    boards = np.array([candidates[0] for candidates in poses if len(candidates)])
    state = BundleState((lens,), np.eye(4)[None], boards, np.ones(len(boards)))
    free = np.zeros(1, bool), np.ones(len(boards), bool)
    bundle = Bundle.of_views((model,), state, views.board.corners_m, views_px[None, fits], free=free)
    problem = replace(bundle.problem, priors=(model.prior(views.image_size_wh),))
    return replace(bundle, problem=problem), fits


def choose_lens_model(views: LensViews, advance: Advance = lambda steps: None) -> LensModel:
    """Choose the model of a lens by views that were left out.

    Args:
        views: the views.
        advance: called with 1 after each of at most `MOST_FITS` fits.
    """
    views = views.select(slice(None, None, max(1, -(-len(views) // _MOST_COMPARED))))
    if len(views) < LEAST_VIEWS:
        return _MODELS[0]
    known: dict[LensModel, np.ndarray] = {}
    focal_px: float | None = None
    for model in _MODELS:
        # OpenCV's pinhole models have nearly the same focal length; a fisheye's is another.
        left_px, found_px = _left_out(views, model, None if model.fisheye else focal_px, advance)
        if left_px is not None:
            known[model] = left_px
        if not model.fisheye:
            focal_px = found_px
    if not known:
        return _MODELS[0]
    # The width of the loss is the same for all models.
    error_px = {model: float(np.nanmedian(left_px)) for model, left_px in known.items()}
    width = max(min(error_px.values()), 1e-6)
    losses = {model: np.nanmean(np.log1p((left_px / width) ** 2), axis=1) for model, left_px in known.items()}
    chosen = next(iter(known))
    for model in known:
        gain = losses[chosen] - losses[model]
        is_certain = gain.mean() > _CERTAIN * gain.std(ddof=1) / np.sqrt(len(gain))
        if is_certain and error_px[model] < (1 - _VISIBLE) * error_px[chosen]:
            chosen = model
    return chosen


def _left_out(
    views: LensViews, model: LensModel, focal_px: float | None, advance: Advance
) -> tuple[Float[np.ndarray, "views corners"] | None, float | None]:
    """Distances of the corners from the projections by lenses of other views, pixels; None if a fit fails.

    Also the focal length, pixels; `focal_px` is where the first search starts, None for several focal lengths.
    """
    distance_px = np.full(views.corners_px.shape[:2], np.nan)
    part = np.arange(len(views)) % _FOLDS
    for fold in range(_FOLDS):
        lens = find_lens(views.select(part != fold), model, focal_px)
        found = None if lens is None else fit_boards(views.select(part == fold), model, lens)
        advance(1)
        if lens is None or found is None:
            return None, focal_px
        focal_px = float(lens[0])
        distance_px[part == fold] = found
    # A view that the lens cannot show at all is a bad view of this model, not a missing one.
    seen = np.isfinite(views.corners_px[..., 0])
    return np.where(seen, np.nan_to_num(distance_px, nan=float(views.image_size_wh[0])), np.nan), focal_px


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
    _check_joined(views, shared)
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
    some = shared[evenly_spread(len(shared), _MOST_INSTANTS)]
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


def _check_joined(views: BoardViews, shared: Int[np.ndarray, "cameras cameras"]) -> None:
    """Check that instants at which two cameras see the board, whose numbers are given, join all cameras."""
    count, group = connected_components(shared, directed=False)
    if count > 1:
        first, second = ([views.names[index] for index in np.flatnonzero(group == one)] for one in (0, 1))
        parts = f"one of {', '.join(first)} and one of {', '.join(second)}"
        raise InputError(
            "board",
            expected="instants that join all cameras, pair by pair",
            found=f"no instant at which {parts} see the board together",
            remedy=f"film the board where {first[0]} and {second[0]} both see it",
        )
