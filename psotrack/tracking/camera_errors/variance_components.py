"""Variances of the cameras' errors from the residuals of positions that were fitted to the cameras' places.

A fitted position follows the errors, so residuals are smaller than errors, and smallest in cameras that determine the
position. Restricted maximum likelihood (H. D. Patterson, R. Thompson, Biometrika 58(3), 1971) uses only the parts of
the residuals that no position explains, and gives variances without this bias. The algorithm is the
minorisation-maximisation algorithm of H. Zhou, L. Hu, J. Zhou, K. Lange, Journal of Computational and Graphical
Statistics 28(2), 2019: each step multiplies a variance by the square root of a ratio, so variances stay positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

#: Largest number of steps, which end when the variances change by less than a fraction of the mean squared residual. A
#: variance that is zero is halved in each step at the end.
_NUM_STEPS, _SETTLED = 60, 1e-5
#: Least variance, as a fraction of the mean squared residual.
_LEAST = 1e-6
#: Number of residuals as which the common variance of all cameras counts.
_COMMON = 3.0


@dataclass(frozen=True)
class FittedPlaces:
    """Places of drones in the cameras' images, relative to positions that were fitted to them.

    Attributes:
        residual_px: (rows, cameras, 2), residuals, pixels; any value where not shown.
        jacobian: (rows, cameras, 2, 3), derivatives of the projections by the position, pixels per metre.
        shown: (rows, cameras), whether the camera shows the place.
    """

    residual_px: Float[np.ndarray, "rows cameras 2"]
    jacobian: Float[np.ndarray, "rows cameras 2 3"]
    shown: Bool[np.ndarray, "rows cameras"]

    def only(self, rows: np.ndarray) -> FittedPlaces:
        """Some of the rows."""
        return FittedPlaces(self.residual_px[rows], self.jacobian[rows], self.shown[rows])

    @property
    def determined(self) -> Bool[np.ndarray, "rows"]:
        """(rows,), whether the residuals say something: two cameras from two sides."""
        jacobian = of_rows(np.where(self.shown[..., None, None], self.jacobian, 0.0))
        normal = jacobian.swapaxes(-1, -2) @ jacobian
        scale = np.trace(normal, axis1=-2, axis2=-1)
        least = np.linalg.eigvalsh(normal / np.where(scale > 0, scale, 1.0)[:, None, None])[:, 0]
        return np.asarray((self.shown.sum(axis=-1) >= 2) & (scale > 0) & (least > 1e-9))


def of_rows(values: Float[np.ndarray, "rows cameras 2 *rest"]) -> Float[np.ndarray, "rows all *rest"]:
    """Values of each row's cameras as one axis of equations: sums over it are products of matrices."""
    return values.reshape(len(values), 2 * values.shape[1], *values.shape[3:])


def weighted_residuals(
    places: FittedPlaces, weight: Float[np.ndarray, "rows cameras 2"]
) -> tuple[
    Float[np.ndarray, "rows cameras 2"],
    Float[np.ndarray, "rows cameras 2 3"],
    Float[np.ndarray, "rows 3 3"],
]:
    """P r, W J and (Jᵀ W J)⁻¹, where P = W - W J (Jᵀ W J)⁻¹ Jᵀ W.

    Args:
        places: residuals and derivatives; all rows are determined.
        weight: (rows, cameras, 2), inverse variances along columns and rows; 0 where not shown.
    """
    residual_px = np.where(places.shown[..., None], places.residual_px, 0.0)
    weighted = weight[..., None] * places.jacobian
    equations = of_rows(weighted)
    inverse = np.linalg.inv(equations.swapaxes(-1, -2) @ of_rows(places.jacobian))
    moved_m = np.matvec(inverse, np.vecmat(of_rows(residual_px), equations))
    return weight * residual_px - np.matvec(equations, moved_m).reshape(residual_px.shape), weighted, inverse


def camera_variances(
    places: FittedPlaces, inflation: float = 1.0, near_px2: Float[np.ndarray, "cameras 2"] | None = None
) -> Float[np.ndarray, "cameras 2"]:
    """(cameras, 2), variances of each camera's places along columns and rows; NaN without residuals.

    Two cameras show errors across their common plane with the drone only, and the sum of both cameras' errors rather
    than each: what residuals do not tell apart is the mean of all variances. Errors that stay for seconds are few
    errors, however many frames show them, and tell few cameras apart.

    Args:
        places: residuals and derivatives.
        inflation: number of rows that show as much as one row would of white noise.
        near_px2: (cameras, 2), variances from which the steps start; None: the mean squared residual.
    """
    places = places.only(places.determined)
    seen = np.repeat(np.any(places.shown, axis=0, keepdims=True).T, 2, axis=-1)
    if not len(places.shown):
        return np.full(seen.shape, np.nan)
    shown = places.shown[..., None]
    mean_px2 = np.square(np.where(shown, places.residual_px, 0.0)).sum() / max(1, 2 * shown.sum())
    least_px2 = _LEAST * mean_px2 + np.finfo(float).tiny
    variance_px2 = np.maximum(np.full(seen.shape, mean_px2) if near_px2 is None else near_px2, least_px2)
    for _ in range(_NUM_STEPS):
        weight = shown / variance_px2
        left, weighted, inverse = weighted_residuals(places, weight)
        # Sums over the rows of (P r)² and of the diagonal of P.
        equations = of_rows(weighted)
        leverage = np.vecdot(equations @ inverse, equations).sum(axis=0).reshape(seen.shape)
        found, expected = np.square(left).sum(axis=0) / inflation, (weight.sum(axis=0) - leverage) / inflation
        # The common variance counts as some more residuals of each camera.
        told = np.where(seen, expected, 0.0)
        common_px2 = (told * variance_px2).sum() / told.sum() if told.sum() > 0 else mean_px2
        found = found + _COMMON * common_px2 / np.square(variance_px2)
        expected = expected + _COMMON / variance_px2
        before_px2 = variance_px2
        variance_px2 = np.maximum(before_px2 * np.sqrt(found / expected), least_px2)
        if np.abs(variance_px2 - before_px2).max() < _SETTLED * mean_px2:
            break
    return np.where(seen, variance_px2, np.nan)
