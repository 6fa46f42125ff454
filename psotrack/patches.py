"""What each camera shows around each drone: small windows of the silhouettes, cut where the drones are expected.

A window is as coarse as it must be to hold drone, ring and search in `SIDE` pixels: silhouettes are halved for drones
that are near. All that the swarm reads is then a few kilobytes per drone and camera, however large the image is.

Drones share images. Foreground that something else is expected to cover (see `claims`) is kept apart in the window: it
may be this drone's or not, so it counts neither for nor against it. And the camera counts less by as much of the drone
as other drones claim. So no drone can live on another's silhouette.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack._typing import Array, Coverage, Positions, Tables
from psotrack.boxes import Boxes, Extents, project_boxes
from psotrack.claims import Claims, claims_on, clear_share, ellipse_distance2
from psotrack.summed_area import pack, summed_area_table

#: Pixels of a window, along each side.
SIDE = 64
#: Silhouettes as they are, halved, halved again ...
NUM_LEVELS = 4
#: What one fully covered pixel of the silhouettes counts.
FULL = 255


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Patches:
    """The windows of all drones in all cameras; the axis of drones is 1 where they share whole images.

    Attributes:
        tables: (height + 1, windows, width + 1), summed-area tables; window (drone, camera) is the
            (drone x cameras + camera)-th. A fully covered pixel counts `FULL`.
        x_px, y_px: left and upper edges in the image.
        pixel_px: pixels of the image per pixel of the window, along each side.
        clear: share of the drone's ellipse that no other drone claims.
        size_wh_px: of the part of the image that silhouettes cover.
        packed: whether tables hold, beside the foreground, how many pixels of claimed foreground there are.
    """

    tables: Int[Array, "height1 windows width1"]
    x_px: Float[Array, "*drones cameras"]
    y_px: Float[Array, "*drones cameras"]
    pixel_px: Float[Array, "*drones cameras"]
    clear: Float[Array, "*drones cameras"]
    size_wh_px: tuple[int, int] = field(metadata={"static": True})
    packed: bool = field(metadata={"static": True})

    @property
    def number(self) -> Int[Array, "*drones cameras"]:
        """Which table each window is."""
        return jnp.arange(self.tables.shape[1]).reshape(self.x_px.shape)


def whole_images(tables: Tables, reduction: int) -> Patches:
    """Windows that all drones share: the whole image of each camera, with nothing claimed."""
    height1, cameras, width1 = tables.shape
    zero, one = jnp.zeros((1, cameras)), jnp.ones((1, cameras))
    size_wh = ((width1 - 1) * reduction, (height1 - 1) * reduction)
    return Patches(tables, zero, zero, reduction * one, one, size_wh, packed=False)


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
    claiming: Bool[Array, "drones"] | None,
    reduction: int,
    ring: float,
    floor_z_m: Float[Array, ""] | None = None,
) -> Patches:
    """The windows of one frame.

    Args:
        coverage: (cameras, height, width), 0..255, silhouettes reduced by `reduction`.
        seen: the drones' extents in the cameras.
        expected_m: (drones, 3), where the drones are expected.
        reach_m: (drones,), how far from there they are searched for.
        claiming: (drones,), whether a drone's expected place is good enough to claim foreground; None: nobody claims.
        reduction: image pixels per silhouette pixel, along each side.
        ring: scale of the largest window that is scored.
        floor_z_m: height of the floor on which drones that claim also cast shadows; None: they cast none.
    """
    boxes = project_boxes(seen, expected_m)
    grid = _grid(boxes, seen, reach_m, reduction, ring)
    pixel_px = _pixel_px(grid.level, reduction)
    value = _read(_pyramid(coverage), coverage.shape, grid)
    clear: Array = jnp.ones(pixel_px.shape)
    # With nobody to claim there is nothing to keep apart: the swarm then reads plain tables.
    packed = claiming is not None and (len(expected_m) > 1 or floor_z_m is not None)
    if claiming is not None and packed:
        claims = claims_on(boxes, seen, expected_m, claiming=claiming, floor_z_m=floor_z_m, pixel_px=pixel_px)
        clear = clear_share(claims, boxes)
        claimed = _claimed(claims, boxes, grid, pixel_px)
        # Half covered is covered: what is claimed is only counted.
        value = pack(jnp.where(claimed, 0, value), claimed & (2 * value > FULL))
    return Patches(
        tables=summed_area_table(value.reshape(-1, SIDE, SIDE)),
        x_px=grid.column[..., 0].astype(jnp.float32) * pixel_px,
        y_px=grid.row[..., 0].astype(jnp.float32) * pixel_px,
        pixel_px=pixel_px,
        clear=clear,
        size_wh_px=(reduction * coverage.shape[2], reduction * coverage.shape[1]),
        packed=packed,
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
    """All levels of all cameras, one after the other: means, rounded once from exact sums."""
    step = 2 ** (NUM_LEVELS - 1)
    _, height, width = coverage.shape
    # Boxes end at the image's border, which may divide a coarse pixel. Its share beyond looks like the share inside.
    beyond = [(0, 0), (0, -height % step), (0, -width % step)]
    image = jnp.pad(coverage, beyond, mode="edge").astype(jnp.int32)
    levels = [image]
    for _ in range(NUM_LEVELS - 1):
        rows = levels[-1][:, 0::2] + levels[-1][:, 1::2]
        levels.append(rows[..., 0::2] + rows[..., 1::2])
    rounded = [(image + ((1 << 2 * n) >> 1)) >> 2 * n for n, image in enumerate(levels)]
    return jnp.concatenate([image.reshape(-1) for image in rounded])


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


def _claimed(
    claims: Claims, boxes: Boxes, grid: _Grid, pixel_px: Float[Array, "drones cameras"]
) -> Bool[Array, "drones cameras side side"]:
    """The pixels whose middles are claimed and not in the drone's core."""
    x_px = ((grid.column.astype(jnp.float32) + 0.5) * pixel_px[..., None])[..., None, :]
    y_px = ((grid.row.astype(jnp.float32) + 0.5) * pixel_px[..., None])[..., :, None]
    own = [of[..., None, None] for of in (boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half)]
    beyond_core = ellipse_distance2(x_px, y_px, *own) >= jnp.square(claims.core)[..., None, None]
    return jnp.any(claims.cover(x_px, y_px) & beyond_core, axis=0)
