"""Convex quadrangles in a binary image: what the outline of a marker looks like."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

#: Distances of a contour from its polygon, as shares of the contour's length. The second distance takes outlines whose
#: edges are bent or frayed.
_ACCURACIES = (0.03, 0.06)
#: Shortest side of a quadrangle, as a share of the contour's length.
_SHORTEST_SIDE = 0.05
#: Distance between the outermost centre of a pixel and the pixel's edge.
_HALF_PIXEL = 0.5


def find_quads(
    binary: UInt8[np.ndarray, "rows columns"], least_side_px: float
) -> Float[np.ndarray, "quads 4 2"]:
    """Quadrangles among the contours of a binary image, outer contours and contours of holes.

    Args:
        binary: (rows, columns), 0 and 255.
        least_side_px: mean length of a side below which a quadrangle is left out.

    Returns:
        (quads, 4, 2), corners on the edges of the pixels, clockwise with y down, pixels.
    """
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    long_enough = [each for each in contours if len(each) >= 4 * least_side_px]
    found = [(quad[:, 0], len(each)) for each in long_enough if (quad := _quad(each)) is not None]
    if not found:
        return np.zeros((0, 4, 2))
    quads = np.array([quad for quad, _ in found], np.float64)
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=-1)
    least = _SHORTEST_SIDE * np.array([length for _, length in found])
    return _to_pixel_edges(quads[sides.min(axis=1) >= least])


def _quad(contour: np.ndarray) -> np.ndarray | None:
    """Corners of a contour that is a convex quadrangle, (4, 1, 2); None of other contours."""
    for accuracy in _ACCURACIES:
        polygon = np.asarray(cv2.approxPolyDP(contour, accuracy * len(contour), True))
        if len(polygon) < 4:
            return None
        if len(polygon) == 4:
            return polygon if cv2.isContourConvex(polygon) else None
    return None


def _to_pixel_edges(quads: Float[np.ndarray, "quads 4 2"]) -> Float[np.ndarray, "quads 4 2"]:
    """Move sides from the centres of the contour's pixels to their edges, and order the corners clockwise.

    OpenCV runs around areas anticlockwise and around holes clockwise. The pixels of an outer contour lie inside of the
    area's edge; the pixels of a hole's contour lie outside of the hole's edge.
    """
    x, y = quads[..., 0], quads[..., 1]
    area = 0.5 * (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)
    is_hole = area > 0
    clockwise = np.where(is_hole[:, None, None], quads, quads[:, ::-1])
    sides = np.roll(clockwise, -1, axis=1) - clockwise
    ahead = sides / np.linalg.norm(sides, axis=-1, keepdims=True)
    outward = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
    before = np.roll(outward, 1, axis=1)
    # A corner moves along the sum of both normals so far that both sides move by half a pixel.
    move = (outward + before) / np.maximum(1 + (outward * before).sum(axis=-1, keepdims=True), 0.2)
    return clockwise + np.where(is_hole, -_HALF_PIXEL, _HALF_PIXEL)[:, None, None] * move
