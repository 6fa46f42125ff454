"""Patches: what each camera shows around each drone, small windows of the silhouettes where drones are expected.

A window is coarse enough to hold the drone, the ring around it and the search in `SIDE` pixels: silhouettes are halved
for drones that are near. So the swarm reads only a few kilobytes per drone and camera, however large the image is.

Drones share images. Foreground that another drone is expected to cover (see `occlusion`) is counted apart in the
window: it may be this drone's or not, so it counts neither for nor against this drone. The camera's weight is reduced
by the share of the drone that other drones may cover. So no drone can be placed on another drone's silhouette.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.foreground.silhouettes import pack
from psotrack.geometry import Boxes, Extents, project_boxes
from psotrack.support.array_types import Array, Positions, Tables
from psotrack.tracking.swarm.occlusion import (
    CORE_SCALE,
    Occluders,
    ellipse_distance2,
    find_occluders,
    unoccluded_share,
)

#: Pixels of a window, along each side.
SIDE = 64
#: Levels of the image pyramid: silhouettes as they are, halved, halved again ...
NUM_LEVELS = 4
#: Value of a fully covered pixel of the silhouettes.
FULL = 255
#: Bits that hold the sum of a line of a window: 64 pixels of 0..255.
_LINE_BITS = 14
#: (side, side + 1): a line of pixels times this matrix gives the sums of the pixels before each edge.
_BEFORE = np.triu(np.ones((SIDE, SIDE + 1), np.float32), 1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pyramid:
    """Silhouettes as they are, and at coarser resolutions: means of 2 x 2, 4 x 4 and 8 x 8 pixels.

    Attributes:
        levels: (..., cameras, rows, columns), 0..255, the levels beside each other, from `_places`.
        shape: height and width of the silhouettes; static.
    """

    levels: UInt8[Array, "*frames cameras rows columns"]
    shape: tuple[int, int] = field(metadata={"static": True})


@jax.jit
def make_pyramid(coverage: UInt8[Array, "frames cameras height width"]) -> Pyramid:
    """The pyramid of some frames; means are rounded once, from exact sums.

    Boxes end at the image's border, which may lie inside a coarse pixel: beyond it the image is repeated.
    """
    height, width = coverage.shape[-2:]
    step = 2 ** (NUM_LEVELS - 1)
    even = jnp.pad(coverage, [(0, 0), (0, 0), (0, -height % step), (0, -width % step)], mode="edge")
    total, means = even.astype(jnp.uint16), [coverage]
    for level in range(1, NUM_LEVELS):
        *images, rows, columns = total.shape
        total = total.reshape(*images, rows // 2, 2, columns // 2, 2).sum(axis=(-3, -1), dtype=jnp.uint16)
        means.append(((total + (1 << 2 * level >> 1)) >> 2 * level).astype(jnp.uint8))
    places = _places((height, width))
    longest = max(rows for _, rows, _ in places)
    levels = [
        jnp.pad(mean, [(0, 0), (0, 0), (0, longest - mean.shape[-2]), (0, columns - mean.shape[-1])])
        for mean, (_, _, columns) in zip(means, places, strict=True)
    ]
    return Pyramid(jnp.concatenate(levels, axis=-1), (height, width))


def _places(shape: tuple[int, int]) -> list[tuple[int, int, int]]:
    """First column of each level, and its rows and columns: at least those of a window."""
    step = 2 ** (NUM_LEVELS - 1)
    even = [length + -length % step for length in shape]
    sides = [shape, *([length >> level for length in even] for level in range(1, NUM_LEVELS))]
    rows, columns = ([max(side[axis], SIDE) for side in sides] for axis in range(2))
    firsts = np.cumsum([0, *columns[:-1]]).tolist()
    return list(zip(firsts, rows, columns, strict=True))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Patches:
    """The windows of all drones in all cameras; the axis of drones is 1 where the drones share whole images.

    Attributes:
        tables: (height + 1, windows, width + 1), summed-area tables; window (drone, camera) has the number
            drone x cameras + camera. A fully covered pixel has the value `FULL`.
        x_px, y_px: left and upper edges of the windows in the image.
        pixel_px: image pixels per pixel of the window, along each side.
        clear: share of the drone's ellipse that no other drone may cover.
        size_wh_px: (cameras,) each, widths and heights of the parts of the images that silhouettes cover.
        reduction: image pixels per silhouette pixel, along each side.
        packed: whether the tables also count the pixels of occluded foreground.
        whole_cells: whether the edges of boxes are rounded to pixels of the windows, which saves three quarters of the
            reads.
    """

    tables: Int[Array, "height1 windows width1"]
    x_px: Float[Array, "*drones cameras"]
    y_px: Float[Array, "*drones cameras"]
    pixel_px: Float[Array, "*drones cameras"]
    clear: Float[Array, "*drones cameras"]
    size_wh_px: tuple[Float[Array, "cameras"], Float[Array, "cameras"]]
    reduction: int = field(metadata={"static": True})
    packed: bool = field(metadata={"static": True})
    whole_cells: bool = field(default=False, metadata={"static": True})

    @property
    def number(self) -> Int[Array, "*drones cameras"]:
        """The number of each window's table."""
        return jnp.arange(self.tables.shape[1]).reshape(self.x_px.shape)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Windows:
    """The pixels of the windows of all drones in all cameras, whatever other drones may cover.

    Attributes:
        value: (drones, cameras, side, side), 0..255.
        x_px, y_px, pixel_px, size_wh_px: as in `Patches`.
    """

    value: Int[Array, "drones cameras side side"]
    x_px: Float[Array, "drones cameras"]
    y_px: Float[Array, "drones cameras"]
    pixel_px: Float[Array, "drones cameras"]
    size_wh_px: tuple[Float[Array, "cameras"], Float[Array, "cameras"]]

    @property
    def middles_px(self) -> tuple[Float[Array, "drones cameras side"], Float[Array, "drones cameras side"]]:
        """x of the middles of each window's columns, and y of the middles of its rows, in the image."""
        cells = (jnp.arange(SIDE, dtype=jnp.float32) + 0.5) * self.pixel_px[..., None]
        return self.x_px[..., None] + cells, self.y_px[..., None] + cells


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExpectedDrones:
    """Where windows are cut.

    Attributes:
        position_m: (drones, 3), expected positions, metres.
        reach_m: (drones,), distance from this position within which the drone is searched for, metres.
        occluding: (drones,), whether a drone's expected position is certain enough to occlude other drones; None where
            no drone occludes another.
    """

    position_m: Positions
    reach_m: Float[Array, "drones"]
    occluding: Bool[Array, "drones"] | None = None


