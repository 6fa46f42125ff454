"""Lines through the measured edges of markers, straight or slightly bent, and their intersections.

An edge on a bent sheet is fitted by a parabola instead of a straight line, where the points show the bend. A parabola
that the points do not require would only be less certain at its ends, and the corners are at the ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_Points = Float[np.ndarray, "markers 4 points 2"]
_Heights = Float[np.ndarray, "markers 4 points"]

#: Number of times a line is fitted again with lower weights for points off the line, such as where a drone hides
#: the edge.
_REWEIGHTINGS = 2
#: Distance from a line, in pixels, below which a point keeps most of its weight.
_INLIER_PX = 0.1
#: Smallest bend of an edge that counts as bent, at the ends of the measured part: in standard deviations; in spreads of
#: the transition; and in spreads times the spread in half lengths, because blur mixes cells into the edge.
_BENT, _LEAST_BEND, _BLURRED_BEND = 5.0, 0.15, 3.0
#: Number of times the intersections of bent edges are found again, each along the tangents at the last ones.
_TANGENTS = 3
#: Variance of a corner that an edge's bend leaves open, as shares of the squared move of the corner by the bend: where
#: the edge counts as straight, although it may be bent, and where it counts as bent, but is no exact parabola.
_BEND_LEFT = (0.5, 0.15)
#: Smallest distance of points, in pixels, at which their errors are their own; and the smallest scatter of points.
_LEAST_APART_PX, _LEAST_SCATTER_PX = 0.7, 0.01
#: Largest distance of a corner from the middle of an edge, in half lengths of the measured part.
_FARTHEST = 3.0

#: Numbers of the side before and after each side. NumPy's roll takes several times as long.
BEFORE, NEXT = [3, 0, 1, 2], [1, 2, 3, 0]


@dataclass(frozen=True)
class FittedCorners:
    """Intersections of lines with their accuracy.

    Attributes:
        corners: (markers, 4, 2), the intersection of each side with the side before it, pixels.
        std: (markers,), standard deviation of a corner along x and along y, from how well the lines fit, pixels.
    """

    corners: Float[np.ndarray, "markers 4 2"]
    std: Float[np.ndarray, " markers"]


def fit_lines(
    points: _Points, weight: _Heights
) -> tuple[
    Float[np.ndarray, "markers 4 2"], Float[np.ndarray, "markers 4 2"], Float[np.ndarray, "markers 4"]
]:
    """Straight lines through points, by least squares of distances with lower weights for outliers.

    Returns:
        A point on each line, the line's direction, and the median distance of the points from the line.
    """
    weighted = weight
    for _ in range(1 + _REWEIGHTINGS):
        total = np.maximum(weighted.sum(axis=-1), 1e-9)[..., None]
        middle = (weighted[..., None, :] @ points)[..., 0, :] / total
        apart = points - middle[:, :, None]
        square = np.swapaxes(weighted[..., None] * apart, -1, -2) @ apart
        angle = np.arctan2(2 * square[..., 0, 1], square[..., 0, 0] - square[..., 1, 1]) / 2
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        distance = np.abs(apart[..., 0] * direction[..., None, 1] - apart[..., 1] * direction[..., None, 0])
        typical = median_of_rows(distance)[..., None]
        weighted = weight / (1 + (distance / np.maximum(1.5 * typical, _INLIER_PX)) ** 2)
    return middle, direction, typical[..., 0]


def fit_curves(points: _Points, weight: _Heights, spread: Float[np.ndarray, "markers 4"]) -> FittedCorners:
    """Fit each edge by a line, or by a parabola where the edge is bent, and intersect neighbouring edges.

    The accuracy is that of weighted least squares: the scatter of the points about the fit, times how far a corner is
    beyond the points (Draper & Smith, Applied regression analysis, 1998, chapter 5).

    Args:
        points: (markers, 4, points, 2), measured points along the edges, pixels.
        weight: (markers, 4, points), 0 where a point is not measured.
        spread: (markers, 4), width of the transition that a point is measured from, pixels: nearer points share pixels
            and errors.
    """
    middle, direction, _ = fit_lines(points, weight)
    normal = np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
    apart = points - middle[:, :, None]
    along = (apart * direction[:, :, None]).sum(axis=-1)
    half = np.maximum(np.abs(along).max(axis=-1), 1e-9)
    place = along / half[..., None]
    off = (apart * normal[:, :, None]).sum(axis=-1)
    shared = np.maximum(0.5 * points.shape[2] * np.maximum(spread, _LEAST_APART_PX) / half, 1.0)
    powers, covariance, bend_std = _fit_powers(place, off, weight, shared)
    bend = np.abs(powers[1][..., 2])
    wide = np.maximum(spread, _LEAST_APART_PX)
    is_bent = (bend > _BENT * bend_std) & (bend > _LEAST_BEND * wide + _BLURRED_BEND * wide**2 / half)
    curves = _Curves(
        middle,
        direction,
        normal,
        half,
        np.where(is_bent[..., None], powers[1], powers[0]),
        np.where(is_bent[..., None, None], covariance[1], covariance[0]),
        powers[1] - powers[0],
        np.where(is_bent, _BEND_LEFT[1], _BEND_LEFT[0]),
    )
    before = curves.before()
    corners = intersections(middle, direction)
    for _ in range(_TANGENTS):
        (on, ahead), (on_before, ahead_before) = curves.tangents(corners), before.tangents(corners)
        corners = _crossing(on, ahead, on_before, ahead_before)
    sine = ahead[..., 0] * ahead_before[..., 1] - ahead[..., 1] * ahead_before[..., 0]
    variance = (curves.variance(corners) + before.variance(corners)) / (2 * np.maximum(sine**2, 1e-4))
    return FittedCorners(corners, np.sqrt(variance.mean(axis=1)))


@dataclass(frozen=True)
class _Curves:
    """Edges as parabolas beside straight lines.

    Attributes:
        middle: (markers, 4, 2), a point on each line.
        direction: (markers, 4, 2), unit vectors along the lines.
        normal: (markers, 4, 2), unit vectors across the lines.
        half: (markers, 4), half length of the measured part, pixels: the unit along a line.
        powers: (markers, 4, 3), distance of the edge from the line, as coefficients of powers of the place along it.
        covariance: (markers, 4, 3, 3), covariance of these coefficients.
        bend: (markers, 4, 3), difference between the coefficients with and without a bend.
        left: (markers, 4), share of the bend's squared effect that counts as variance.
    """

    middle: Float[np.ndarray, "markers 4 2"]
    direction: Float[np.ndarray, "markers 4 2"]
    normal: Float[np.ndarray, "markers 4 2"]
    half: Float[np.ndarray, "markers 4"]
    powers: Float[np.ndarray, "markers 4 3"]
    covariance: Float[np.ndarray, "markers 4 3 3"]
    bend: Float[np.ndarray, "markers 4 3"]
    left: Float[np.ndarray, "markers 4"]

    def before(self) -> _Curves:
        """The side before each side."""
        return _Curves(*(getattr(self, name)[:, BEFORE] for name in self.__dataclass_fields__))

    def tangents(
        self, near: Float[np.ndarray, "markers 4 2"]
    ) -> tuple[Float[np.ndarray, "markers 4 2"], Float[np.ndarray, "markers 4 2"]]:
        """A point and the direction of each edge, at the place that is nearest to a point of its own."""
        place = self._place(near)
        off = (self.powers * place[..., None] ** np.arange(3)).sum(axis=-1)
        slope = (self.powers[..., 1] + 2 * self.powers[..., 2] * place) / self.half
        on = self.middle + (place * self.half)[..., None] * self.direction + off[..., None] * self.normal
        ahead = self.direction + slope[..., None] * self.normal
        return on, ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)

    def variance(self, near: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 4"]:
        """Variance of each edge's distance from its line at a point's place, square pixels."""
        basis = self._place(near)[..., None] ** np.arange(3)
        of_fit = (basis[..., None, :] @ self.covariance @ basis[..., None])[..., 0, 0]
        return of_fit + self.left * (basis * self.bend).sum(axis=-1) ** 2

    def _place(self, near: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 4"]:
        along = ((near - self.middle) * self.direction).sum(axis=-1) / self.half
        return np.clip(along, -_FARTHEST, _FARTHEST)


def _fit_powers(
    place: _Heights, off: _Heights, weight: _Heights, shared: Float[np.ndarray, "markers 4"]
) -> tuple[
    Float[np.ndarray, "2 markers 4 3"], Float[np.ndarray, "2 markers 4 3 3"], Float[np.ndarray, "markers 4"]
]:
    """Lines and parabolas through points, by least squares with lower weights for outliers.

    Returns:
        (2, markers, 4, 3), coefficients of the line, whose last one is 0, and of the parabola; and (2, markers, 4, 3,
        3), their covariances, if `shared` points have the information of one; and (markers, 4), the standard deviation
        of the parabola's last coefficient if no point is an outlier.
    """
    basis = place[..., None] ** np.arange(3)
    # The line is a parabola without its last column.
    basis = np.stack([basis * np.array([1.0, 1.0, 0.0]), basis])
    unused = np.array([np.diag([0.0, 0.0, 1.0]), np.zeros((3, 3))])[:, None, None]
    weight = weight / np.maximum(weight.mean(axis=-1, keepdims=True), 1e-9)
    weighted = np.broadcast_to(weight, basis.shape[:-1])
    for _ in range(1 + _REWEIGHTINGS):
        used = weighted
        columns = np.swapaxes(basis * used[..., None], -1, -2)
        inverse = np.linalg.inv(columns @ basis + unused + 1e-6 * np.eye(3))
        powers = (inverse @ (columns @ off[..., None]))[..., 0]
        left2 = (off - (basis @ powers[..., None])[..., 0]) ** 2
        typical2 = np.maximum(1.5**2 * median_of_rows(left2)[..., None], _INLIER_PX**2)
        weighted = weight / (1 + left2 / typical2)
    count = np.array([2.0, 3.0])[:, None, None]
    freedom = np.maximum((weight > 0).sum(axis=-1) / shared - count, 1.0)
    covariance = shared[..., None, None] * (inverse - unused * inverse)
    scatter, scatter_of_all = (
        np.maximum((each * left2).sum(axis=-1) / np.maximum(each.sum(axis=-1), 1e-9), _LEAST_SCATTER_PX**2)
        * (1 + count / freedom)
        for each in (used, np.broadcast_to(weight, used.shape))
    )
    bend_std = np.sqrt(scatter_of_all[1] * covariance[1][..., 2, 2])
    return powers, scatter[..., None, None] * covariance, bend_std


def median_of_rows(values: Float[np.ndarray, "*rows values"]) -> Float[np.ndarray, "*rows"]:
    """Median of each row of finite values. `numpy.median`, which looks for NaN first, takes three times as long."""
    above = values.shape[-1] // 2
    below = above - 1 + values.shape[-1] % 2
    ordered = np.partition(values, (below, above), axis=-1)
    return (ordered[..., below] + ordered[..., above]) / 2


def intersections(
    on: Float[np.ndarray, "markers 4 2"], direction: Float[np.ndarray, "markers 4 2"]
) -> Float[np.ndarray, "markers 4 2"]:
    """Intersection of each line with the line before it; far away where the two are parallel."""
    return _crossing(on, direction, on[:, BEFORE], direction[:, BEFORE])


def _crossing(
    on: Float[np.ndarray, "markers 4 2"],
    direction: Float[np.ndarray, "markers 4 2"],
    before: Float[np.ndarray, "markers 4 2"],
    ahead: Float[np.ndarray, "markers 4 2"],
) -> Float[np.ndarray, "markers 4 2"]:
    apart = on - before
    cross = ahead[..., 0] * direction[..., 1] - ahead[..., 1] * direction[..., 0]
    along = apart[..., 0] * direction[..., 1] - apart[..., 1] * direction[..., 0]
    return before + (along / np.where(np.abs(cross) < 1e-9, 1e-9, cross))[..., None] * ahead
