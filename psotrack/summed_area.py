"""Summed-area tables (Crow 1984): the sum of an image over any box from four corners.

A table has one row and one column of zeros in front, and boxes are half-open: `table[y, x]` is the sum of the image
over rows below y and columns below x. Pixel (column i, row j) covers [i, i + 1) x [j, j + 1), so corners may be
fractional: reading the table bilinearly gives exactly the area-weighted sum over the fractional box, because the
integral of a piecewise constant image is piecewise bilinear.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, Integer

from psotrack._typing import Array


def summed_area_table(
    images: Integer[Array, "cameras height width"],
) -> Int[Array, "height1 cameras width1"]:
    """Tables of the images of several cameras, of whole numbers, exact.

    Args:
        images: (cameras, height, width), non-negative whole numbers whose sum is below 2^31 (a 4K image of 0..255 is).

    Returns:
        (height + 1, cameras, width + 1), int32: row by row, and in a row camera by camera, which is the order in which
        the sums are made, so that nothing is copied afterwards.

    Example:
        >>> summed_area_table(jnp.array([[[1, 2], [3, 4]]]))[:, 0].tolist()
        [[0, 0, 0], [0, 1, 3], [0, 4, 10]]
    """
    along_rows = _running_sum(images.transpose(2, 1, 0)).transpose(1, 2, 0)
    return _running_sum(jnp.pad(along_rows, [(1, 0), (0, 0), (1, 0)]))


def _running_sum(lines: Integer[Array, "lines *line"]) -> Int[Array, "lines *line"]:
    """`jnp.cumsum` over the leading axis: compiled to additions of whole lines, several times faster on a CPU."""

    def add(total: jax.Array, line: Any) -> tuple[jax.Array, jax.Array]:
        total = total + line.astype(jnp.int32)
        return total, total

    return jax.lax.scan(add, jnp.zeros(lines.shape[1:], jnp.int32), lines)[1]


def box_sum(
    tables: Int[Array, "height1 cameras width1"],
    camera: Int[Array, "*#boxes"],
    x0: Float[Array, "sets *#boxes"],
    y0: Float[Array, "sets *#boxes"],
    x1: Float[Array, "sets *#boxes"],
    y1: Float[Array, "sets *#boxes"],
) -> Float[Array, "sets *boxes"]:
    """Sums over sets of fractional boxes, each box in the table of its camera.

    Boxes are cut at the image's border; one that lies outside, or whose ends are in the wrong order, has sum 0.
    Differentiable in the corners (almost everywhere).

    Args:
        tables: (height + 1, cameras, width + 1), from `summed_area_table`.
        camera: which table each box of a set reads.
        x0, y0, x1, y1: (sets, ...), edges in pixels of the image, half-open.

    Returns:
        (sets, ...), float32, in units of the image times pixels.
    """
    height1, num_cameras, width1 = tables.shape
    flat, row = jnp.reshape(tables, -1), num_cameras * width1

    def split(edge: Array, last: int) -> tuple[Array, Array]:
        # The cell below the edge and how far the edge reaches into it; at the far border the last cell, full.
        edge = jnp.clip(edge, 0, last)
        cell = jnp.minimum(edge.astype(jnp.int32), last - 1)
        return cell, edge - cell.astype(edge.dtype)

    (i0, fx0), (i1, fx1) = split(x0, width1 - 1), split(jnp.maximum(x0, x1), width1 - 1)
    (j0, fy0), (j1, fy1) = split(y0, height1 - 1), split(jnp.maximum(y0, y1), height1 - 1)
    row0, row1 = camera * width1 + j0 * row, camera * width1 + j1 * row

    def read(index: Array) -> Array:
        # Indices are in bounds by construction; saying so spares a check in the innermost loop of the tracker.
        return flat.at[index].get(mode="promise_in_bounds")

    def corner(index: Array, fx: Array, fy: Array) -> tuple[Array, Array]:
        # The table at the cell's corner, and what bilinear reading adds to it. Whole numbers are differenced before
        # anything becomes float32, because the sums of a 1080p image exceed 2^24.
        here, right, below, across = (read(index + step) for step in (0, 1, row, row + 1))
        to_right, to_below, to_across = (
            step.astype(fx.dtype) for step in (right - here, below - here, across - below - right + here)
        )
        return here, fx * to_right + fy * to_below + (fx * fy) * to_across

    def one_set(edges: tuple[Array, ...]) -> Array:
        index00, index10, index01, index11, fx0, fx1, fy0, fy1 = edges
        (c00, f00), (c10, f10) = corner(index00, fx0, fy0), corner(index10, fx1, fy0)
        (c01, f01), (c11, f11) = corner(index01, fx0, fy1), corner(index11, fx1, fy1)
        whole = (c11 - c01) - (c10 - c00)
        return whole.astype(f00.dtype) + ((f11 - f01) - (f10 - f00))

    # Set by set: within one expression XLA on CPU computes all indices anew for each of the sixteen reads.
    return jax.lax.map(one_set, (row0 + i0, row0 + i1, row1 + i0, row1 + i1, fx0, fx1, fy0, fy1))