def whole_images(tables: Tables, reduction: int) -> Patches:
    """The whole image of each camera as a window that all drones share, without occlusion."""
    height1, cameras, width1 = tables.shape
    zero, one = jnp.zeros((1, cameras)), jnp.ones((1, cameras))
    sides = ((width1 - 1) * reduction, (height1 - 1) * reduction)
    size_wh = jnp.full(cameras, sides[0], jnp.float32), jnp.full(cameras, sides[1], jnp.float32)
    return Patches(tables, zero, zero, reduction * one, one, size_wh, reduction, packed=False)


def cut(
    pyramid: Pyramid, extents: Extents, expected: ExpectedDrones, *, reduction: int, ring: float
) -> tuple[Patches, Windows]:
    """The windows of one frame, as tables for the score and as pixels.

    Args:
        pyramid: silhouettes of one frame, reduced by `reduction`.
        extents: the drones' extents in the cameras.
        expected: where the drones are expected.
        reduction: image pixels per silhouette pixel, along each side.
        ring: scale of the largest box that is scored.
    """
    # The barriers keep XLA from computing boxes, places, ellipses and tables again for every pixel that reads them.
    boxes: Boxes = jax.lax.optimization_barrier(project_boxes(extents, expected.position_m))
    windows = _windows(pyramid, boxes, extents, expected.reach_m, reduction, ring)
    clear: Array = jnp.ones(windows.pixel_px.shape)
    # Without other drones nothing is counted apart: the swarm then reads plain tables.
    packed = expected.occluding is not None and len(expected.position_m) > 1
    shown, apart = windows.value, None
    if expected.occluding is not None and packed:
        occluders: Occluders = jax.lax.optimization_barrier(
            find_occluders(boxes, occluding=expected.occluding, pixel_px=windows.pixel_px)
        )
        clear = unoccluded_share(occluders, boxes)
        x_px, y_px = windows.middles_px
        at_px = x_px[..., None, :], y_px[..., :, None]
        own = [of[..., None, None] for of in (boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half)]
        # Other drones may cover these pixels, which are not in the drone's core.
        occluded = occluders.cover(*at_px) & (ellipse_distance2(*at_px, *own) >= CORE_SCALE**2)
        # Occluded foreground is only counted: a pixel that is half covered or more counts as foreground.
        shown, apart = jnp.where(occluded, 0, shown), occluded & (2 * shown > FULL)
    patches = Patches(
        tables=_tables(shown, apart),
        x_px=windows.x_px,
        y_px=windows.y_px,
        pixel_px=windows.pixel_px,
        clear=clear,
        size_wh_px=windows.size_wh_px,
        reduction=reduction,
        packed=packed,
    )
    both: tuple[Patches, Windows] = jax.lax.optimization_barrier((patches, windows))
    return both


