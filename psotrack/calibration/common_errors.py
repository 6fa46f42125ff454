"""Errors that many points of a camera have in common, whereas least squares assume independent errors.

A detector draws its boxes around a drone's outline, and the middle of the outline is not the drone's middle. A part of
this error differs from frame to frame, and another part lasts. If the lasting parts of a camera's errors e have the
covariance S, the estimate x = A⁻¹ Jᵀ W e of least squares has the covariance A⁻¹ Jᵀ W S W J A⁻¹ in addition to that of
the independent errors (the sandwich of P. J. Huber 1967; Liang & Zeger 1986 for groups).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.bundles.points import PointBundle, camera_columns
from psotrack.geometry.estimation import ReducedEquations

#: Smallest information about a common error, in units of its stated precision, with which the residuals can check its
#: size.
_MIN_INFORMATION = 1.0


@dataclass(frozen=True)
class CommonErrors:
    """Errors of one kind: a camera has one error for all points of a label, separately along x and along y.

    Attributes:
        label: (points,), labels, whole numbers from 0.
        std_px: (points, cameras), shift of each point by an error of one standard deviation, pixels; negative if the
            error moves the point in the opposite direction. Ignored where a camera does not see the point.
    """

    label: Int[np.ndarray, " points"]
    std_px: Float[np.ndarray, "points cameras"]


def covariance_of_common_errors(
    bundle: PointBundle,
    equations: ReducedEquations,
    common_errors: Sequence[CommonErrors],
) -> Float[np.ndarray, "free free"]:
    """Compute the covariance that common errors add to the covariance of the unknowns.

    If the residuals show that the errors of a kind are larger than stated, the larger size is used.

    Args:
        bundle: the solution of the bundle adjustment.
        equations: reduced normal equations at the solution, without damping.
        common_errors: the kinds of common errors of the problem's points.
    """
    weights, free = bundle.weights, bundle.problem.free.shape[1]
    pulled = np.zeros((free, free))
    for kind in common_errors:
        size = int(kind.label.max(initial=-1)) + 1
        of_kind, squares, expected = np.zeros((free, free)), 0.0, 0.0
        for index in range(len(bundle.problem.given)):
            seen = np.flatnonzero(weights[:, index])
            if not len(seen):
                continue
            slopes, off = _reduced_slopes(bundle, equations, index, seen)
            weight, std = weights[seen, index], kind.std_px[seen, index]
            pull, information, shown = np.zeros((size, 2, free)), np.zeros(size), np.zeros((size, 2))
            np.add.at(pull, kind.label[seen], (weight * std)[:, None, None] * slopes)
            np.add.at(information, kind.label[seen], weight * std**2)
            np.add.at(shown, kind.label[seen], (weight * std)[:, None] * off)
            of_kind += np.einsum("lki,lkj->ij", pull, pull)
            known = information > _MIN_INFORMATION
            squares += float(np.sum((shown[known] / information[known, None]) ** 2))
            expected += float(2 * np.sum(1 + 1 / information[known]))
        pulled += of_kind * max(1.0, squares / expected if expected else 1.0)
    inverse = np.linalg.inv(equations.information)
    return inverse @ pulled @ inverse


def _reduced_slopes(
    bundle: PointBundle, equations: ReducedEquations, index: int, seen: Int[np.ndarray, " seen"]
) -> tuple[Float[np.ndarray, "seen 2 free"], Float[np.ndarray, "seen 2"]]:
    """Derivatives of a camera's pixels by the unknowns, where the points follow the cameras; and the residuals."""
    by_camera, by_point, off = bundle.slopes(index, seen)
    free = bundle.problem.free[camera_columns(index, len(bundle.problem.given))]
    return by_camera @ free - by_point @ equations.gain[seen], off
