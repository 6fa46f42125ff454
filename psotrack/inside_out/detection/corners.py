"""Corners of markers, as the intersections of lines through their edges.

Where the edges are bent, as on a bent sheet, the lines are parabolas. How well they fit, and how far a corner is from
the measured points, says how accurate the corner is.

The position of an edge is the middle of the transition from black to white across the edge, in levels that blend in
proportion (see `gamma`). A blur of the lens or of motion that is equal on both sides moves no edge, but it rounds
corners off: OpenCV's refinement, which looks at the corners themselves, makes markers too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.geometry import Camera
from psotrack.inside_out.detection.distortion import distort_pixels, undistort_pixels
from psotrack.inside_out.detection.edge_lines import (
    BEFORE,
    NEXT,
    fit_curves,
    fit_lines,
    intersections,
    median_of_rows,
)
from psotrack.inside_out.detection.edge_transitions import Levels, find_transitions
from psotrack.inside_out.detection.gamma import estimate_gamma, linearise

_Points = Float[np.ndarray, "markers 4 points 2"]
_Corners = Float[np.ndarray, "markers 4 2"]
_Sides = Float[np.ndarray, "markers 4"]

#: Distance to both sides of an edge within which its transition is searched first, in cells; and the least
#: value of this distance, in pixels.
_REACH, _LEAST_REACH_PX = 0.7, 2.0
#: The same distance in later passes, in standard deviations of the transition: wide enough for all of a blur, narrow
#: enough to leave out noise.
_SPREADS = 3.0
#: The part of this distance that is for a bent edge, in medians of the points' distances from a straight line.
_BOWS = 2.5
#: Number of passes over the edges in grey levels, with ever smaller reach. Two passes in linear light follow.
_GREY_PASSES = 2
#: Points along an edge at which it is measured, in shares of its length. Near a corner the blur mixes two edges.
_ALONG = np.linspace(0.15, 0.85, 16)
#: Largest distance that a corner may move, in units of the first search distance.
_LARGEST_MOVE = 2.0
#: Parts of a corner's standard deviation that no fit shows: the smallest, in pixels; for errors of compression and of
#: the levels' power, in spreads of the edges' transitions; and for cells that blur mixes into the edges, in spreads
#: times the spread in cells. Measured on rendered markers.
_LEAST_STD_PX, _BLUR_STD, _NEIGHBOURS_STD = 0.03, 0.04, 0.35


@dataclass(frozen=True)
class RefinedCorners:
    """Corners of markers with their accuracy.

    Attributes:
        corners_px: (markers, 4, 2), pixels.
        std_px: (markers,), standard deviation of a corner along x and along y, pixels.
    """

    corners_px: _Corners
    std_px: Float[np.ndarray, " markers"]


def refine_corners(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    white: Bool[np.ndarray, "markers cells cells"],
    lens: Camera | None = None,
) -> RefinedCorners:
    """Refine corners of markers to the intersections of lines that are fitted to their edges.

    Args:
        gray: (height, width), an image of markers.
        corners_px: (markers, 4, 2), clockwise from each marker's own top left, known to a few pixels.
        white: (markers, cells, cells), which cells of each marker are white. The cells of the border are all black, or
            all white in an inverted print.
        lens: lens whose distortion bends the edges; None for straight edges.

    Returns:
        The refined corners. A corner whose edges are not found stays as it was.
    """
    if not len(corners_px):
        return RefinedCorners(corners_px, np.zeros(0))
    cell_px = _widths_px(corners_px) / white.shape[1]
    reach_px = np.maximum(_REACH * cell_px, _LEAST_REACH_PX)
    largest_move_px = _LARGEST_MOVE * reach_px.max(axis=1)
    outside = np.where(white[:, 0, 0], -1.0, 1.0)
    refined_px = corners_px

    def limited(fitted_px: _Corners) -> _Corners:
        """Fitted corners; those before the fit where a fitted corner is too far from the first position."""
        near = np.linalg.norm(fitted_px - corners_px, axis=-1) <= largest_move_px[:, None]
        return np.where(near[..., None], fitted_px, refined_px)

    for _ in range(_GREY_PASSES):
        edges = _measure_edges(gray, refined_px, reach_px, outside, lens)
        *lines, bow_px = fit_lines(edges.points, edges.height)
        refined_px = limited(distort_pixels(intersections(*lines), lens))
        wide_px = np.maximum(_SPREADS * edges.spread_px, edges.spread_px + _BOWS * bow_px)
        reach_px = np.clip(wide_px, _LEAST_REACH_PX, reach_px)
    gamma = estimate_gamma(gray, refined_px, reach_px, white, lens)
    # A wide margin, because a lens bends edges outwards.
    light = linearise(gray, gamma, refined_px, largest_move_px + cell_px.max(axis=1) + _LEAST_REACH_PX)
    edges = _measure_edges(light, refined_px, reach_px, outside, lens)
    middle, direction, _ = fit_lines(edges.points, edges.height)
    refined_px = limited(distort_pixels(intersections(middle, direction), lens))
    edges = _measure_edges(light, refined_px, reach_px, outside, lens)
    fitted = fit_curves(edges.points, edges.height, edges.spread_px)
    fitted_px = distort_pixels(fitted.corners, lens)
    refined_px = limited(fitted_px)
    # A corner that the fit does not place is as good as the search.
    lost_px = np.minimum(np.linalg.norm(fitted_px - refined_px, axis=-1), largest_move_px[:, None])
    parts_px = (
        np.minimum(fitted.std, largest_move_px),
        np.sqrt((lost_px**2).mean(axis=1) / 2),
        _BLUR_STD * edges.spread_px.max(axis=1),
        _NEIGHBOURS_STD * (edges.spread_px**2 / cell_px).max(axis=1),
        np.full(len(corners_px), _LEAST_STD_PX),
    )
    return RefinedCorners(refined_px, np.linalg.norm(parts_px, axis=0))


def _widths_px(corners_px: _Corners) -> _Sides:
    """Width of a marker across each of its edges: the mean length of the two neighbouring edges."""
    sides_px = np.linalg.norm(corners_px[:, NEXT] - corners_px, axis=-1)
    return (sides_px[:, BEFORE] + sides_px[:, NEXT]) / 2


@dataclass(frozen=True)
class _Edges:
    """Measured edges of markers.

    Attributes:
        points: (markers, 4, points, 2), middles of the transitions, as a lens without distortion shows them, pixels.
        height: (markers, 4, points), difference of levels across the transition; 0 where there is none.
        spread_px: (markers, 4), spread of each side's transitions, pixels.
    """

    points: _Points
    height: Float[np.ndarray, "markers 4 points"]
    spread_px: _Sides


def _measure_edges(
    levels: Levels,
    corners_px: _Corners,
    reach_px: _Sides,
    outside: Float[np.ndarray, " markers"],
    lens: Camera | None,
) -> _Edges:
    """Find the edges along the sides of quadrangles; `outside` is 1 where the outside is lighter, -1 where darker."""
    sides = corners_px[:, NEXT] - corners_px
    ahead = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-9)
    # Outward for a clockwise outline, with y down.
    outward = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1) * outside[:, None, None]
    places_px = corners_px[:, :, None] + _ALONG[:, None] * sides[:, :, None]
    steps_px = np.broadcast_to((reach_px[..., None] * outward)[:, :, None], places_px.shape)
    transitions = find_transitions(
        levels, places_px.reshape(-1, len(_ALONG), 2), steps_px.reshape(-1, len(_ALONG), 2)
    )
    offset, spread, height = (
        each.reshape(places_px.shape[:-1])
        for each in (transitions.offset, transitions.spread, transitions.height)
    )
    points = undistort_pixels(places_px + offset[..., None] * steps_px, lens)
    # Beside a marker at the border of what the lens shows, some points have no place without distortion.
    is_shown = np.isfinite(points).all(axis=-1)
    return _Edges(
        np.where(is_shown[..., None], points, 0.0),
        np.where(is_shown, height, 0.0),
        median_of_rows(spread) * reach_px,
    )