def _windows(
    pyramid: Pyramid,
    boxes: Boxes,
    extents: Extents,
    reach_m: Float[Array, "drones"],
    reduction: int,
    ring: float,
) -> Windows:
    """The windows about the expected boxes, each at the finest level at which ring and search region fit into it."""
    half_px = jnp.maximum(boxes.x_half, boxes.y_half)
    # Half length of the drone that appears as the larger half length of its ellipse: it gives pixels per metre.
    half_m = jnp.sqrt(jnp.maximum(jnp.maximum(extents.s_xx, extents.s_yy), 1e-6))
    wanted = (ring * half_px + reach_m[:, None] * half_px / half_m) / reduction
    # The expected middle lies anywhere in the pixel to the right of the window's middle: one pixel less on that side.
    level = jnp.ceil(jnp.log2(jnp.maximum(wanted, 1.0) / (SIDE / 2 - 1)))
    level = jnp.where(boxes.in_front, jnp.clip(level, 0, NUM_LEVELS - 1), 0).astype(jnp.int32)
    pixel_px = (reduction << level).astype(jnp.float32)
    places = jnp.asarray(_places(pyramid.shape), jnp.int32)[level]

    def first(middle_px: Array, length: Array) -> Array:
        # A window that would reach beyond the image is moved to its border: there is no foreground beyond.
        middle = jnp.clip(middle_px / pixel_px, -1e5, 1e5)
        return jnp.clip(jnp.floor(middle).astype(jnp.int32) - SIDE // 2, 0, length - SIDE)

    row, column = first(boxes.y_middle, places[..., 1]), first(boxes.x_middle, places[..., 2])

    def window(camera: Array, at_row: Array, at_column: Array) -> Array:
        return jax.lax.dynamic_slice(pyramid.levels, (camera, at_row, at_column), (1, SIDE, SIDE))[0]

    windows_of = jax.vmap(jax.vmap(window), in_axes=(None, 0, 0))
    value = windows_of(jnp.arange(row.shape[1]), row, column + places[..., 0])
    value, row, column, pixel_px = jax.lax.optimization_barrier((value, row, column, pixel_px))
    # Up to the borders of the silhouettes: those of a small camera fill only a part of the array.
    covered_px = reduction * jnp.ceil(jnp.asarray(extents.cameras.image_size_wh, jnp.float32) / reduction)
    height, width = pyramid.shape
    return Windows(
        value=value.astype(jnp.int32),
        x_px=column.astype(jnp.float32) * pixel_px,
        y_px=row.astype(jnp.float32) * pixel_px,
        pixel_px=pixel_px,
        size_wh_px=(
            jnp.minimum(covered_px[:, 0], reduction * width),
            jnp.minimum(covered_px[:, 1], reduction * height),
        ),
    )


def _tables(
    value: Int[Array, "drones cameras side side"], apart: Bool[Array, "drones cameras side side"] | None
) -> Int[Array, "height1 windows width1"]:
    """Summed-area tables of the windows; of values packed with the number of pixels that are counted apart.

    The same numbers as from `psotrack.foreground.silhouettes.summed_area_table`. The lines are short, so that a product
    with a matrix gives their sums exactly in float32, in half the time.
    """
    marked = value if apart is None else value + (apart.astype(jnp.int32) << _LINE_BITS)
    lines: Array = jnp.dot(
        marked.reshape(-1, SIDE).astype(jnp.float32),
        jnp.asarray(_BEFORE),
        precision=jax.lax.Precision.HIGHEST,
    ).astype(jnp.int32)
    if apart is not None:
        one_apart = pack(jnp.zeros((), jnp.int32), jnp.ones((), bool))
        lines = (lines & ((1 << _LINE_BITS) - 1)) + one_apart * (lines >> _LINE_BITS)

    def add(total: jax.Array, line: Any) -> tuple[jax.Array, jax.Array]:
        return total + line, total

    # The last line is below the window: each line of the table is the sum of the lines before.
    lines = jnp.pad(lines.reshape(-1, SIDE, SIDE + 1), [(0, 0), (0, 1), (0, 0)]).swapaxes(0, 1)
    return jax.lax.scan(add, jnp.zeros(lines.shape[1:], jnp.int32), lines)[1]
