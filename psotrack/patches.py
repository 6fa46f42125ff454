"""What each camera shows around each drone: small windows of the silhouettes, cut where the drones are expected.

A window is as coarse as it must be to hold drone, ring and search in `SIDE` pixels: silhouettes are halved for drones
that are near. All that the swarm reads is then a few kilobytes per drone and camera, however large the image is.

Drones share images. What a neighbour is expected to cover (its ellipse, a little enlarged, is its claim) is not this
drone's: foreground there is left out of the window, but where this drone's own prediction has its core, and the camera
counts less by as much of the drone as is claimed. So no drone can live on another's silhouette.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack._typing import Array, Coverage, Positions, Tables
from psotrack.boxes import Boxes, Extents, project_boxes
from psotrack.summed_area import summed_area_table

#: Pixels of a window, along each side.
SIDE = 64
#: Silhouettes as they are, halved, halved again ...
NUM_LEVELS = 4
#: Neighbours that are looked at, per drone and camera: those whose ellipses come nearest.
NUM_NEIGHBOURS = 3
#: What a drone claims is that much larger than its ellipse along each axis: outlines are no ellipses.
CLAIM = 1.15
#: Where this drone is expected to cover what is claimed: its ellipse, that much smaller along each axis.
CORE = 0.7
#: What one fully covered pixel of the silhouettes counts.
FULL = 255


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Patches:
    """The windows of all drones in all cameras; the axis of drones is 1 where they share whole images.

    Attributes:
        tables: (height + 1, windows, width + 1), summed-area tables; window (drone, camera) is the
            (drone x cameras + camera)-th.
        x_px, y_px: left and upper edges in the image.
        pixel_px: pixels of the image per pixel of the window, along each side.
        full: what a fully covered pixel of the window counts.
        clear: share of the drone's ellipse that no neighbour claims.
        size_wh_px: of the part of the image that silhouettes cover.
    """

    tables: Int[Array, "height1 windows width1"]
    x_px: Float[Array, "*drones cameras"]
    y_px: Float[Array, "*drones cameras"]
    pixel_px: Float[Array, "*drones cameras"]
    full: Float[Array, "*drones cameras"]
    clear: Float[Array, "*drones cameras"]
    size_wh_px: tuple[int, int] = field(metadata={"static": True})

    @property
    def number(self) -> Int[Array, "*drones cameras"]:
        """Which table each window is."""
        return jnp.arange(self.tables.shape[1]).reshape(self.x_px.shape)


def whole_images(tables: Tables, reduction: int) -> Patches:
    """Windows that all drones share: the whole image of each camera, with nothing claimed."""
    height1, cameras, width1 = tables.shape
    zero, one = jnp.zeros((1, cameras)), jnp.ones((1, cameras))
    size_wh = ((width1 - 1) * reduction, (height1 - 1) * reduction)
    return Patches(tables, zero, zero, reduction * one, FULL * one, one, size_wh)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Grid:
    """Where windows lie in the pyramid: rows and columns of their pixels at their level."""

    level: Int[Array, "drones cameras"]
    row: Int[Array, "drones cameras side"]
    column: Int[Array, "drones cameras side"]


def cut(
    coverage: Coverage,
    seen: Extents,
    expected_m: Positions,
    *,
    reach_m: Float[Array, "drones"],
    claiming: Bool[Array, "drones"],
    reduction: int,
    ring: float,
) -> Patches:
    """The windows of one frame.

    Args:
        coverage: (cameras, height, width), 0..255, silhouettes reduced by `reduction`.
        seen: the drones' extents in the cameras.
        expected_m: (drones, 3), where the drones are expected.
        reach_m: (drones,), how far from there they are searched for.
        claiming: (drones,), whether a drone's expected place is good enough to claim foreground.
        reduction: image pixels per silhouette pixel, along each side.
        ring: scale of the largest window that is scored.
    """
    boxes = project_boxes(seen, expected_m)
    grid = _grid(boxes, seen, reach_m, reduction, ring)
    pixel_px = _pixel_px(grid.level, reduction)
    full = FULL << (2 * grid.level)
    value = _read(_pyramid(coverage), coverage.shape, grid)
    own, claimed = _claims(boxes, grid, pixel_px, claiming)
    value = jnp.where(claimed & (own >= CORE**2), 0, value)
    inside = own < 1
    ours, theirs = (jnp.sum(of, (-2, -1), dtype=jnp.float32) for of in (inside, inside & claimed))
    clear = 1 - theirs / jnp.maximum(ours, 1.0)
    return Patches(
        tables=summed_area_table(value.reshape(-1, SIDE, SIDE)),
        x_px=grid.column[..., 0].astype(jnp.float32) * pixel_px,
        y_px=grid.row[..., 0].astype(jnp.float32) * pixel_px,
        pixel_px=pixel_px,
        full=full.astype(jnp.float32),
        clear=clear,
        size_wh_px=(reduction * coverage.shape[2], reduction * coverage.shape[1]),
    )


def _grid(boxes: Boxes, seen: Extents, reach_m: Float[Array, "drones"], reduction: int, ring: float) -> _Grid:
    """The finest level at which ring and search fit into a window, and the window about the expected middle."""
    half_px = jnp.maximum(boxes.x_half, boxes.y_half)
    # Pixels per metre at the drone, from its own size: the ellipse's largest half.
    half_m = jnp.sqrt(jnp.maximum(jnp.maximum(seen.s_xx, seen.s_yy), 1e-6))
    wanted = (ring * half_px + reach_m[:, None] * half_px / half_m) / reduction
    # The middle lies anywhere in the pixel that is right of the window's own middle: one pixel less on that side.
    level = jnp.ceil(jnp.log2(jnp.maximum(wanted, 1.0) / (SIDE / 2 - 1)))
    level = jnp.where(boxes.in_front, jnp.clip(level, 0, NUM_LEVELS - 1), 0).astype(jnp.int32)

    def line(middle_px: Array) -> Array:
        # What is not in front of the camera has its window off the image, where there is nothing.
        middle = jnp.where(boxes.in_front, middle_px, -1e5) / _pixel_px(level, reduction)
        first = jnp.clip(jnp.floor(middle), -1e5, 1e5).astype(jnp.int32) - SIDE // 2
        return first[..., None] + jnp.arange(SIDE)

    return _Grid(level, line(boxes.y_middle), line(boxes.x_middle))


def _pixel_px(level: Int[Array, "drones cameras"], reduction: int) -> Float[Array, "drones cameras"]:
    """Pixels of the image per pixel of a level, along each side."""
    return (reduction << level).astype(jnp.float32)


def _pyramid(coverage: Coverage) -> Int[Array, "pixels"]:
    """All levels of all cameras, one after the other: sums, not means, so that they stay exact."""
    step = 2 ** (NUM_LEVELS - 1)
    _, height, width = coverage.shape
    # Boxes end at the image's border, which may divide a coarse pixel. Its share beyond looks like the share inside.
    beyond = [(0, 0), (0, -height % step), (0, -width % step)]
    image = jnp.pad(coverage, beyond, mode="edge").astype(jnp.int32)
    levels = [image]
    for _ in range(NUM_LEVELS - 1):
        rows = levels[-1][:, 0::2] + levels[-1][:, 1::2]
        levels.append(rows[..., 0::2] + rows[..., 1::2])
    return jnp.concatenate([image.reshape(-1) for image in levels])


def _read(
    pyramid: Int[Array, "pixels"], shape: tuple[int, ...], grid: _Grid
) -> Int[Array, "drones cameras side side"]:
    """The windows' pixels; nothing outside of the image and its padding."""
    num_cameras, height, width = shape
    step = 2 ** (NUM_LEVELS - 1)
    heights, widths = (
        np.array([-(-side // step) * step >> n for n in range(NUM_LEVELS)]) for side in (height, width)
    )
    starts = np.cumsum([0, *(num_cameras * heights * widths)[:-1]])
    rows, columns, start = (jnp.asarray(of, jnp.int32)[grid.level] for of in (heights, widths, starts))
    image = start + jnp.arange(num_cameras) * rows * columns
    rows, columns = rows[..., None], columns[..., None]
    line = image[..., None] + jnp.clip(grid.row, 0, rows - 1) * columns
    index = line[..., None] + jnp.clip(grid.column, 0, columns - 1)[..., None, :]
    row_inside = (grid.row >= 0) & (grid.row < rows)
    column_inside = (grid.column >= 0) & (grid.column < columns)
    value = jnp.asarray(pyramid).at[index].get(mode="promise_in_bounds")
    return jnp.where(row_inside[..., None] & column_inside[..., None, :], value, 0)


def _claims(
    boxes: Boxes, grid: _Grid, pixel_px: Float[Array, "drones cameras"], claiming: Bool[Array, "drones"]
) -> tuple[Float[Array, "drones cameras side side"], Bool[Array, "drones cameras side side"]]:
    """Squared distance of every pixel from the drone's middle, in halves of its ellipse; and what neighbours claim."""
    x_px = (grid.column.astype(jnp.float32) + 0.5) * pixel_px[..., None]
    y_px = (grid.row.astype(jnp.float32) + 0.5) * pixel_px[..., None]

    def distance2(x: Array, y: Array, x_half: Array, y_half: Array) -> Array:
        across = jnp.square((x_px - x[..., None]) / x_half[..., None])
        down = jnp.square((y_px - y[..., None]) / y_half[..., None])
        return down[..., :, None] + across[..., None, :]

    own = distance2(boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half)
    claimed = jnp.zeros(own.shape, bool)
    for other, near in _neighbours(boxes, claiming):
        claim = [
            jnp.take_along_axis(of, other, axis=0)
            for of in (boxes.x_middle, boxes.y_middle, CLAIM * boxes.x_half, CLAIM * boxes.y_half)
        ]
        claimed |= (distance2(*claim) < 1) & near[..., None, None]
    return own, claimed


def _neighbours(
    boxes: Boxes, claiming: Bool[Array, "drones"]
) -> list[tuple[Int[Array, "drones cameras"], Bool[Array, "drones cameras"]]]:
    """For each rank of nearness, which drone it is for every drone and camera, and whether there is one."""
    drones = claiming.shape[0]

    def gap2(middle: Array, half: Array) -> Array:
        return jnp.square((middle[:, None] - middle) / jnp.maximum(half[:, None] + half, 1e-3))

    gap = gap2(boxes.x_middle, boxes.x_half) + gap2(boxes.y_middle, boxes.y_half)
    others = ~jnp.eye(drones, dtype=bool)[..., None] & claiming[:, None] & boxes.in_front
    gap = jnp.where(others, gap, jnp.inf)
    order = jnp.argsort(gap, axis=1)[:, : min(NUM_NEIGHBOURS, drones - 1)]
    near = jnp.isfinite(jnp.take_along_axis(gap, order, axis=1))
    return [(order[:, rank], near[:, rank]) for rank in range(order.shape[1])]
