"""Corners of markers, as the intersections of straight lines through their edges.

The position of an edge is the middle of the transition from black to white across the edge, in levels that blend in
proportion (see `gamma`). A blur of the lens or of motion that is equal on both sides moves no edge, but it rounds
corners off: OpenCV's refinement, which looks at the corners themselves, makes markers too small.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.geometry import Camera
from psotrack.inside_out.detection.distortion import distort_pixels, undistort_pixels
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
#: Number of passes over the edges in grey levels, with ever smaller reach, and then in linear light.
_GREY_PASSES, _LIGHT_PASSES = 2, 2
#: Points along an edge at which it is measured, in shares of its length. Near a corner the blur mixes two edges.
_ALONG = np.linspace(0.15, 0.85, 16)
#: Number of times a line is fitted again with lower weights for points off the line, such as where a drone hides
#: the edge.
_REWEIGHTINGS = 2
#: Distance from a line, in pixels, below which a point keeps most of its weight.
_INLIER_PX = 0.1
#: Largest distance that a corner may move, in units of the first search distance.
_LARGEST_MOVE = 2.0


def refine_corners(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    white: Bool[np.ndarray, "markers cells cells"],
    lens: Camera | None = None,
) -> Float[np.ndarray, "markers 4 2"]:
    """Refine corners of markers to the intersections of lines that are fitted to their edges.

    Args:
        gray: (height, width), an image of black markers on white.
        corners_px: (markers, 4, 2), clockwise from each marker's own top left, known to a few pixels.
        white: (markers, cells, cells), which cells of each marker are white; border cells are black.
        lens: lens whose distortion bends the edges; None for straight edges.

    Returns:
        (markers, 4, 2), refined corners, pixels. A corner whose edges are not found stays as it was.
    """
    if not len(corners_px):
        return corners_px
    reach_px = np.maximum(_REACH * _widths_px(corners_px) / white.shape[1], _LEAST_REACH_PX)
    largest_move_px = _LARGEST_MOVE * reach_px.max(axis=1)
    refined_px = corners_px
    for _ in range(_GREY_PASSES):
        fitted_px, spread_px = _fit_corners(gray, refined_px, reach_px, lens)
        refined_px = _limit_moves(fitted_px, corners_px, refined_px, largest_move_px)
        reach_px = np.clip(_SPREADS * spread_px, _LEAST_REACH_PX, reach_px)
    light = linearise(gray, estimate_gamma(gray, refined_px, reach_px, white, lens))
    for _ in range(_LIGHT_PASSES):
        fitted_px, _ = _fit_corners(light, refined_px, reach_px, lens)
        refined_px = _limit_moves(fitted_px, corners_px, refined_px, largest_move_px)
    return refined_px


def _widths_px(corners_px: _Corners) -> _Sides:
    """Width of a marker across each of its edges: the mean length of the two neighbouring edges."""
    sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=1) - corners_px, axis=-1)
    return (np.roll(sides_px, 1, axis=1) + np.roll(sides_px, -1, axis=1)) / 2


def _limit_moves(
    fitted_px: _Corners,
    first_px: _Corners,
    before_px: _Corners,
    largest_move_px: Float[np.ndarray, " markers"],
) -> _Corners:
    """Fitted corners; those before the fit where a fitted corner is too far from the first position."""
    near = np.linalg.norm(fitted_px - first_px, axis=-1) <= largest_move_px[:, None]
    return np.where(near[..., None], fitted_px, before_px)


def _fit_corners(
    levels: Levels, corners_px: _Corners, reach_px: _Sides, lens: Camera | None
) -> tuple[_Corners, _Sides]:
    """Intersections of lines that are fitted to the sides of quadrangles, and the spread of each side, pixels."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    ahead = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-9)
    # Outward for a clockwise outline, with y down.
    outward = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
    places_px = corners_px[:, :, None] + _ALONG[:, None] * sides[:, :, None]
    steps_px = np.broadcast_to((reach_px[..., None] * outward)[:, :, None], places_px.shape)
    transitions = find_transitions(
        levels, places_px.reshape(-1, len(_ALONG), 2), steps_px.reshape(-1, len(_ALONG), 2)
    )
    offset, spread, height = (
        each.reshape(places_px.shape[:-1])
        for each in (transitions.offset, transitions.spread, transitions.height)
    )
    points_px = places_px + offset[..., None] * steps_px
    points = undistort_pixels(points_px, lens)
    # Beside a marker at the border of what the lens shows, some points have no place without distortion.
    is_shown = np.isfinite(points).all(axis=-1)
    lines = _fit_lines(np.where(is_shown[..., None], points, 0.0), np.where(is_shown, height, 0.0))
    return distort_pixels(_intersections(*lines), lens), np.median(spread, axis=-1) * reach_px


def _fit_lines(
    points: _Points, weight: Float[np.ndarray, "markers 4 points"]
) -> tuple[Float[np.ndarray, "markers 4 2"], Float[np.ndarray, "markers 4 2"]]:
    """A point on each line and the line's direction, by least squares of distances with lower weights for outliers."""
    weighted = weight
    for _ in range(1 + _REWEIGHTINGS):
        total = np.maximum(weighted.sum(axis=-1), 1e-9)[..., None]
        middle = (weighted[..., None] * points).sum(axis=2) / total
        apart = points - middle[:, :, None]
        xx, yy, xy = (
            (weighted * apart[..., i] * apart[..., j]).sum(axis=-1) for i, j in ((0, 0), (1, 1), (0, 1))
        )
        angle = np.arctan2(2 * xy, xx - yy) / 2
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        distance = np.abs(apart[..., 0] * direction[..., None, 1] - apart[..., 1] * direction[..., None, 0])
        typical = np.maximum(1.5 * np.median(distance, axis=-1, keepdims=True), _INLIER_PX)
        weighted = weight / (1 + (distance / typical) ** 2)
    return middle, direction


def _intersections(
    on: Float[np.ndarray, "markers 4 2"], direction: Float[np.ndarray, "markers 4 2"]
) -> Float[np.ndarray, "markers 4 2"]:
    """Intersection of each line with the line before it; far away where the two are parallel."""
    before, ahead = np.roll(on, 1, axis=1), np.roll(direction, 1, axis=1)
    apart = on - before
    cross = ahead[..., 0] * direction[..., 1] - ahead[..., 1] * direction[..., 0]
    along = apart[..., 0] * direction[..., 1] - apart[..., 1] * direction[..., 0]
    return before + (along / np.where(np.abs(cross) < 1e-9, 1e-9, cross))[..., None] * ahead
