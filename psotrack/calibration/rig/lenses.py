"""Poses of a board in single views, a first lens from the views of one camera, and which model of a lens.

The model is the simplest one whose lenses show views that were left out about as well as any model's. Each model is
fitted to two thirds of the views of a board and measured on the others, three times. A model with more coefficients is
taken only if it is certainly better, by two standard errors over the views (in the manner of the one-standard-error
rule of L. Breiman et al., Classification and Regression Trees, 1984), and visibly better, by 2 % of the error:
coefficients that nothing is gained by are free to do harm where the board was not seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.boards import Board
from psotrack.calibration.bundle import Bundle, BundleState, solve_robustly
from psotrack.calibration.extrinsics import ray_distances, solve_pnp
from psotrack.calibration.lens_models import PINHOLE, LensModel
from psotrack.support import Advance

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


def find_lens(
    board: Board,
    model: LensModel,
    views_px: Float[np.ndarray, "instants corners 2"],
    image_size_wh: tuple[int, int],
    focal_px: float | None = None,
) -> Float[np.ndarray, " unknowns"] | None:
    """Find a first lens of one camera from its views of a board: an adjustment from several focal lengths.

    Args:
        board: the board.
        model: model of the lens.
        views_px: pixels of the board's corners; NaN where a corner is not seen.
        image_size_wh: width and height of the images, pixels.
        focal_px: the only focal length from which the search starts, pixels, where it is known roughly.

    Returns:
        Vector of the lens, or None if no view fits.
    """
    usable = views_px[np.isfinite(views_px[..., 0]).sum(axis=1) >= board.least_corners]
    chosen = usable[np.linspace(0, len(usable) - 1, min(len(usable), _MOST_VIEWS)).round().astype(np.int64)]
    found: list[tuple[float, np.ndarray]] = []
    starts_px = [
        widths * image_size_wh[0] for widths in (_FOCAL_WIDTHS_FISHEYE if model.fisheye else _FOCAL_WIDTHS)
    ]
    for start_px in starts_px if focal_px is None else [focal_px]:
        bundle = _adjust_lens(board, model, chosen, model.start(start_px, image_size_wh), image_size_wh)
        if bundle is not None:
            cost = float(np.nansum(np.minimum(bundle.distance_px, 20.0)))
            found.append((cost, bundle.state.lenses[0]))
    return min(found, key=lambda one: one[0])[1] if found else None


def fit_boards(
    board: Board,
    model: LensModel,
    lens: Float[np.ndarray, " unknowns"],
    views_px: Float[np.ndarray, "views corners 2"],
    image_size_wh: tuple[int, int],
) -> Float[np.ndarray, "views corners"] | None:
    """Fit the board's pose to each view with a known lens.

    Returns:
        Distances of the corners, pixels; NaN in views that the lens cannot show. None if there is no other view.
    """
    prepared = _problem(board, model, lens, views_px, image_size_wh)
    if prepared is None:
        return None
    bundle, fits = prepared
    bundle = solve_robustly(bundle)
    distance_px = np.full(views_px.shape[:2], np.nan)
    distance_px[fits] = bundle.distance_px
    return distance_px


def _adjust_lens(
    board: Board,
    model: LensModel,
    views_px: Float[np.ndarray, "instants corners 2"],
    lens: Float[np.ndarray, " unknowns"],
    image_size_wh: tuple[int, int],
) -> Bundle | None:
    """Adjust a lens and the board's poses: first the focal lengths and the first coefficient, then all."""
    prepared = _problem(board, model, lens, views_px, image_size_wh)
    if prepared is None:
        return None
    bundle = prepared[0]
    first = np.zeros(model.size, bool)
    first[:2] = True
    first[PINHOLE : PINHOLE + 1] = True
    try:
        bundle = replace(bundle, problem=replace(bundle.problem, free_lens=(first,)))
        bundle = solve_robustly(bundle, rounds=2)
        return solve_robustly(
            replace(bundle, problem=replace(bundle.problem, free_lens=(np.ones(model.size, bool),)))
        )
    except np.linalg.LinAlgError:
        return None


