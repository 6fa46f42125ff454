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

#: Largest number of steps, which end when the variances change by less than a share of the mean squared residual. A
#: variance that is zero is halved in each step at the end.
_NUM_STEPS, _SETTLED = 60, 1e-5
#: Least variance, as a share of the mean squared residual.
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
        weight = self.shown.astype(float)
        normal = np.einsum("rc,rcik,rcil->rkl", weight, self.jacobian, self.jacobian)
        scale = np.trace(normal, axis1=-2, axis2=-1)
        least = np.linalg.eigvalsh(normal / np.where(scale > 0, scale, 1.0)[:, None, None])[:, 0]
        return np.asarray((self.shown.sum(axis=-1) >= 2) & (scale > 0) & (least > 1e-9))


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
    inverse = np.linalg.inv(np.einsum("rcik,rcil->rkl", weighted, places.jacobian))
    moved_m = np.einsum("rkl,rl->rk", inverse, np.einsum("rcil,rci->rl", weighted, residual_px))
    return weight * residual_px - np.einsum("rcik,rk->rci", weighted, moved_m), weighted, inverse


def camera_variances(
    places: FittedPlaces,
    known_px2: Float[np.ndarray, "rows cameras 2"],
    near_px2: Float[np.ndarray, "cameras 2"] | None = None,
) -> Float[np.ndarray, "cameras 2"]:
    """(cameras, 2), variances of each camera's places along columns and rows; NaN without residuals.

    Two cameras show errors across their common plane with the drone only, and the sum of both cameras' errors rather
    than each: what residuals do not tell apart is the mean of all variances.

    Args:
        places: residuals and derivatives.
        known_px2: (rows, cameras, 2), the known part of the variances, which is not in the result, squared pixels.
        near_px2: (cameras, 2), variances from which the steps start; None: the mean squared residual.
    """
    rows = places.determined
    places, known_px2 = places.only(rows), known_px2[rows]
    seen = np.repeat(np.any(places.shown, axis=0, keepdims=True).T, 2, axis=-1)
    if not len(places.shown):
        return np.full(seen.shape, np.nan)
    parts = _Parts.of(places)
    known_px2 = known_px2.reshape(len(known_px2), -1).T
    mean_px2 = np.square(parts.residual_px).sum() / max(1, 2 * places.shown.sum())
    least_px2 = _LEAST * mean_px2 + np.finfo(float).tiny
    variance_px2 = np.full(seen.shape, mean_px2) if near_px2 is None else near_px2
    variance_px2 = np.maximum(variance_px2, least_px2)
    for _ in range(_NUM_STEPS):
        weight = parts.shown / (known_px2 + variance_px2.reshape(-1, 1))
        found, expected = (of.reshape(seen.shape) for of in parts.squares(weight))
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


#: Elements of a symmetric 3 x 3 matrix, and how often each is in the matrix.
_PAIRS, _TIMES = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)), np.array([1, 2, 1, 2, 2, 1])


@dataclass(frozen=True)
class _Parts:
    """Places with the axis of rows last, along which NumPy computes fast; 0 where a camera does not show the place.

    Attributes:
        residual_px: (views, rows), residuals, one view for each camera and axis of its image.
        jacobian: (3, views, rows), derivatives of the residuals' places.
        products: (6, views, rows), products of two derivatives, for the lower triangle of a matrix.
        shown: (views, rows), 1 where shown.
    """

    residual_px: Float[np.ndarray, "views rows"]
    jacobian: Float[np.ndarray, "3 views rows"]
    products: Float[np.ndarray, "6 views rows"]
    shown: Float[np.ndarray, "views rows"]

    @classmethod
    def of(cls, places: FittedPlaces) -> _Parts:
        """The parts of some places."""
        num_rows = len(places.shown)
        shown = np.repeat(places.shown, 2, axis=-1).T.astype(float)
        residual_px = np.where(shown > 0, places.residual_px.reshape(num_rows, -1).T, 0.0)
        jacobian = np.where(shown > 0, places.jacobian.reshape(num_rows, -1, 3).transpose(2, 1, 0), 0.0)
        products = np.stack([jacobian[first] * jacobian[second] for first, second in _PAIRS])
        return cls(residual_px, jacobian, products, shown)

    def squares(
        self, weight: Float[np.ndarray, "views rows"]
    ) -> tuple[Float[np.ndarray, "views"], Float[np.ndarray, "views"]]:
        """Sums over the rows of (P r)², and of the diagonal of P (see `weighted_residuals`)."""
        inverse = _inverse(np.einsum("pvr,vr->pr", self.products, weight))
        to_place = np.einsum("kvr,vr->kr", self.jacobian, weight * self.residual_px)
        element = {pair: inverse[number] for number, pair in enumerate(_PAIRS)}
        rows = ((max(k, other), min(k, other)) for k in range(3) for other in range(3))
        matrix = np.stack([element[pair] for pair in rows]).reshape(3, 3, -1)
        moved_m = np.einsum("kmr,mr->kr", matrix, to_place)
        left = weight * (self.residual_px - np.einsum("kvr,kr->vr", self.jacobian, moved_m))
        # Diagonal of P: w - w² J (Jᵀ W J)⁻¹ Jᵀ.
        leverage = np.einsum("pvr,pr->vr", self.products, _TIMES[:, None] * inverse)
        diagonal = weight - np.square(weight) * leverage
        return np.square(left).sum(axis=-1), diagonal.sum(axis=-1)


def _inverse(matrix: Float[np.ndarray, "6 rows"]) -> Float[np.ndarray, "6 rows"]:
    """Inverses of positive definite 3 x 3 matrices, given as their lower triangles, by Cholesky factors."""
    a, b, c, d, e, f = matrix
    # Factor L, with the inverses of its diagonal; then L⁻¹; then L⁻ᵀ L⁻¹.
    p = 1 / np.sqrt(a)
    l10, l20 = b * p, d * p
    q = 1 / np.sqrt(c - l10 * l10)
    l21 = (e - l20 * l10) * q
    s = 1 / np.sqrt(f - l20 * l20 - l21 * l21)
    m10 = -l10 * p * q
    m21 = -l21 * q * s
    m20 = -(l20 * p + l21 * m10) * s
    return np.stack(
        [p * p + m10 * m10 + m20 * m20, m10 * q + m20 * m21, q * q + m21 * m21, m20 * s, m21 * s, s * s]
    )
