"""In which power of the grey levels an image blends: in light, in grey, or in between.

A camera blends light, and encodes it by a power of about 1/2.2; what scales or compresses a video blends grey levels,
as do most renderers; and white that is clipped is like a power higher than any camera's. In the wrong power, all that
is white looks too wide by as much as all that is black looks too narrow. Markers tell: their cells are all as wide.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from psotrack.geometry import Camera
from psotrack.inside_out.detection.bending import bent, straight
from psotrack.inside_out.detection.rises import Levels, rises

_Grid = Float[np.ndarray, "markers 2 lines cells 2"]

#: The powers that cells are measured in, grey and about what cameras encode by; the others are a line through the two.
_GREY, _LIGHT = 1.0, 2.2
#: Powers that are believed. Overexposed white comes out at 5.
_LEAST, _MOST = 0.7, 8.0
#: Markers that are asked, the largest ones: more take time, and say nothing new.
_ASKED = 12
#: Of a cell, that an edge between two is looked for in at most, to both sides: half is the next edge's.
_HALF_CELL = 0.5


def light_of(gray: UInt8[np.ndarray, "height width"], exponent: float) -> UInt16[np.ndarray, "height width"]:
    """A power of grey levels. In 8 bits the dark ones would be all the same."""
    return np.asarray(cv2.LUT(gray, np.round(65535 * (np.arange(256) / 255) ** exponent).astype(np.uint16)))


def blending_exponent(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    reach_px: Float[np.ndarray, "markers 4"],
    white: Bool[np.ndarray, "markers cells cells"],
    lens: Camera | None,
) -> float:
    """The power of grey levels in which the black and the white cells of markers are as wide as one another.

    Both ways across each marker say so; what most say, by how much it would matter to them, is true.

    Args:
        gray: (height, width).
        corners_px: (markers, 4, 2), clockwise from each marker's own top left, on its edges in grey levels.
        reach_px: (markers, 4), to both sides of an edge that holds its rise.
        white: (markers, cells, cells), which cells of each are white.
        lens: whose distortion bends the edges; None for straight ones.

    Returns:
        0.7 to 8; that of cameras if there is no edge.
    """
    # A diagonal is as good a size as any.
    size_px = np.linalg.norm(corners_px[:, 2] - corners_px[:, 0], axis=-1)
    asked = np.argsort(-size_px)[:_ASKED]
    places_px, steps_px, sign = _edges(corners_px[asked], reach_px[asked], white[asked], lens)
    in_grey, in_light = (
        _widening(levels, places_px, steps_px, sign).ravel() for levels in (gray, light_of(gray, _LIGHT))
    )
    matters = in_grey - in_light
    count = np.abs(matters)
    if not count.any():
        return _LIGHT
    share = in_grey / np.where(count > 0, matters, 1.0)
    order = np.argsort(share)
    total = np.cumsum(count[order])
    median = share[order[np.searchsorted(total, total[-1] / 2)]]
    return float(np.clip(_GREY + (_LIGHT - _GREY) * median, _LEAST, _MOST))


def _edges(
    corners_px: Float[np.ndarray, "markers 4 2"],
    reach_px: Float[np.ndarray, "markers 4"],
    white: Bool[np.ndarray, "markers cells cells"],
    lens: Camera | None,
) -> tuple[_Grid, _Grid, Float[np.ndarray, "markers 2 lines cells"]]:
    """Middles of the lines between cells, to the right and down; the way to the white side, and its sign.

    A line between two cells of one colour has neither.
    """
    cells = white.shape[1]
    lines = np.arange(cells + 1) / cells
    middles = (np.arange(cells) + 0.5) / cells
    upright = np.stack(np.broadcast_arrays(lines[:, None], middles), axis=-1)
    grid = np.stack([upright, upright[..., ::-1]])
    half = np.array([[0.5, 0.0], [0.0, 0.5]])[:, None, None] / cells
    to_image = _homographies(straight(corners_px, lens))
    places_px, before_px, after_px = (
        bent(_mapped(to_image, at), lens) for at in (grid, grid - half, grid + half)
    )
    cell_px = np.linalg.norm(after_px - before_px, axis=-1, keepdims=True)
    ahead = (after_px - before_px) / np.maximum(cell_px, 1e-9)
    # What is to the right is crossed on the edges to the right and left, of four from the top on.
    across_px = np.stack([reach_px[:, 1::2].max(axis=1), reach_px[:, ::2].max(axis=1)], axis=1)
    around = np.pad(white, ((0, 0), (1, 1), (1, 1)), constant_values=True).astype(np.float64)
    sign = np.stack(
        [np.diff(around[:, 1:-1], axis=2).swapaxes(1, 2), np.diff(around[:, :, 1:-1], axis=1)], axis=1
    )
    steps_px = np.minimum(across_px[:, :, None, None, None], _HALF_CELL * cell_px) * sign[..., None] * ahead
    return places_px, steps_px, sign


def _widening(
    levels: Levels, places_px: _Grid, steps_px: _Grid, sign: Float[np.ndarray, "markers 2 lines cells"]
) -> Float[np.ndarray, "markers 2"]:
    """How far edges are off towards black, in pixels, both ways across each marker.

    Where a line is off is a + b line + c sign by least squares: that corners are off is in a and b.
    """
    flat = (-1, places_px.shape[3], 2)
    seen = rises(levels, places_px.reshape(flat), steps_px.reshape(flat))
    off_px = seen.off.reshape(sign.shape) * np.linalg.norm(steps_px, axis=-1) * sign
    counts = (seen.weight.reshape(sign.shape) > 0).astype(np.float64)
    line = np.broadcast_to(np.linspace(-1.0, 1.0, sign.shape[2])[:, None], sign.shape)
    terms = np.stack([np.ones_like(sign), line, sign], axis=-1).reshape(*sign.shape[:2], -1, 3)
    weighted = terms * counts.reshape(*terms.shape[:-1], 1)
    # What a marker does not tell is 0.
    normal = np.einsum("mapi,mapj->maij", weighted, terms) + 1e-6 * np.eye(3)
    right = np.einsum("mapi,map->mai", weighted, off_px.reshape(terms.shape[:-1]))
    return -np.linalg.solve(normal, right[..., None])[..., 2, 0]


def _homographies(corners_px: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 3 3"]:
    """From the unit square to each quadrangle."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return np.stack([cv2.getPerspectiveTransform(square, each) for each in corners_px.astype(np.float32)])


def _mapped(to_image: Float[np.ndarray, "markers 3 3"], at: Float[np.ndarray, "2 lines cells 2"]) -> _Grid:
    there = np.einsum("mij,alpj->malpi", to_image[..., :2], at) + to_image[:, None, None, None, :, 2]
    return there[..., :2] / there[..., 2:]
