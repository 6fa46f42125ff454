"""Summed-area tables (Crow 1984): the sum of an image over any box, read from four corners of the box.

A table has one row and one column of zeros in front, and boxes are half-open: `table[y, x]` is the sum of the image
over rows below y and columns below x. Pixel (column i, row j) covers [i, i + 1) x [j, j + 1), so corners may be
fractional: reading the table bilinearly gives exactly the area-weighted sum over the fractional box, because the
integral of a piecewise constant image is piecewise bilinear.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Integer, Num

from psotrack.support.array_types import Array

#: Number of bits of a packed sum that hold the first image's sum; the second image's sum has the rest of the 32 bits.
LOW_BITS = 20


def summed_area_table(
    images: Integer[Array, "cameras height width"],
) -> Int[Array, "height1 cameras width1"]:
    """Exact summed-area tables of the images of several cameras.

    Args:
        images: (cameras, height, width), non-negative whole numbers whose sum is below 2^31 (a 4K image of 0..255 is).

    Returns:
        (height + 1, cameras, width + 1), int32. This order of axes is the order in which the sums are computed, so the
        result is not copied.

    Example:
        >>> summed_area_table(jnp.array([[[1, 2], [3, 4]]]))[:, 0].tolist()
        [[0, 0, 0], [0, 1, 3], [0, 4, 10]]
    """
    along_rows = _running_sum(images.transpose(2, 1, 0)).transpose(1, 2, 0)
    return _running_sum(jnp.pad(along_rows, [(1, 0), (0, 0), (1, 0)]))


def _running_sum(lines: Integer[Array, "lines *line"]) -> Int[Array, "lines *line"]:
    """Cumulative sum over the leading axis. On a CPU it is several times faster than `jnp.cumsum`."""

    def add(total: jax.Array, line: Any) -> tuple[jax.Array, jax.Array]:
        total = total + line.astype(jnp.int32)
        return total, total

    return jax.lax.scan(add, jnp.zeros(lines.shape[1:], jnp.int32), lines)[1]


def pack(low: Integer[Array, "*image"], high: Bool[Array, "*image"]) -> Int[Array, "*image"]:
    """Pack two images into one, so that one table holds the sums of both, and one read gives both sums.

    Args:
        low: whole numbers whose sum over any box is below 2^`LOW_BITS` (as for 64 x 64 pixels of 0..255).
        high: mask with fewer than 2^(32 - `LOW_BITS`) true pixels in any box.
    """
    return low.astype(jnp.int32) + (high.astype(jnp.int32) << LOW_BITS)


def box_sum(
    tables: Int[Array, "height1 cameras width1"],
    camera: Int[Array, "*#boxes"],
    x0: Num[Array, "*#boxes"],
    y0: Num[Array, "*#boxes"],
    x1: Num[Array, "*#boxes"],
    y1: Num[Array, "*#boxes"],
) -> Float[Array, "*boxes"]:
    """Sums over fractional boxes, each box in the table of its camera.

    Boxes are clipped at the image's border. A box outside the image, or with edges in the wrong order, has sum 0.

    Boxes about the same middles in several sizes are faster one size at a time, in several calls: with an axis of
    sizes, XLA on a CPU computes all indices again for each of the sixteen reads.

    Args:
        tables: (height + 1, cameras, width + 1), from `summed_area_table`.
        camera: index of the table that each box reads.
        x0, y0, x1, y1: edges in pixels of the image, half-open; whole numbers take a quarter of the reads.

    Returns:
        Sums, float32, in units of the image times pixels.
    """
    (total,) = _box_sums(tables, camera, (x0, y0, x1, y1), lambda total: (total,))
    return total


def packed_box_sums(
    tables: Int[Array, "height1 cameras width1"],
    camera: Int[Array, "*#boxes"],
    x0: Num[Array, "*#boxes"],
    y0: Num[Array, "*#boxes"],
    x1: Num[Array, "*#boxes"],
    y1: Num[Array, "*#boxes"],
) -> tuple[Float[Array, "*boxes"], Float[Array, "*boxes"]]:
    """Sums of two images that are packed into one table; boxes as in `box_sum`.

    Args:
        tables, camera, x0, y0, x1, y1: as in `box_sum`; the tables are of images from `pack`.

    Returns:
        Sums of the first image, and sums of the second image.
    """
    low, high = _box_sums(tables, camera, (x0, y0, x1, y1), _unpacked)
    return low, high


def _unpacked(total: Array) -> tuple[Array, Array]:
    # A logical shift, because the highest bit belongs to the number and is no sign.
    return total & ((1 << LOW_BITS) - 1), jax.lax.shift_right_logical(total, jnp.int32(LOW_BITS))


def _box_sums(
    tables: Int[Array, "height1 cameras width1"],
    camera: Int[Array, "*#boxes"],
    edges: tuple[Num[Array, "*#boxes"], ...],
    unpacked: Callable[[Array], tuple[Array, ...]],
) -> tuple[Float[Array, "*boxes"], ...]:
    """Sums of boxes; `unpacked` splits whole sums into those of the images that share the tables."""
    x0, y0, x1, y1 = edges
    height1, num_cameras, width1 = tables.shape

    def read(j: Array, i: Array, steps: tuple[tuple[int, int], ...]) -> list[Array]:
        """The table at some corners, by their steps down and right from the corner (j, i)."""
        # Indices are in bounds by construction, and a check in the tracker's innermost loop would cost time.
        flat, row = jnp.reshape(tables, -1), num_cameras * width1
        index = camera * width1 + j * row + i
        return [
            flat.at[index + down * row + right].get(mode="promise_in_bounds", wrap_negative_indices=False)
            for down, right in steps
        ]

    def ends(low: Array, high: Array, last: int) -> tuple[Array, Array]:
        return jnp.clip(low, 0, last), jnp.clip(jnp.maximum(low, high), 0, last)

    (x0, x1), (y0, y1) = ends(x0, x1, width1 - 1), ends(y0, y1, height1 - 1)
    if jnp.issubdtype(x0.dtype, jnp.integer):
        corners = ((y0, x0), (y0, x1), (y1, x0), (y1, x1))
        c00, c10, c01, c11 = (read(y, x, ((0, 0),))[0] for y, x in corners)
        return tuple(part.astype(jnp.float32) for part in unpacked((c11 - c01) - (c10 - c00)))

    def split(edge: Array, last: int) -> tuple[Array, Array]:
        # The cell of the edge, and the share of the cell before the edge; at the last border this is 1.
        cell = jnp.minimum(edge.astype(jnp.int32), last - 1)
        return cell, edge - cell.astype(edge.dtype)

    (i0, fx0), (i1, fx1) = split(x0, width1 - 1), split(x1, width1 - 1)
    (j0, fy0), (j1, fy1) = split(y0, height1 - 1), split(y1, height1 - 1)

    def floats(total: Array) -> tuple[Array, ...]:
        return tuple(part.astype(x0.dtype) for part in unpacked(total))

    def corner(j: Array, i: Array, fx: Array, fy: Array) -> tuple[Array, tuple[Array, ...]]:
        # The table at the cell's corner, and the part that bilinear interpolation adds. Integers are subtracted before
        # the conversion to float32, because the sums of a 1080p image exceed 2^24. Each difference is the sum over a
        # box, so `unpacked` can split the difference.
        here, right, below, across = read(j, i, ((0, 0), (0, 1), (1, 0), (1, 1)))
        steps = (floats(step) for step in (right - here, below - here, across - below - right + here))
        added = tuple(
            fx * right + fy * below + (fx * fy) * across for right, below, across in zip(*steps, strict=True)
        )
        return here, added

    (c00, f00), (c10, f10) = corner(j0, i0, fx0, fy0), corner(j0, i1, fx1, fy0)
    (c01, f01), (c11, f11) = corner(j1, i0, fx0, fy1), corner(j1, i1, fx1, fy1)
    whole = floats((c11 - c01) - (c10 - c00))
    return tuple(
        of + ((a11 - a01) - (a10 - a00))
        for of, a00, a10, a01, a11 in zip(whole, f00, f10, f01, f11, strict=True)
    )
