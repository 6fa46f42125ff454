"""Corners of markers, as the intersections of lines through their edges.

The position of an edge is the middle of the transition from black to white across the edge, in levels that blend in
proportion (see `gamma`). A blur of the lens or of motion that is equal on both sides moves no edge, but it rounds
corners off: OpenCV's refinement, which looks at the corners themselves, makes markers too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.foreground.markers.edges import BEFORE, NEXT, find_transitions, fit_corners, median_of_rows
from psotrack.foreground.markers.gamma import estimate_gamma, linearise
from psotrack.geometry import Camera, distort, undistort

_Corners = Float[np.ndarray, "markers 4 2"]

#: Distance to both sides of an edge within which its transition is searched first, in cells; and the least
#: value of this distance, in pixels.
_REACH, _LEAST_REACH_PX = 0.7, 2.0
#: The same distance in later passes, in standard deviations of the transition: wide enough for all of a blur, narrow
#: enough to leave out noise. The part of it that is for a bent edge, in medians of the points' distances from a line.
_SPREADS, _BOWS = 3.0, 2.5
#: Number of passes over the edges in grey levels, with ever smaller reach, and in linear light after them.
_GREY_PASSES, _LIGHT_PASSES = 2, 2
#: Factor of the smallest bend that counts, before the last pass: the edges of the first corners are inexact, and what
#: blur mixes into them looks like a bend.
_EARLY_BEND = 4.0
#: Points along an edge at which it is measured, as fractions of its length. Near a corner the blur mixes two edges.
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
        lens: lens whose distortion bends the edges; None for straight edges, or edges that are slightly bent.

    Returns:
        The refined corners. A corner whose edges are not found stays as it was.
    """
    if not len(corners_px):
        return RefinedCorners(corners_px, np.zeros(0))
    sides_px = np.linalg.norm(corners_px[:, NEXT] - corners_px, axis=-1)
    cell_px = (sides_px[:, BEFORE] + sides_px[:, NEXT]) / 2 / white.shape[1]
    reach_px = np.maximum(_REACH * cell_px, _LEAST_REACH_PX)
    largest_move_px = _LARGEST_MOVE * reach_px.max(axis=1)
    lighter_outside = np.where(white[:, 0, 0], -1.0, 1.0)[:, None, None]
    refined_px, levels = corners_px, gray
    for number in range(_GREY_PASSES + _LIGHT_PASSES):
        if number == _GREY_PASSES:
            levels = linearise(gray, estimate_gamma(gray, refined_px, reach_px, white))
        sides = refined_px[:, NEXT] - refined_px
        ahead = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-9)
        # Outward for a clockwise outline, with y down.
        towards_white = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1) * lighter_outside
        places_px = refined_px[:, :, None] + _ALONG[:, None] * sides[:, :, None]
        steps_px = np.broadcast_to((reach_px[..., None] * towards_white)[:, :, None], places_px.shape)
        found = find_transitions(
            levels, places_px.reshape(-1, len(_ALONG), 2), steps_px.reshape(-1, len(_ALONG), 2)
        )
        offset, spread, height = (
            each.reshape(places_px.shape[:-1]) for each in (found.offset, found.spread, found.height)
        )
        spread_px = median_of_rows(spread) * reach_px
        points_px = undistort_pixels(places_px + offset[..., None] * steps_px, lens)
        # Beside a marker at the border of what the lens shows, some points have no place without distortion.
        shown = np.isfinite(points_px).all(axis=-1)
        fitted = fit_corners(
            undistort_pixels(refined_px, lens),
            np.where(shown[..., None], points_px, 0.0),
            np.where(shown, height, 0.0),
            spread_px,
            least_bend=1.0 if number == _GREY_PASSES + _LIGHT_PASSES - 1 else _EARLY_BEND,
        )
        fitted_px = distort_pixels(fitted.corners_px, lens)
        near = np.linalg.norm(fitted_px - corners_px, axis=-1) <= largest_move_px[:, None]
        refined_px = np.where(near[..., None], fitted_px, refined_px)
        if number < _GREY_PASSES:
            wide_px = np.maximum(_SPREADS * spread_px, spread_px + _BOWS * fitted.scatter_px)
            reach_px = np.clip(wide_px, _LEAST_REACH_PX, reach_px)
    # A corner that the fit does not place is as good as the search.
    lost_px = np.minimum(np.linalg.norm(fitted_px - refined_px, axis=-1), largest_move_px[:, None])
    parts_px = (
        np.minimum(fitted.std_px, largest_move_px),
        np.sqrt((lost_px**2).mean(axis=1) / 2),
        _BLUR_STD * spread_px.max(axis=1),
        _NEIGHBOURS_STD * (spread_px**2 / cell_px).max(axis=1),
        np.full(len(corners_px), _LEAST_STD_PX),
    )
    return RefinedCorners(refined_px, np.linalg.norm(parts_px, axis=0))


def undistort_pixels(
    points_px: Float[np.ndarray, "*points 2"], lens: Camera | None
) -> Float[np.ndarray, "*points 2"]:
    """Pixels at which a lens without distortion shows the same points; NaN where the lens model shows nothing."""
    if lens is None:
        return points_px
    return undistort(lens, points_px) @ lens.K[:2, :2].T + lens.K[:2, 2]


def distort_pixels(
    points_px: Float[np.ndarray, "*points 2"], lens: Camera | None
) -> Float[np.ndarray, "*points 2"]:
    """Inverse of `undistort_pixels`: pixels at which the lens shows undistorted points."""
    if lens is None:
        return points_px
    rays = (points_px - lens.K[:2, 2]) @ np.linalg.inv(lens.K[:2, :2]).T
    return np.stack(distort(lens, rays[..., 0], rays[..., 1]), axis=-1) @ lens.K[:2, :2].T + lens.K[:2, 2]