def _problem(
    board: Board,
    model: LensModel,
    lens: Float[np.ndarray, " unknowns"],
    views_px: Float[np.ndarray, "instants corners 2"],
    image_size_wh: tuple[int, int],
) -> tuple[Bundle, Bool[np.ndarray, " instants"]] | None:
    """Adjustment of one lens, and the views that it can show; None if it can show none."""
    rays = model.normalise(lens, views_px.reshape(-1, 2)).reshape(views_px.shape)
    poses = [find_board_poses(board, of_view) for of_view in rays]
    fits = np.array([len(candidates) > 0 for candidates in poses])
    if not fits.any():
        return None
    boards = np.array([candidates[0] for candidates in poses if len(candidates)])
    state = BundleState((lens,), np.eye(4)[None], boards, np.ones(len(boards)))
    free = np.zeros(1, bool), np.ones(len(boards), bool)
    bundle = Bundle.of_views((model,), state, board.corners_m, views_px[None, fits], free=free)
    problem = replace(bundle.problem, priors=(model.prior(image_size_wh),))
    return replace(bundle, problem=problem), fits


def choose_lens_model(
    board: Board,
    views_px: Float[np.ndarray, "views corners 2"],
    image_size_wh: tuple[int, int],
    advance: Advance = lambda steps: None,
) -> LensModel:
    """Choose the model of a lens by views that were left out.

    Args:
        board: the board.
        views_px: pixels of its corners; NaN where a corner is not seen.
        image_size_wh: width and height of the images, pixels.
        advance: called with 1 after each of at most `MOST_FITS` fits.
    """
    views_px = views_px[:: -(-len(views_px) // _MOST_COMPARED)] if len(views_px) else views_px
    if len(views_px) < LEAST_VIEWS:
        return _MODELS[0]
    distances: dict[LensModel, np.ndarray | None] = {}
    focal_px: float | None = None
    for model in _MODELS:
        # OpenCV's pinhole models have nearly the same focal length; a fisheye's is another.
        start_px = None if model.fisheye else focal_px
        distances[model], found_px = _left_out(board, model, views_px, image_size_wh, start_px, advance)
        if not model.fisheye:
            focal_px = found_px
    known = {model: of_model for model, of_model in distances.items() if of_model is not None}
    if not known:
        return _MODELS[0]
    # The width of the loss is the same for all models.
    width = min(float(np.nanmedian(of_model)) for of_model in known.values())
    losses = {
        model: np.nanmean(np.log1p((of_model / max(width, 1e-6)) ** 2), axis=1)
        for model, of_model in known.items()
    }
    error_px = {model: float(np.nanmedian(of_model)) for model, of_model in known.items()}
    chosen = next(iter(known))
    for model in known:
        gain = losses[chosen] - losses[model]
        is_certain = gain.mean() > _CERTAIN * gain.std(ddof=1) / np.sqrt(len(gain))
        if is_certain and error_px[model] < (1 - _VISIBLE) * error_px[chosen]:
            chosen = model
    return chosen


def _left_out(
    board: Board,
    model: LensModel,
    views_px: Float[np.ndarray, "views corners 2"],
    image_size_wh: tuple[int, int],
    focal_px: float | None,
    advance: Advance,
) -> tuple[Float[np.ndarray, "views corners"] | None, float | None]:
    """Distances of the corners from the projections by lenses of other views, pixels; None if a fit fails.

    Also the focal length, pixels; `focal_px` is where the first search starts, None for several focal lengths.
    """
    distance_px = np.full(views_px.shape[:2], np.nan)
    part = np.arange(len(views_px)) % _FOLDS
    for fold in range(_FOLDS):
        lens = find_lens(board, model, views_px[part != fold], image_size_wh, focal_px)
        found = (
            None if lens is None else fit_boards(board, model, lens, views_px[part == fold], image_size_wh)
        )
        advance(1)
        if lens is None or found is None:
            return None, focal_px
        focal_px = float(lens[0])
        distance_px[part == fold] = found
    # A view that the lens cannot show at all is a bad view of this model, not a missing one.
    seen = np.isfinite(views_px[..., 0])
    return np.where(seen, np.nan_to_num(distance_px, nan=float(image_size_wh[0])), np.nan), focal_px
