"""Gamma of an image: the power of its grey levels in which neighbouring black and white blend in proportion.

A camera blends light and encodes it by a power of about 1/2.2. Scaling and compression of a video, and most renderers,
blend grey levels (power 1). Clipped white acts like a power higher than any camera's. In a wrong power all white areas
look too wide, by as much as all black areas look too narrow. The cells of a marker all have the same width, so that
markers show which power is right.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from psotrack.foreground.markers.edges import find_transitions
from psotrack.foreground.markers.patterns import to_pixels

#: Powers in which the widths of cells are measured: grey levels, and about what cameras encode by. Results for other
#: powers lie on the line through these two.
_GREY, _LIGHT = 1.0, 2.2
#: Smallest and largest power that is returned. Overexposed white comes out at 5.
_LEAST_GAMMA, _LARGEST_GAMMA = 0.7, 8.0
#: Number of markers, the largest ones, that are measured: more take time and do not change the result.
_MEASURED_MARKERS = 12
#: Largest distance from an edge between two cells, in cells, at which its transition is searched: the other half of
#: a cell belongs to the next edge.
_HALF_CELL = 0.5


def linearise(gray: UInt8[np.ndarray, "height width"], gamma: float) -> UInt16[np.ndarray, "height width"]:
    """Grey levels to the power of gamma, scaled to 16 bits: in 8 bits the dark levels would all become equal."""
    table = np.round(65535 * (np.arange(256) / 255) ** gamma).astype(np.uint16)
    return np.asarray(cv2.LUT(gray, table), np.uint16)


def estimate_gamma(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    reach_px: Float[np.ndarray, "markers 4"],
    white: Bool[np.ndarray, "markers cells cells"],
) -> float:
    """Estimate the power of grey levels in which the black and the white cells of markers have equal widths.

    Each marker gives one estimate across its width and one across its height. The result is their median, weighted by
    how much the cells' widths depend on the power.

    Args:
        gray: (height, width).
        corners_px: (markers, 4, 2), clockwise from each marker's own top left, on its edges in grey levels.
        reach_px: (markers, 4), distance to both sides of each edge within which its transition lies.
        white: (markers, cells, cells), which cells of each marker are white; the first one has the border's colour.

    Returns:
        The power, 0.7 to 8; the usual power of cameras, 2.2, if there is no edge.
    """
    # The diagonal is a good enough measure of size.
    largest = np.argsort(-np.linalg.norm(corners_px[:, 2] - corners_px[:, 0], axis=-1))[:_MEASURED_MARKERS]
    corners_px, reach_px, white = corners_px[largest], reach_px[largest], white[largest]
    cells = white.shape[1]
    lines, middles = np.arange(cells + 1) / cells, (np.arange(cells) + 0.5) / cells
    # (axis, line, cell, 2): places on the lines between columns of cells, then between rows.
    upright = np.stack(np.broadcast_arrays(lines[:, None], middles), axis=-1)
    grid = np.stack([upright, upright[..., ::-1]])
    half = np.eye(2)[:, None, None] / (2 * cells)
    at = np.stack([grid, grid - half, grid + half])
    places_px, before_px, after_px = np.moveaxis(
        to_pixels(corners_px, at.reshape(-1, 2)).reshape(-1, *at.shape), 1, 0
    )
    cell_px = np.maximum(np.linalg.norm(after_px - before_px, axis=-1, keepdims=True), 1e-9)
    # Around the border lies the other colour; 1 where white lies to the right or below, -1 to the left or above.
    around = np.pad(white ^ white[:, :1, :1], ((0, 0), (1, 1), (1, 1)), constant_values=True)
    around = (around ^ white[:, :1, :1]).astype(np.float64)
    across, down = np.diff(around[:, 1:-1], axis=2).swapaxes(1, 2), np.diff(around[:, :, 1:-1], axis=1)
    sign = np.stack([across, down], axis=1)
    # Steps to the right cross the left and the right edge of a marker, which are the odd ones of the four.
    across_px = np.stack([reach_px[:, 1::2].max(axis=1), reach_px[:, ::2].max(axis=1)], axis=1)
    longest_px = np.minimum(across_px[:, :, None, None, None], _HALF_CELL * cell_px)
    steps_px = longest_px * sign[..., None] * (after_px - before_px) / cell_px
    in_grey, in_light = (
        _white_gain_px(levels, places_px, steps_px, sign).ravel()
        for levels in (gray, linearise(gray, _LIGHT))
    )
    sensitivity = in_grey - in_light
    weight = np.abs(sensitivity)
    if not weight.any():
        return _LIGHT
    fraction = in_grey / np.where(weight > 0, sensitivity, 1.0)
    order = np.argsort(fraction)
    total = np.cumsum(weight[order])
    median = fraction[order[np.searchsorted(total, total[-1] / 2)]]
    return float(np.clip(_GREY + (_LIGHT - _GREY) * median, _LEAST_GAMMA, _LARGEST_GAMMA))


def _white_gain_px(
    levels: UInt8[np.ndarray, "height width"] | UInt16[np.ndarray, "height width"],
    places_px: Float[np.ndarray, "markers 2 lines cells 2"],
    steps_px: Float[np.ndarray, "markers 2 lines cells 2"],
    sign: Float[np.ndarray, "markers 2 lines cells"],
) -> Float[np.ndarray, "markers 2"]:
    """How far edges are displaced towards black, in pixels, across the width and the height of each marker.

    A least-squares fit of the displacement by a + b line + c sign: errors of the corners go into a and b.
    """
    flat = (-1, sign.shape[3], 2)
    found = find_transitions(levels, places_px.reshape(flat), steps_px.reshape(flat))
    offset_px = found.offset.reshape(sign.shape) * np.linalg.norm(steps_px, axis=-1) * sign
    measured = (found.height.reshape(sign.shape) > 0).astype(np.float64)
    line = np.broadcast_to(np.linspace(-1.0, 1.0, sign.shape[2])[:, None], sign.shape)
    terms = np.stack([np.ones_like(sign), line, sign], axis=-1)
    # The small diagonal gives 0 for a term that a marker does not determine.
    normal = np.einsum("malci,malcj->maij", terms * measured[..., None], terms) + 1e-6 * np.eye(3)
    right = np.einsum("malci,malc->mai", terms * measured[..., None], offset_px)
    return -np.linalg.solve(normal, right[..., None])[..., 2, 0]
