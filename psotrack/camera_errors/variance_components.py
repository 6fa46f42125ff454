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

#: Number of steps. A variance that is zero is halved in each step at the end.
_NUM_STEPS = 60
#: Least variance, as a share of the mean squared residual.
_LEAST = 1e-6


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
        weight = self.shown.astype(float)
        normal = np.einsum("rc,rcik,rcil->rkl", weight, self.jacobian, self.jacobian)
        scale = np.trace(normal, axis1=-2, axis2=-1)
        least = np.linalg.eigvalsh(normal / np.where(scale > 0, scale, 1.0)[:, None, None])[:, 0]
        return np.asarray((self.shown.sum(axis=-1) >= 2) & (scale > 0) & (least > 1e-9))


def weighted_residuals(
    places: FittedPlaces, weight: Float[np.ndarray, "rows cameras"]
) -> tuple[
    Float[np.ndarray, "rows cameras 2"],
    Float[np.ndarray, "rows cameras 2 3"],
    Float[np.ndarray, "rows 3 3"],
]:
    """P r, W J and (Jᵀ W J)⁻¹, where P = W - W J (Jᵀ W J)⁻¹ Jᵀ W.

    Args:
        places: residuals and derivatives; all rows are determined.
        weight: (rows, cameras), inverse variances; 0 where not shown.
    """
    residual_px = np.where(places.shown[..., None], places.residual_px, 0.0)
    weighted = weight[..., None, None] * places.jacobian
    inverse = np.linalg.inv(np.einsum("rcik,rcil->rkl", weighted, places.jacobian))
    moved_m = np.einsum("rkl,rcil,rci->rk", inverse, weighted, residual_px)
    return weight[..., None] * residual_px - np.einsum("rcik,rk->rci", weighted, moved_m), weighted, inverse


def camera_variances(
    places: FittedPlaces, known_px2: Float[np.ndarray, "rows cameras"]
) -> Float[np.ndarray, "cameras"]:
    """(cameras,), variance of each camera's places along either axis, besides a known part; NaN without residuals.

    Args:
        places: residuals and derivatives.
        known_px2: (rows, cameras), the known part of the variances, squared pixels.
    """
    rows = places.determined
    places, known_px2 = places.only(rows), known_px2[rows]
    seen = places.shown.any(axis=0)
    if not len(places.shown):
        return np.full(seen.shape, np.nan)
    squared = np.where(places.shown[..., None], places.residual_px, 0.0) ** 2
    mean_px2 = squared.sum() / max(1, 2 * places.shown.sum())
    least_px2 = _LEAST * mean_px2 + np.finfo(float).tiny
    variance_px2 = np.full(seen.shape, mean_px2 + least_px2)
    for _ in range(_NUM_STEPS):
        weight = np.where(places.shown, 1 / (known_px2 + variance_px2), 0.0)
        left, weighted, inverse = weighted_residuals(places, weight)
        # Diagonal of P, summed over both axes: 2 w - w² tr(J (Jᵀ W J)⁻¹ Jᵀ).
        leverage = np.einsum("rcik,rkl,rcil->rc", weighted, inverse, weighted)
        expected = (2 * weight - leverage).sum(axis=0)
        found = np.square(left).sum(axis=(0, 2))
        ratio = np.where(expected > 0, found / np.where(expected > 0, expected, 1.0), 1.0)
        variance_px2 = np.maximum(variance_px2 * np.sqrt(ratio), least_px2)
    return np.where(seen, variance_px2, np.nan)
