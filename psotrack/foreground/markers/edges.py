"""Edges of markers: where black turns into white across them, and the lines or slightly bent curves through them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

#: An image of grey levels, or of linear light.
Levels = UInt8[np.ndarray, "height width"] | UInt16[np.ndarray, "height width"]
_Points = Float[np.ndarray, "markers 4 points 2"]
_Weights = Float[np.ndarray, "markers 4 points"]
_Corners = Float[np.ndarray, "markers 4 2"]
_Sides = Float[np.ndarray, "markers 4"]

#: Positions of the samples across an edge, and of the middles between samples, in steps.
_ACROSS = np.linspace(-1.0, 1.0, 17)
_MIDDLES = (_ACROSS[1:] + _ACROSS[:-1]) / 2
#: Weights whose sums over the middles give the height of a transition, and its first and second moment.
_MOMENTS = np.stack([_MIDDLES**0, _MIDDLES, _MIDDLES**2], axis=-1).astype(np.float32)
#: Variance of a rise about the middle of the two samples between which it is.
_WITHIN = (_ACROSS[1] - _ACROSS[0]) ** 2 / 12
#: Fraction of the steepest rise across an edge below which a rise counts as noise. Noise grows with light, so that the
#: noise of the white side would draw the transition to that side.
_NOISE = 0.1
#: Number of times an edge is fitted again with lower weights for points far from it, such as where a drone hides it,
#: and distance in pixels below which a point keeps most of its weight.
_REWEIGHTINGS, _INLIER_PX = 2, 0.1
#: Smallest distance of points, in pixels, at which their errors are independent; and the smallest scatter of points.
_LEAST_APART_PX, _LEAST_SCATTER_PX = 0.7, 0.01
#: Smallest bend of an edge that counts as bent, at the ends of the measured part: in standard deviations; in spreads of
#: the transition; and in spreads times the spread in half lengths, because blur mixes cells into the edge.
_BENT, _LEAST_BEND, _BLURRED_BEND = 5.0, 0.15, 3.0
#: Fractions of the squared displacement of a corner by an edge's bend that count as variance: where the edge counts as
#: straight, although it may be bent, and where it counts as bent, but is no exact parabola.
_BEND_LEFT = (0.5, 0.15)

#: Numbers of the side before and after each side. NumPy's roll takes several times as long.
BEFORE, NEXT = [3, 0, 1, 2], [1, 2, 3, 0]


@dataclass(frozen=True)
class EdgeTransitions:
    """Transitions from black to white across edges.

    Attributes:
        offset: (edges, points), middle of the transition along the step, in steps, -1 to 1.
        spread: (edges, points), standard deviation of the transition about its middle, in steps.
        height: (edges, points), difference of levels across the transition; 0 where there is none.
    """

    offset: Float[np.ndarray, "edges points"]
    spread: Float[np.ndarray, "edges points"]
    height: Float[np.ndarray, "edges points"]


def find_transitions(
    levels: Levels,
    places_px: Float[np.ndarray, "edges points 2"],
    steps_px: Float[np.ndarray, "edges points 2"],
) -> EdgeTransitions:
    """Find the transition near each place, between one step before the place and one step after it.

    Args:
        levels: (height, width).
        places_px: (edges, points, 2). OpenCV's limit on image sizes allows fewer than 32768 edges, and fewer than
            32768 samples (17 for each point).
        steps_px: (edges, points, 2), towards white. A step of length 0 finds no transition.
    """
    samples = (places_px[..., None, :] + steps_px[..., None, :] * _ACROSS[:, None]).astype(np.float32)
    flat = samples.reshape(len(places_px), -1, 2)
    image = cv2.remap(levels, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # Single precision is twice as fast.
    rise = np.maximum(np.diff(np.asarray(image, np.float32).reshape(samples.shape[:-1]), axis=-1), 0.0)
    rise = np.maximum(rise - np.float32(_NOISE) * rise.max(axis=-1, keepdims=True), 0.0)
    height, first, second = np.moveaxis((rise @ _MOMENTS).astype(np.float64), -1, 0)
    total = np.maximum(height, 1e-9)
    offset = first / total
    return EdgeTransitions(offset, np.sqrt(np.maximum(second / total - offset**2, 0.0) + _WITHIN), height)


@dataclass(frozen=True)
class FittedCorners:
    """Intersections of the edges of markers.

    Attributes:
        corners_px: (markers, 4, 2), the intersection of each side with the side before it, pixels.
        std_px: (markers,), standard deviation of a corner along x and along y, from how well the edges fit, pixels.
        scatter_px: (markers, 4), median distance of the points of each edge from its chord, pixels.
    """

    corners_px: _Corners
    std_px: Float[np.ndarray, " markers"]
    scatter_px: _Sides


def fit_corners(
    near_px: _Corners, points_px: _Points, weight: _Weights, spread_px: _Sides, *, least_bend: float
) -> FittedCorners:
    """Fit each side of quadrangles by a line, or by a parabola where it is bent, and intersect neighbouring sides.

    A parabola that the points do not require would only be less certain at its ends, and the corners are at the ends.
    The accuracy is that of weighted least squares (Draper & Smith, Applied regression analysis, 1998, chapter 5).

    Args:
        near_px: (markers, 4, 2), corners of the quadrangles that the points were measured along, clockwise.
        points_px: (markers, 4, points, 2), measured points along each side.
        weight: (markers, 4, points), 0 where a point is not measured.
        spread_px: (markers, 4), width of the transition that a point is measured from: nearer points have pixels and
            errors in common.
        least_bend: factor of the smallest bend that counts as bent.
    """
    side = near_px[:, NEXT] - near_px
    length = np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    ahead = side / length
    outward = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
    apart = points_px - near_px[:, :, None]
    along = (apart * ahead[:, :, None]).sum(axis=-1)
    middle = along.mean(axis=-1, keepdims=True)
    half = np.maximum(np.abs(along - middle).max(axis=-1), 1e-9)
    place = (along - middle) / half[..., None]
    off = (apart * outward[:, :, None]).sum(axis=-1)
    wide = np.maximum(spread_px, _LEAST_APART_PX)
    correlated = np.maximum(0.5 * points_px.shape[2] * wide / half, 1.0)
    line, line_variance = _fit_powers(place, off, weight, correlated, 2)
    curve, curve_variance = _fit_powers(place, off, weight, correlated, 3)
    bend = np.abs(curve[..., 2])
    bent = (bend > _BENT * np.sqrt(curve_variance[..., 2, 2])) & (
        bend > least_bend * (_LEAST_BEND * wide + _BLURRED_BEND * wide**2 / half)
    )
    powers = np.where(bent[..., None], curve, line)
    variance = np.where(bent[..., None, None], curve_variance, line_variance)
    ends, chord = [], np.zeros_like(off)
    for end in (np.zeros_like(length), length):
        at = (end - middle) / half[..., None]
        basis, slopes = at ** np.arange(3), at ** [0, 0, 1] * [0, 1, 2] / half[..., None]
        moved = (basis * powers).sum(axis=-1, keepdims=True)
        slope = (slopes * powers).sum(axis=-1, keepdims=True)
        chord += moved * (1 - np.abs(along - end) / length)
        left = np.where(bent, _BEND_LEFT[1], _BEND_LEFT[0]) * (basis * (curve - line)).sum(axis=-1) ** 2
        of_fit = (basis[..., None, :] @ variance @ basis[..., None])[..., 0, 0]
        ends.append((near_px + end * ahead + moved * outward, ahead + slope * outward, of_fit + left))
    (on, towards, here), (on_before, towards_before, there) = ends[0], (each[:, BEFORE] for each in ends[1])
    sine = _cross(towards_before, towards)
    reached = _cross(on - on_before, towards) / np.where(np.abs(sine) < 1e-9, 1e-9, sine)
    scatter_px = median_of_rows(np.abs(off - chord))
    corner_variance = (here + there) / (2 * np.maximum(sine**2, 1e-4))
    return FittedCorners(
        on_before + reached[..., None] * towards_before, np.sqrt(corner_variance.mean(axis=1)), scatter_px
    )


def _fit_powers(
    place: _Weights, off: _Weights, weight: _Weights, correlated: _Sides, terms: int
) -> tuple[Float[np.ndarray, "markers 4 3"], Float[np.ndarray, "markers 4 3 3"]]:
    """Lines (2 terms) or parabolas (3 terms) through points, by least squares with lower weights for outliers.

    Returns:
        coefficients of powers of the place, and their covariance, if `correlated` points have the information of one.
    """
    basis = place[..., None] ** np.arange(3) * (np.arange(3) < terms)
    unused = np.diag(np.arange(3) >= terms) + 1e-6 * np.eye(3)
    weight = weight / np.maximum(weight.mean(axis=-1, keepdims=True), 1e-9)
    weighted = weight
    for _ in range(1 + _REWEIGHTINGS):
        used = weighted
        columns = np.swapaxes(basis * used[..., None], -1, -2)
        inverse = np.linalg.inv(columns @ basis + unused)
        powers = (inverse @ (columns @ off[..., None]))[..., 0]
        distance = np.abs(off - (basis @ powers[..., None])[..., 0])
        typical = median_of_rows(distance)
        weighted = weight / (1 + (distance / np.maximum(1.5 * typical, _INLIER_PX)[..., None]) ** 2)
    freedom = np.maximum((weight > 0).sum(axis=-1) / correlated - terms, 1.0)
    scatter = (used * distance**2).sum(axis=-1) / np.maximum(used.sum(axis=-1), 1e-9)
    scatter = np.maximum(scatter, _LEAST_SCATTER_PX**2) * (1 + terms / freedom) * correlated
    return powers, scatter[..., None, None] * (inverse - unused * inverse)


def median_of_rows(values: Float[np.ndarray, "*rows values"]) -> Float[np.ndarray, "*rows"]:
    """Median of each row of finite values. `numpy.median`, which looks for NaN first, takes three times as long."""
    above = values.shape[-1] // 2
    below = above - 1 + values.shape[-1] % 2
    ordered = np.partition(values, (below, above), axis=-1)
    return (ordered[..., below] + ordered[..., above]) / 2


def _cross(one: _Corners, other: _Corners) -> _Sides:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
