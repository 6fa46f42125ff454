"""Corners of markers: where straight lines through their edges meet.

An edge is the middle of the rise from black to white across it, in levels that blend in proportion (`blending`). A
blur, of a lens or of motion, that is the same on both sides moves no edge there, but it rounds corners off: those of
OpenCV, which looks at the corners themselves, make markers too small.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.geometry import Camera
from psotrack.inside_out.detection.bending import bent, straight
from psotrack.inside_out.detection.blending import blending_exponent, light_of
from psotrack.inside_out.detection.rises import Levels, rises

_Points = Float[np.ndarray, "markers 4 points 2"]
_Corners = Float[np.ndarray, "markers 4 2"]
_Sides = Float[np.ndarray, "markers 4"]

#: Of a cell, to both sides of an edge, that the rise is looked for in at first; and the least, in pixels.
_REACH, _LEAST_REACH_PX = 0.7, 2.0
#: Standard deviations of a rise that it is looked for in later: all of a blur, and no more noise than that.
_SPREADS = 3.0
#: Passes over the edges in grey levels, which look ever closer, and then in light.
_GREY_PASSES, _LIGHT_PASSES = 2, 2
#: Places along an edge where it is looked for, in shares of its length; near the corners two edges are one blur.
_ALONG = np.linspace(0.15, 0.85, 16)
#: Times a line is fitted anew with less weight for what is off it, such as where a drone hides the edge.
_REWEIGHTINGS = 2
#: What is off a line by less, in pixels, is not doubted.
_SURE_PX = 0.1
#: First reaches that a corner may move by.
_FARTHEST = 2.0


def refined_corners(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    white: Bool[np.ndarray, "markers cells cells"],
    lens: Camera | None = None,
) -> Float[np.ndarray, "markers 4 2"]:
    """Where the lines through the edges of markers meet.

    Args:
        gray: (height, width), black markers on white.
        corners_px: (markers, 4, 2), clockwise from each marker's own top left, right to some pixels.
        white: (markers, cells, cells), which cells of each are white; those of its border are not.
        lens: whose distortion bends the edges; None for straight ones.

    Returns:
        (markers, 4, 2). A corner whose edges cannot be found stays as it was.
    """
    if not len(corners_px):
        return corners_px
    reach_px = np.maximum(_REACH * _across_px(corners_px) / white.shape[1], _LEAST_REACH_PX)
    farthest_px = _FARTHEST * reach_px.max(axis=1)
    found_px = corners_px
    for _ in range(_GREY_PASSES):
        moved_px, spread_px = _fitted(gray, found_px, reach_px, lens)
        found_px = _near(moved_px, corners_px, found_px, farthest_px)
        reach_px = np.clip(_SPREADS * spread_px, _LEAST_REACH_PX, reach_px)
    light = light_of(gray, blending_exponent(gray, found_px, reach_px, white, lens))
    for _ in range(_LIGHT_PASSES):
        moved_px, _ = _fitted(light, found_px, reach_px, lens)
        found_px = _near(moved_px, corners_px, found_px, farthest_px)
    return found_px


def _across_px(corners_px: _Corners) -> _Sides:
    """How wide a marker is across each of its edges: as the two edges beside it say."""
    sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=1) - corners_px, axis=-1)
    return (np.roll(sides_px, 1, axis=1) + np.roll(sides_px, -1, axis=1)) / 2


def _near(
    moved_px: _Corners, start_px: _Corners, before_px: _Corners, farthest_px: Float[np.ndarray, " markers"]
) -> _Corners:
    """Corners that moved, except for those that went too far from the start."""
    near = np.linalg.norm(moved_px - start_px, axis=-1) <= farthest_px[:, None]
    return np.where(near[..., None], moved_px, before_px)


def _fitted(
    levels: Levels, corners_px: _Corners, reach_px: _Sides, lens: Camera | None
) -> tuple[_Corners, _Sides]:
    """Where the lines meet that are fitted about the sides of quadrangles, and how wide the rises are."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    ahead = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-9)
    # Of a clockwise outline, with y down.
    outward = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
    places_px = corners_px[:, :, None] + _ALONG[:, None] * sides[:, :, None]
    steps_px = np.broadcast_to((reach_px[..., None] * outward)[:, :, None], places_px.shape)
    seen = rises(levels, places_px.reshape(-1, len(_ALONG), 2), steps_px.reshape(-1, len(_ALONG), 2))
    off, spread, weight = (
        each.reshape(places_px.shape[:-1]) for each in (seen.off, seen.spread, seen.weight)
    )
    points_px = places_px + off[..., None] * steps_px
    return bent(_meeting(*_lines(straight(points_px, lens), weight)), lens), np.median(
        spread, axis=-1
    ) * reach_px


def _lines(
    points: _Points, weight: Float[np.ndarray, "markers 4 points"]
) -> tuple[Float[np.ndarray, "markers 4 2"], Float[np.ndarray, "markers 4 2"]]:
    """A point on each line and its direction, by least squares of the distances, those far off counting less."""
    counts = weight
    for _ in range(1 + _REWEIGHTINGS):
        total = np.maximum(counts.sum(axis=-1), 1e-9)[..., None]
        middle = (counts[..., None] * points).sum(axis=2) / total
        apart = points - middle[:, :, None]
        xx, yy, xy = (
            (counts * apart[..., i] * apart[..., j]).sum(axis=-1) for i, j in ((0, 0), (1, 1), (0, 1))
        )
        angle = np.arctan2(2 * xy, xx - yy) / 2
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        off = np.abs(apart[..., 0] * direction[..., None, 1] - apart[..., 1] * direction[..., None, 0])
        typical = np.maximum(1.5 * np.median(off, axis=-1, keepdims=True), _SURE_PX)
        counts = weight / (1 + (off / typical) ** 2)
    return middle, direction


def _meeting(
    on: Float[np.ndarray, "markers 4 2"], direction: Float[np.ndarray, "markers 4 2"]
) -> Float[np.ndarray, "markers 4 2"]:
    """Where each line meets the one before it; far away where they are parallel."""
    before, ahead = np.roll(on, 1, axis=1), np.roll(direction, 1, axis=1)
    apart = on - before
    cross = ahead[..., 0] * direction[..., 1] - ahead[..., 1] * direction[..., 0]
    along = apart[..., 0] * direction[..., 1] - apart[..., 1] * direction[..., 0]
    return before + (along / np.where(np.abs(cross) < 1e-9, 1e-9, cross))[..., None] * ahead
