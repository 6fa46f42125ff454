"""Poses of a board in single views, and a first lens from the views of one camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.boards import Board
from psotrack.calibration.bundle import Bundle, BundleState, solve_robustly
from psotrack.calibration.lens_models import PINHOLE, LensModel
from psotrack.calibration.pnp import ray_distances, solve_pnp

#: Focal lengths from which the search for a lens starts, in image widths: 90 to 14 degrees; a fisheye's, to 200.
_FOCAL_WIDTHS, _FOCAL_WIDTHS_FISHEYE = (0.5, 0.8, 1.2, 2.0, 4.0), (0.25, 0.35, 0.5, 0.8)
#: Largest number of views for a first lens, evenly spread.
_MOST_VIEWS = 30


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
