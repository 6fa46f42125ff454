"""What each camera shows around each drone: small windows of the silhouettes, cut where the drones are expected.

A window is as coarse as it must be to hold drone, ring and search in `SIDE` pixels: silhouettes are halved for drones
that are near. All that the swarm reads is then a few kilobytes per drone and camera, however large the image is.

Drones share images. Foreground that something else is expected to cover (see `claims`) is kept apart in the window: it
may be this drone's or not, so it counts neither for nor against it. And the camera counts less by as much of the drone
as other drones claim. So no drone can live on another's silhouette.

Foreground before floor that is in shadow (see `shadows`) would be there without the drone. Its place is taken by the
drone as it is expected: what is below must balance what is above, or the place would be drawn to one side.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack._typing import Array, Coverage, Positions, Tables
from psotrack.geometry import Boxes, Extents, project_boxes
from psotrack.silhouettes import pack, summed_area_table
from psotrack.tracking.occlusion import CORE, Claims, claims_on, clear_share, ellipse_distance2
from psotrack.tracking.shadows import low, shadowed

#: Pixels of a window, along each side.
SIDE = 64
#: Silhouettes as they are, halved, halved again ...
NUM_LEVELS = 4
#: x and y of all pixels of windows, (drones, cameras, 1, side) and (drones, cameras, side, 1).
Middles = tuple[Float[Array, "drones cameras 1 side"], Float[Array, "drones cameras side 1"]]

#: What one fully covered pixel of the silhouettes counts.
FULL = 255
#: How full of foreground a drone's box is, from its middle to its border and beyond: all, less by the distance (in
#: halves of the box, along the farther axis), none from here on. Silhouettes of four quadrotors fill 0.8 to 0.9, 0.6 to
#: 0.7 and 0.4 to 0.5 of boxes of scale 0.4, 0.7 and 1; this, 0.83, 0.63 and 0.43.
_EMPTY = 1.1


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

    def middles_px(self, pixel_px: Float[Array, "drones cameras"]) -> Middles:
        """In pixels of the image, to be broadcast against one another."""
        x_px, y_px = ((of.astype(jnp.float32) + 0.5) * pixel_px[..., None] for of in (self.column, self.row))
        return x_px[..., None, :], y_px[..., :, None]


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
        floor_z_m: height of the floor on which drones that claim cast shadows; None: they cast none.
    """
    boxes = project_boxes(seen, expected_m)
    grid = _grid(boxes, seen, reach_m, reduction, ring)
    pixel_px = _pixel_px(grid.level, reduction)
    value = _read(_pyramid(coverage), coverage.shape, grid)
    clear: Array = jnp.ones(pixel_px.shape)
    # With nobody to claim there is nothing to keep apart: the swarm then reads plain tables.
    packed = claiming is not None and len(expected_m) > 1
    if claiming is not None:
        claims = claims_on(boxes, claiming=claiming, pixel_px=pixel_px)
        at_px = grid.middles_px(pixel_px)
        shown = value
        if floor_z_m is not None:
            shown = _beside_shadows(
                value,
                coverage,
                seen,
                claims,
                expected_m,
                at_px,
                claiming=claiming,
                floor_z_m=floor_z_m,
                reduction=reduction,
            )
        if packed:
            clear = clear_share(claims, boxes)
            claimed = _claimed(claims, boxes, at_px)
            # Half covered is covered: what is claimed is only counted.
            shown = pack(jnp.where(claimed, 0, shown), claimed & (2 * value > FULL))
        value = shown
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


def _claimed(claims: Claims, boxes: Boxes, at_px: Middles) -> Bool[Array, "drones cameras side side"]:
    """The pixels whose middles are claimed and not in the drone's core."""
    own = [of[..., None, None] for of in (boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half)]
    beyond_core = ellipse_distance2(*at_px, *own) >= CORE**2
    return claims.cover(*at_px).any(axis=0) & beyond_core


def _beside_shadows(
    value: Int[Array, "drones cameras side side"],
    coverage: Coverage,
    seen: Extents,
    claims: Claims,
    expected_m: Positions,
    at_px: Middles,
    *,
    claiming: Bool[Array, "drones"],
    floor_z_m: Float[Array, ""],
    reduction: int,
) -> Int[Array, "drones cameras side side"]:
    """The windows of low drones with no more foreground before shadows than drones have where they are expected."""
    is_low = claiming & low(expected_m, seen.size_m, floor_z_m)

    def balanced() -> Array:
        # No drone is in the floor. One that is expected there would hide from itself what is shadow.
        least_m = floor_z_m + seen.size_m[:, 2] / 2
        above_m = jnp.asarray(expected_m).at[:, 2].max(least_m)
        boxes = project_boxes(seen, above_m)
        dark = shadowed(
            coverage, seen, boxes, claims, above_m, at_px, floor_z_m=floor_z_m, reduction=reduction
        )
        usual = jnp.round(FULL * _usual_share(boxes, at_px)).astype(value.dtype)
        return jnp.where(dark & is_low[:, None, None, None], jnp.minimum(value, usual), value)

    # Most of the time all drones are high, and there is nothing to do.
    return jax.lax.cond(is_low.any(), balanced, lambda: value)


def _usual_share(boxes: Boxes, at_px: Middles) -> Float[Array, "drones cameras side side"]:
    """How full of foreground drones are, pixel by pixel."""
    x_px, y_px = at_px

    def off(at_px: Array, middle: Array, half: Array) -> Array:
        return jnp.abs(at_px - middle[..., None, None]) / jnp.maximum(half, 1e-3)[..., None, None]

    farther = jnp.maximum(off(x_px, boxes.x_middle, boxes.x_half), off(y_px, boxes.y_middle, boxes.y_half))
    return jnp.clip(_EMPTY - farther, 0, 1)
