"""Errors that are alike: a camera sees many points off in the same way, and least squares take each for a new one.

A detector draws its boxes from a drone's outline, whose middle is not where the drone's is: beside what differs from
frame to frame there is what lasts. Where errors e of a camera have something of covariance S in common, the estimate
x = A⁻¹ Jᵀ W e of least squares has the covariance A⁻¹ Jᵀ W S W J A⁻¹ beside that of independent errors (the sandwich of
P. J. Huber 1967; Liang & Zeger 1986 for groups).
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.bundle_equations import BundleState, Equations, Problem, slopes_of

#: A common error that its points tell less well than this, in its own standard deviations, says nothing of its size.
_TOLD = 1.0


@dataclass(frozen=True)
class Alike:
    """Errors of one kind that a camera has in common for all points of a label, along x and along y by themselves.

    Attributes:
        label: (points,), whole numbers from 0.
        std_px: (points, cameras), by how much an error of one standard deviation moves each point; below 0 where it
            moves it the other way. Of no meaning where the point is not seen.
    """

    label: Int[np.ndarray, " points"]
    std_px: Float[np.ndarray, "points cameras"]


def covariance_of_alike(
    problem: Problem,
    state: BundleState,
    weights: Float[np.ndarray, "points cameras"],
    equations: Equations,
    alike: Ordered[Alike],
) -> Float[np.ndarray, "free free"]:
    """What errors that are alike add to the covariance of the unknowns.

    Where residuals show that those of a kind are larger than stated, they count as they show.

    Args:
        problem, state, weights: of the solution.
        equations: there, not damped.
        alike: each kind, of the problem's points.
    """
    free = problem.free.shape[1]
    pulled = np.zeros((free, free))
    for kind in alike:
        size = int(kind.label.max(initial=-1)) + 1
        of_kind, squares, expected = np.zeros((free, free)), 0.0, 0.0
        for index in range(len(problem.given)):
            seen = np.flatnonzero(weights[:, index])
            if not len(seen):
                continue
            slopes, off = _reduced_slopes(problem, state, equations, index, seen)
            weight, std = weights[seen, index], kind.std_px[seen, index]
            pull, told, shown = np.zeros((size, 2, free)), np.zeros(size), np.zeros((size, 2))
            np.add.at(pull, kind.label[seen], (weight * std)[:, None, None] * slopes)
            np.add.at(told, kind.label[seen], weight * std**2)
            np.add.at(shown, kind.label[seen], (weight * std)[:, None] * off)
            of_kind += np.einsum("lki,lkj->ij", pull, pull)
            well = told > _TOLD
            squares += float(np.sum((shown[well] / told[well, None]) ** 2))
            expected += float(2 * np.sum(1 + 1 / told[well]))
        pulled += of_kind * max(1.0, squares / expected if expected else 1.0)
    inverse = np.linalg.inv(equations.reduced)
    return inverse @ pulled @ inverse


def _reduced_slopes(
    problem: Problem, state: BundleState, equations: Equations, index: int, seen: Int[np.ndarray, " seen"]
) -> tuple[Float[np.ndarray, "seen 2 free"], Float[np.ndarray, "seen 2"]]:
    """Derivatives of a camera's pixels by the unknowns, the points following them; and what pixels are off by."""
    by_camera, off = slopes_of(problem, state, index, seen)
    count = len(problem.given)
    columns = np.append(np.arange(6 * index, 6 * index + 6), 6 * count)
    by_point = by_camera[..., 3:6] @ state.T_cam_world[index, :3, :3]
    return by_camera @ problem.free[columns] + by_point @ equations.back[seen], off
