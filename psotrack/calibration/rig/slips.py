"""Slips: how far a view shows the board from its pose at the instant, because clocks differ or shutters are slow.

The corners of a view agree with each other far better than with the corners of other cameras, if the board moves and
the cameras are not exactly synchronous. So each view has its own slip, a turn and a shift of the board, from a normal
distribution whose width is estimated from the views (D. J. C. MacKay, Bayesian interpolation, 1992, equation 4.6); a
view that slips more than others has a wider one, so that slips follow Student's distribution. Where cameras are
synchronous the width shrinks to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.rig.bundle import BoardBundle

#: Degrees of freedom of Student's distribution: small, because a board moves now fast and now hardly.
_FREEDOM = 3.0
#: Unknowns of a slip: three of the turn, three of the shift.
_UNKNOWNS = 6
#: Widths at the start and smallest widths: a turn, and a shift as a fraction of the board's size.
_START, _LEAST = 0.01, 1e-5
#: Largest factor of a width in one step.
_LARGEST_STEP = 4.0


@dataclass(frozen=True)
class Slips:
    """Widths of the slips' distribution.

    Attributes:
        std: (2,), standard deviation of the turn, rad, and of the shift, m.
        scale: for each camera, (instants,), variance of a view's slip against that of others.
        board_m: size of the board.
    """

    std: Float[np.ndarray, "2"]
    scale: tuple[np.ndarray, ...]
    board_m: float

    @staticmethod
    def start(board_m: float, cameras: int, instants: int) -> Slips:
        """Wide slips of all views."""
        scale = tuple(np.ones(instants) for _ in range(cameras))
        return Slips(_START * np.array([1.0, board_m]), scale, board_m)

    def each(self) -> tuple[np.ndarray, ...]:
        """For each camera, (instants, 2), standard deviations of a view's slip, for `BoardBundle`."""
        return tuple(np.sqrt(of_camera)[:, None] * self.std for of_camera in self.scale)

    def estimated(self, bundle: BoardBundle) -> Slips:
        """The widths again, from the slips of an adjustment with these widths."""
        views = count_views(bundle)
        shown, expected = np.zeros(2), np.zeros(2)
        scales = []
        for camera, view in enumerate(bundle.views):
            scale, shared = self.scale[camera][view.instant], views[view.instant]
            squares = view.slip**2
            variance = np.diagonal(view.slip_covariance, axis1=1, axis2=2)
            widths = np.repeat(self.std**2, 3)
            # The board's pose follows the slips of its views: of two views, each shows half of their difference.
            kept = np.where(shared > 1, 1 - 1 / np.maximum(shared, 1), 0.0) / scale
            shown += (kept > 0) @ (squares / scale[:, None]).reshape(-1, 2, 3).sum(axis=-1)
            expected += kept @ (widths * scale[:, None] - variance).clip(0).reshape(-1, 2, 3).sum(axis=-1)
            surprise = ((squares + variance) / widths).sum(axis=-1)
            scales.append(self.scale[camera].copy())
            scales[-1][view.instant] = (_FREEDOM + surprise) / (_FREEDOM + _UNKNOWNS)
        factor = np.clip(shown / np.maximum(expected, 1e-300), _LARGEST_STEP**-2, _LARGEST_STEP**2)
        least = _LEAST * np.array([1.0, self.board_m])
        return replace(self, std=np.maximum(self.std * np.sqrt(factor), least), scale=tuple(scales))


def count_views(bundle: BoardBundle) -> Int[np.ndarray, " instants"]:
    """(instants,), number of cameras whose corners count at each instant."""
    counts = np.zeros(len(bundle.state.T_world_board), np.int64)
    for seen, used in zip(bundle.problem.seen, bundle.used, strict=True):
        counts[np.unique(seen.instant[used])] += 1
    return counts
