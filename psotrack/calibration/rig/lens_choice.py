"""Which lens model: the simplest one whose lenses show views that were left out about as well as any model's.

Each model is fitted to two thirds of the views of a board and measured on the others, three times. A model with more
coefficients is taken only if it is certainly better, by two standard errors over the views (in the manner of the
one-standard-error rule of L. Breiman et al., Classification and Regression Trees, 1984), and visibly better, by 2 % of
the error: coefficients that nothing is gained by are free to do harm where the board was not seen.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.board_poses import find_lens, fit_boards
from psotrack.support import Advance

#: Models that are compared, the simplest first.
_MODELS = (LensModel(5), LensModel(4, fisheye=True), LensModel(8), LensModel(12), LensModel(14))
#: Number of parts of the views, and smallest number of views for a comparison.
_FOLDS, LEAST_VIEWS = 3, 9
#: Largest number of fits of a comparison, for a display of the progress.
MOST_FITS = len(_MODELS) * _FOLDS
#: Standard errors, and fraction of the median error, by which a model must be better than a simpler one.
_CERTAIN, _VISIBLE = 2.0, 0.02
#: Largest number of views that are used: a comparison of five models takes 15 fits.
_MOST_VIEWS = 45


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
    views_px = views_px[:: -(-len(views_px) // _MOST_VIEWS)] if len(views_px) else views_px
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
