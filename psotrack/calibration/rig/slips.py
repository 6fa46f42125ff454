"""Slips: how far a view shows the board from its pose at the instant, because clocks differ or shutters are slow.

The corners of a view agree with each other far better than with the corners of other cameras, if the board moves and
the cameras are not exactly synchronous. So each view has its own slip, a turn and a shift of the board, from a normal
distribution whose width is estimated from the views (D. J. C. MacKay, Bayesian interpolation, 1992, equation 4.6); a
view that slips more than others has a wider one, so that slips follow Student's distribution. Where cameras are
synchronous the width shrinks to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.calibration.bundle import Bundle

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
        scale: (sightings,), variance of a sighting's slip against that of others.
        board_m: size of the board.
    """

    std: Float[np.ndarray, "2"]
    scale: Float[np.ndarray, " sightings"]
    board_m: float

    @staticmethod
    def start(board_m: float, sightings: int) -> Slips:
        """Wide slips of all sightings."""
        return Slips(_START * np.array([1.0, board_m]), np.ones(sightings), board_m)

    def each(self) -> Float[np.ndarray, "sightings 2"]:
        """(sightings, 2), standard deviations of a sighting's slip, for `Bundle`."""
        return np.sqrt(self.scale)[:, None] * self.std

    def estimated(self, bundle: Bundle) -> Slips:
        """The widths again, from the slips of an adjustment with these widths."""
        instant, parts = bundle.problem.target, bundle.sightings
        cameras = np.bincount(instant[bundle.used.any(axis=1)], minlength=instant.max() + 1)[instant]
        squares = parts.slip**2
        variance = np.diagonal(parts.slip_covariance, axis1=1, axis2=2)
        widths = np.repeat(self.std**2, 3)
        # The board's pose follows the slips of its views: of two views, each shows half of their difference.
        kept = np.where(cameras > 1, 1 - 1 / np.maximum(cameras, 1), 0.0) / self.scale
        scaled = self.scale[:, None]
        shown = (kept > 0) @ (squares / scaled).reshape(-1, 2, 3).sum(axis=-1)
        expected = kept @ (widths * scaled - variance).clip(0).reshape(-1, 2, 3).sum(axis=-1)
        surprise = ((squares + variance) / widths).sum(axis=-1)
        factor = np.clip(shown / np.maximum(expected, 1e-300), _LARGEST_STEP**-2, _LARGEST_STEP**2)
        least = _LEAST * np.array([1.0, self.board_m])
        scale = (_FREEDOM + surprise) / (_FREEDOM + _UNKNOWNS)
        return Slips(np.maximum(self.std * np.sqrt(factor), least), scale, self.board_m)
