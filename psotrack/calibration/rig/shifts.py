"""Cameras whose frames of a board are counted wrongly: they see its motion at other instants than the others.

What moves is elsewhere at another instant, so a camera whose frames are counted wrongly has no pose that fits. The
board's motion is known to each camera alone, and tells the shift before any camera is placed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.start import find_board_poses
from psotrack.calibration.rig.views import BoardViews
from psotrack.support import similarity
from psotrack.trajectories.resampling import interpolated

#: Smallest number of instants that two cameras share at a shift of a board, and largest number of frames between two
#: instants, half a second of 30 per second: a hand turns round within less.
_LEAST_SHARED, _MOST_STEP = 12, 15
#: Largest fraction of a board's motion that a shift leaves, and largest part of what no shift leaves. Errors
#: of poses leave some hundredths, of a poor lens a tenth; a wrong shift leaves most.
_EXPLAINED, _BETTER = 0.3, 0.5
#: Rounds of a fit of two motions without outliers.
_ROUNDS = 4


def find_board_shifts(
    board: Board, views: BoardViews, lenses: Mapping[str, tuple[LensModel, np.ndarray]]
) -> Int[np.ndarray, " cameras"]:
    """At how many frames later each camera shows what the first one shows, by the way the board moves.

    A camera alone knows how the board moves before it. Two cameras that look at one board see the same motion, turned
    and shifted, if their frames are counted rightly. All shifts are compared at which the cameras share a third of the
    most instants that they can share; between searched frames, the board is interpolated.

    Args:
        board: the board.
        views: pixels of its corners, at instants whose numbers count frames.
        lenses: model and vector of each camera's lens, as its own views have it.

    Returns:
        (cameras,), 0 also where the motion does not tell a shift.
    """
    count = len(views.names)
    # Pictures that were taken now and then show no motion.
    if count < 2 or len(views.number) < _LEAST_SHARED or np.median(np.diff(views.number)) > _MOST_STEP:
        return np.zeros(count, np.int64)
    seen = np.stack(
        [_points_of_board(board, views, index, *lenses[name]) for index, name in enumerate(views.names)]
    )
    cost, shifts = np.zeros((count, count)), np.zeros((count, count), np.int64)
    for first, second in combinations(range(count), 2):
        left, shift = _motion_shift(views.number, seen[first], seen[second])
        shifts[first, second], shifts[second, first] = shift, -shift
        # A pair whose motion tells nothing is counted as it is, and joins only what nothing else joins.
        cost[first, second] = 1 + left
    order, before = breadth_first_order(minimum_spanning_tree(cost), 0, directed=False)
    found = np.zeros(count, np.int64)
    for camera in order[1:]:
        found[camera] = found[before[camera]] + shifts[before[camera], camera]
    return found


def _points_of_board(
    board: Board, views: BoardViews, camera: int, model: LensModel, lens: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, "instants 2 3"]:
    """The board's middle and a point in front of it at each instant, camera, metres; NaN where it is not seen.

    They are the same if the corners of a board that looks alike after a turn are in another order.
    """
    half_m = float(np.linalg.norm(np.ptp(board.corners_m, axis=0))) / 2
    points_m = board.corners_m.mean(axis=0) - [[0.0, 0.0, 0.0], [0.0, 0.0, half_m]]
    found = np.full((len(views.number), 2, 3), np.nan)
    for instant in np.flatnonzero(views.seen[camera]):
        for T in find_board_poses(board, model.normalise(lens, views.corners_px[camera, instant]))[:1]:
            found[instant] = points_m @ T[:3, :3].T + T[:3, 3]
    return found


def _motion_shift(
    number: Int[np.ndarray, " instants"],
    first_m: Float[np.ndarray, "instants 2 3"],
    second_m: Float[np.ndarray, "instants 2 3"],
) -> tuple[float, int]:
    """What one motion leaves of another at the shift that explains it best, as a fraction of the motion; the shift."""
    step = int(np.median(np.diff(number)))
    # Between searched frames the motion is interpolated, also over one at which the board is not seen.
    second_at = interpolated(number.astype(np.float64), second_m, 2.0 * step)
    last = int(number[-1] - number[0])
    tried: dict[int, tuple[float, int]] = {}

    def best(shifts: Iterable[int]) -> int:
        tried.update((shift, _left(first_m, second_at(number + float(shift)))) for shift in shifts)
        least = max(_LEAST_SHARED, max(shared for _, shared in tried.values()) / 3)
        return min(tried, key=lambda shift: (tried[shift][1] < least, tried[shift][0]))

    # First where no frame is interpolated, then at single frames.
    coarse = best(range(-(last // step) * step, last + 1, step))
    shift = best(range(coarse - step, coarse + step + 1))
    (left, shared), still = tried[shift], tried[0][0]
    is_certain = shared >= _LEAST_SHARED and left < min(_EXPLAINED, _BETTER * still)
    return (left, shift) if is_certain else (min(still, 1.0), 0)


def _left(
    a_m: Float[np.ndarray, "instants 2 3"], b_m: Float[np.ndarray, "instants 2 3"]
) -> tuple[float, int]:
    """Median distance between two motions, one of them turned and shifted, as a fraction of the motion's extent.

    Also the number of instants at which both are known.
    """
    both = np.isfinite(a_m).all(axis=(1, 2)) & np.isfinite(b_m).all(axis=(1, 2))
    shared = int(both.sum())
    if shared < _LEAST_SHARED:
        return np.inf, shared
    a, b = a_m[both].reshape(-1, 3), b_m[both].reshape(-1, 3)
    near = np.ones(len(a), bool)
    for _ in range(_ROUNDS):
        _, R, t_m = similarity(b[near], a[near], with_scale=False)
        distance_m = np.linalg.norm(b @ R.T + t_m - a, axis=-1)
        # The half that fits best, and what fits about as well, says where the next round looks.
        near = distance_m <= 2 * np.median(distance_m)
    extent_m = np.median(np.linalg.norm(a - np.median(a, axis=0), axis=-1))
    return float(np.median(distance_m) / max(extent_m, 1e-300)), shared
