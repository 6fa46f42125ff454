"""Covariance of a rig whose corners have errors in common.

All corners that are seen at one instant share errors: the board is not flat, it moves while the shutters are open, the
clocks differ. Least squares takes them for independent. The sandwich of P. J. Huber (1967), with the instants as groups
(Liang & Zeger 1986), does not; with few groups it is too small, because each group pulls the estimate towards itself.
The correction is that of Bell & McCaffrey (2002), CR3, which is the jackknife over the instants: each group's residuals
are those of an estimate without the group.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.calibration.bundle import Bundle, summed
from psotrack.errors import InputError

#: Largest condition number of the information, in units of its diagonal.
_MAX_CONDITION = 1e13
#: Smallest share of an unknown's information that the other instants must have for an instant to be left out.
_LEAST_LEFT = 0.02


def covariance_over_instants(bundle: Bundle) -> Float[np.ndarray, "unknowns unknowns"]:
    """Covariance of the shared unknowns of an adjustment, by the jackknife over the instants.

    Raises:
        InputError: the views do not determine the rig.
    """
    equations = bundle.equations()
    reduced = equations.reduced()
    # An unknown that no view determines may have an information a little below 0, by rounding.
    scale = np.sqrt(np.maximum(np.diag(reduced.information), 0.0))
    if not (scale > 0).all() or np.linalg.cond(reduced.information / np.outer(scale, scale)) > _MAX_CONDITION:
        raise InputError(
            "board",
            expected="views that determine lenses and places of all cameras",
            found="views that leave some open",
            remedy="tilt the board, and move it through the whole image of each camera; if it was, check the board's "
            "stated numbers and sizes with a ruler",
        )
    inverse = np.linalg.inv(reduced.information / np.outer(scale, scale)) / np.outer(scale, scale)
    information, pull = _by_instant(bundle, reduced.gain)
    # In units in which the information of all instants is 1, an instant's share of it is a matrix between 0 and 1.
    half = np.linalg.cholesky((inverse + inverse.T) / 2)
    shares, axes = np.linalg.eigh(half.T @ information @ half)
    left = np.maximum(1 - shares, _LEAST_LEFT)
    pulled = np.matvec(axes, np.matvec(axes.swapaxes(-1, -2), pull @ half) / left)
    groups = max(len(pulled), 2)
    covariance = half @ (pulled.T @ pulled) @ half.T
    return covariance * (groups - 1) / groups


def _by_instant(
    bundle: Bundle, gain: Float[np.ndarray, "instants 6 unknowns"]
) -> tuple[Float[np.ndarray, "used unknowns unknowns"], Float[np.ndarray, "used unknowns"]]:
    """Information of each used instant about the shared unknowns, and its pull on them."""
    parts, size, count = bundle.sightings, bundle.problem.size, len(gain)
    column, instant, own = parts.columns, bundle.problem.block[:, None, None], np.arange(6)
    information = summed(
        parts.shared, (instant, column[:, :, None], column[:, None]), (count, size + 1, size + 1)
    )[:, :-1, :-1]
    coupling = summed(parts.coupling, (instant, own[:, None], column[:, None]), (count, 6, size + 1))[
        ..., :-1
    ]
    block = summed(parts.block, (instant, own[:, None], own), (count, 6, 6))
    block_right = summed(parts.block_right, (instant[..., 0], own), (count, 6))
    pull = summed(parts.shared_right, (instant[..., 0], column), (count, size + 1))[:, :-1]
    pull -= np.matvec(gain.swapaxes(-1, -2), block_right)
    crossed = gain.swapaxes(-1, -2) @ coupling
    information += gain.swapaxes(-1, -2) @ block @ gain - crossed - crossed.swapaxes(-1, -2)
    is_used = np.trace(information, axis1=1, axis2=2) > 0
    return information[is_used], pull[is_used]
