"""Patches: what each camera shows around each drone, small windows of the silhouettes where drones are expected.

A window is coarse enough to hold the drone, the ring around it and the search in `SIDE` pixels: silhouettes are halved
for drones that are near. So the swarm reads only a few kilobytes per drone and camera, however large the image is.

Drones share images. Foreground that another drone is expected to cover (see `occlusion`) is counted apart in the
window: it may be this drone's or not, so it counts neither for nor against this drone. The camera's weight is reduced
by the share of the drone that other drones may cover. So no drone can be placed on another drone's silhouette.

Foreground in front of floor that is in shadow (see `shadows`) would be there without the drone too. It is replaced by
the foreground that is usual at that place of a drone's box: without any foreground below the drone, the drone would
be drawn upwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8, UInt32

from psotrack._typing import Array, Coverage, Positions, Tables
from psotrack.geometry import Boxes, Camera, Extents, project_boxes
from psotrack.silhouettes import pack
from psotrack.tracking.occlusion import (
    CORE_SCALE,
    Occluders,
    ellipse_distance2,
    find_occluders,
    unoccluded_share,
)
from psotrack.tracking.shadows import FloorView, is_low, shadowed_pixels

#: Pixels of a window, along each side.
SIDE = 64
#: Levels of the image pyramid: silhouettes as they are, halved, halved again ...
NUM_LEVELS = 4
#: x and y of all pixels of windows, (drones, cameras, 1, side) and (drones, cameras, side, 1).
Middles = tuple[Float[Array, "drones cameras 1 side"], Float[Array, "drones cameras side 1"]]

#: Value of a fully covered pixel of the silhouettes.
FULL = 255
#: Bits that hold the sum of a line of a window: 64 pixels of 0..255.
_LINE_BITS = 14
#: (side, side + 1): a line of pixels times this matrix gives the sums of the pixels before each edge.
_BEFORE = np.triu(np.ones((SIDE, SIDE + 1), np.float32), 1)
#: Usual share of foreground at a place of a drone's box: this number minus the distance from the box's middle (in half
#: lengths of the box, along the farther axis). Silhouettes of four quadrotors fill 0.8 to 0.9, 0.6 to 0.7 and 0.4 to
#: 0.5 of boxes of scale 0.4, 0.7 and 1; this model 0.83, 0.63 and 0.43.
_EMPTY = 1.1


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
    """

    tables: Int[Array, "height1 windows width1"]
    x_px: Float[Array, "*drones cameras"]
    y_px: Float[Array, "*drones cameras"]
    pixel_px: Float[Array, "*drones cameras"]
    clear: Float[Array, "*drones cameras"]
    size_wh_px: tuple[Float[Array, "cameras"], Float[Array, "cameras"]]
    reduction: int = field(metadata={"static": True})
    packed: bool = field(metadata={"static": True})

    @property
    def number(self) -> Int[Array, "*drones cameras"]:
        """The number of each window's table."""
        return jnp.arange(self.tables.shape[1]).reshape(self.x_px.shape)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Windows:
    """The pixels of the windows of all drones in all cameras, whatever other drones may cover.

    Attributes:
        value: foreground of each pixel, 0 to `FULL`; 0 outside of the image.
        x_px, y_px, pixel_px, size_wh_px: as in `Patches`.
    """

    value: Int[Array, "drones cameras side side"]
    x_px: Float[Array, "drones cameras"]
    y_px: Float[Array, "drones cameras"]
    pixel_px: Float[Array, "drones cameras"]
    size_wh_px: tuple[Float[Array, "cameras"], Float[Array, "cameras"]]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExpectedDrones:
    """Where windows are cut.

    Attributes:
        position_m: (drones, 3), expected positions, metres.
        reach_m: (drones,), distance from this position within which the drone is searched for, metres.
        occluding: (drones,), whether a drone's expected position is certain enough to occlude other drones; None where
            no drone occludes another.
        floor_z_m: height of the floor on which occluding drones cast shadows, metres; None where they cast none.
    """

    position_m: Positions
    reach_m: Float[Array, "drones"]
    occluding: Bool[Array, "drones"] | None = None
    floor_z_m: Float[Array, ""] | None = None


def whole_images(tables: Tables, reduction: int) -> Patches:
    """The whole image of each camera as a window that all drones share, without occlusion."""
    height1, cameras, width1 = tables.shape
    zero, one = jnp.zeros((1, cameras)), jnp.ones((1, cameras))
    sides = ((width1 - 1) * reduction, (height1 - 1) * reduction)
    size_wh = jnp.full(cameras, sides[0], jnp.float32), jnp.full(cameras, sides[1], jnp.float32)
    return Patches(tables, zero, zero, reduction * one, one, size_wh, reduction, packed=False)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Grid:
    """Places of the windows in the pyramid: rows and columns of their pixels at their level."""

    level: Int[Array, "drones cameras"]
    row: Int[Array, "drones cameras side"]
    column: Int[Array, "drones cameras side"]

    def is_at(self, level: int) -> Bool[Array, "drones cameras 1 1"]:
        """Which windows are at a level."""
        return (self.level == level)[..., None, None]

    def pixels(
        self, images: Shaped[Array, "cameras rows words"], level: int, per_word: int = 1
    ) -> Int[Array, "drones cameras side side"]:
        """The pixels of the windows at a level; any values elsewhere.

        Args:
            images: the images at this level.
            level: number of the level.
            per_word: number of pixels in each number of `images`, from the lowest bits on.
        """
        cameras, rows, words = images.shape
        here = (self.level == level)[..., None]
        row = jnp.where(here, jnp.clip(self.row, 0, rows - 1), 0)
        column = jnp.where(here, jnp.clip(self.column, 0, words * per_word - 1), 0)
        line = (jnp.arange(cameras)[:, None] * rows + row) * words
        # The barrier keeps XLA from computing these again for every pixel.
        line, word, shift = jax.lax.optimization_barrier(
            (line, column // per_word, column % per_word * (32 // per_word))
        )
        index = line[..., None] + word[..., None, :]
        value = jnp.asarray(images).reshape(-1).at[index].get(mode="promise_in_bounds").astype(jnp.uint32)
        if per_word > 1:
            value = (value >> shift[..., None, :].astype(jnp.uint32)) & ((1 << 32 // per_word) - 1)
        return value.astype(jnp.int32)

    def middles_px(self, pixel_px: Float[Array, "drones cameras"]) -> Middles:
        """x and y of the pixels' middles in the image, in shapes that broadcast against each other."""
        x_px, y_px = ((of.astype(jnp.float32) + 0.5) * pixel_px[..., None] for of in (self.column, self.row))
        return x_px[..., None, :], y_px[..., :, None]


def cut(
    coverage: Coverage, extents: Extents, expected: ExpectedDrones, *, reduction: int, ring: float
) -> Patches:
    """The windows of one frame.

    Args:
        coverage: (cameras, height, width), 0..255, silhouettes reduced by `reduction`.
        extents: the drones' extents in the cameras.
        expected: where the drones are expected.
        reduction: image pixels per silhouette pixel, along each side.
        ring: scale of the largest box that is scored.
    """
    boxes = project_boxes(extents, expected.position_m)
    grid, windows = _windows(boxes, coverage, extents, expected.reach_m, reduction, ring)
    value, pixel_px = windows.value, windows.pixel_px
    clear: Array = jnp.ones(pixel_px.shape)
    # Without other drones nothing is counted apart: the swarm then reads plain tables.
    packed = expected.occluding is not None and len(expected.position_m) > 1
    shown, apart = value, None
    if expected.occluding is not None:
        occluders = find_occluders(boxes, occluding=expected.occluding, pixel_px=pixel_px)
        at_px = grid.middles_px(pixel_px)
        if expected.floor_z_m is not None:
            shown = _without_shadows(value, coverage, extents, occluders, expected, at_px, reduction)
        if packed:
            clear = unoccluded_share(occluders, boxes)
            occluded = _occluded(occluders, boxes, at_px)
            # Occluded foreground is only counted: a pixel that is half covered or more counts as foreground.
            shown, apart = jnp.where(occluded, 0, shown), occluded & (2 * value > FULL)
    return Patches(
        tables=_tables(shown, apart),
        x_px=windows.x_px,
        y_px=windows.y_px,
        pixel_px=pixel_px,
        clear=clear,
        size_wh_px=windows.size_wh_px,
        reduction=reduction,
        packed=packed,
    )


def cut_windows(
    coverage: Coverage, extents: Extents, expected: ExpectedDrones, *, reduction: int, ring: float
) -> Windows:
    """The pixels of the windows of one frame; arguments as in `cut`."""
    boxes = project_boxes(extents, expected.position_m)
    return _windows(boxes, coverage, extents, expected.reach_m, reduction, ring)[1]


def _windows(
    boxes: Boxes,
    coverage: Coverage,
    extents: Extents,
    reach_m: Float[Array, "drones"],
    reduction: int,
    ring: float,
) -> tuple[_Grid, Windows]:
    grid = _grid(boxes, extents, reach_m, reduction, ring)
    pixel_px = _pixel_px(grid.level, reduction)
    windows = Windows(
        value=_read(coverage, grid),
        x_px=grid.column[..., 0].astype(jnp.float32) * pixel_px,
        y_px=grid.row[..., 0].astype(jnp.float32) * pixel_px,
        pixel_px=pixel_px,
        size_wh_px=_covered_px(extents.cameras, coverage.shape, reduction),
    )
    return grid, windows


def _tables(
    value: Int[Array, "drones cameras side side"], apart: Bool[Array, "drones cameras side side"] | None
) -> Int[Array, "height1 windows width1"]:
    """Summed-area tables of the windows; of values packed with the number of pixels that are counted apart.

    The same numbers as from `psotrack.silhouettes.summed_area_table`. The lines are short, so that a product with a
    matrix gives their sums exactly in float32, in half the time.
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


def _covered_px(
    cameras: Camera, shape: tuple[int, ...], reduction: int
) -> tuple[Float[Array, "cameras"], Float[Array, "cameras"]]:
    """Widths and heights of the images, up to the borders of their silhouettes.

    The silhouettes of a small camera fill only a part of the array, which has the size of the largest ones.
    """
    own = reduction * jnp.ceil(jnp.asarray(cameras.image_size_wh, jnp.float32) / reduction)
    return jnp.minimum(own[:, 0], reduction * shape[2]), jnp.minimum(own[:, 1], reduction * shape[1])


def _grid(
    boxes: Boxes, extents: Extents, reach_m: Float[Array, "drones"], reduction: int, ring: float
) -> _Grid:
    """The finest level at which ring and search region fit into a window about the expected position."""
    half_px = jnp.maximum(boxes.x_half, boxes.y_half)
    # Half length of the drone that appears as the larger half length of its ellipse: it gives pixels per metre.
    half_m = jnp.sqrt(jnp.maximum(jnp.maximum(extents.s_xx, extents.s_yy), 1e-6))
    wanted = (ring * half_px + reach_m[:, None] * half_px / half_m) / reduction
    # The expected middle lies anywhere in the pixel to the right of the window's middle: one pixel less on that side.
    level = jnp.ceil(jnp.log2(jnp.maximum(wanted, 1.0) / (SIDE / 2 - 1)))
    level = jnp.where(boxes.in_front, jnp.clip(level, 0, NUM_LEVELS - 1), 0).astype(jnp.int32)

    def line(middle_px: Array) -> Array:
        # A drone behind the camera gets a window outside of the image, where there is no foreground.
        middle = jnp.where(boxes.in_front, middle_px, -1e5) / _pixel_px(level, reduction)
        first = jnp.clip(jnp.floor(middle), -1e5, 1e5).astype(jnp.int32) - SIDE // 2
        return first[..., None] + jnp.arange(SIDE)

    return _Grid(level, line(boxes.y_middle), line(boxes.x_middle))


def _pixel_px(level: Int[Array, "drones cameras"], reduction: int) -> Float[Array, "drones cameras"]:
    """Pixels of the image per pixel of a level, along each side."""
    return (reduction << level).astype(jnp.float32)


def _read(coverage: Coverage, grid: _Grid) -> Int[Array, "drones cameras side side"]:
    """The windows' pixels: means, rounded once from exact sums; 0 outside of the image and its padding."""
    step = 2 ** (NUM_LEVELS - 1)
    num_cameras, height, width = coverage.shape
    none = jnp.zeros(grid.row.shape + grid.column.shape[-1:], jnp.int32)

    # A branch makes each level once: XLA on a CPU would else compute it again for every pixel that is read.
    def halved() -> Array:
        # Boxes end at the image's border, which may lie inside a coarse pixel: beyond it the image is repeated.
        beyond = [(0, 0), (0, -height % step), (0, -width % step)]
        return _halved(jnp.pad(coverage, beyond, mode="edge"))

    shape = (num_cameras, (height + -height % step) // 2, (width + -width % step) // 4)
    two = jax.lax.cond((grid.level > 0).any(), halved, lambda: jnp.zeros(shape, jnp.uint32))

    def with_level(number: int, level: Array, value: Array) -> Array:
        value = jnp.where(grid.is_at(number), _mean(grid.pixels(level, number), number), value)
        if number + 1 == NUM_LEVELS:
            return value

        def with_coarser() -> Array:
            rows = level[:, 0::2] + level[:, 1::2]
            return with_level(number + 1, rows[..., 0::2] + rows[..., 1::2], value)

        return jax.lax.cond((grid.level > number).any(), with_coarser, lambda: value)

    def coarse() -> Array:
        rows = two[:, 0::2] + two[:, 1::2]
        return with_level(2, (rows & 0xFFFF) + (rows >> 16), none)

    # Only drones that are very near have coarser windows.
    value = jax.lax.cond((grid.level > 1).any(), coarse, lambda: none)
    value = jnp.where(grid.is_at(1), _mean(grid.pixels(two, 1, per_word=2), 1), value)
    value = jnp.where(grid.is_at(0), grid.pixels(coverage, 0), value)
    rows, columns = (((side + -side % step) >> grid.level)[..., None] for side in (height, width))
    row_inside, column_inside = (
        (grid.row >= 0) & (grid.row < rows),
        (grid.column >= 0) & (grid.column < columns),
    )
    return jnp.where(row_inside[..., None] & column_inside[..., None, :], value, 0)


def _halved(image: UInt8[Array, "cameras height width"]) -> UInt32[Array, "cameras rows words"]:
    """Sums of 2 x 2 pixels: two sums in each word, of which the lower half is the left one.

    Neighbours are added as parts of one word, because XLA on a CPU reads every other number of an array slowly.
    """
    four = jax.lax.bitcast_convert_type(image.reshape(*image.shape[:2], -1, 4), jnp.uint32)
    two = (four & 0x00FF00FF) + ((four >> 8) & 0x00FF00FF)
    return two[:, 0::2] + two[:, 1::2]


def _mean(total: Array, level: int) -> Array:
    """Means of the pixels that a pixel of a level holds, rounded, from their sums."""
    return (total + (1 << 2 * level >> 1)) >> 2 * level


def _occluded(occluders: Occluders, boxes: Boxes, at_px: Middles) -> Bool[Array, "drones cameras side side"]:
    """The pixels whose middles other drones may cover and that are not in the drone's core."""
    own = [of[..., None, None] for of in (boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half)]
    beyond_core = ellipse_distance2(*at_px, *own) >= CORE_SCALE**2
    return occluders.cover(*at_px).any(axis=0) & beyond_core


def _without_shadows(
    value: Int[Array, "drones cameras side side"],
    coverage: Coverage,
    extents: Extents,
    occluders: Occluders,
    expected: ExpectedDrones,
    at_px: Middles,
    reduction: int,
) -> Int[Array, "drones cameras side side"]:
    """The windows, with no more foreground than usual where low drones stand in front of shadows."""
    assert expected.occluding is not None
    assert expected.floor_z_m is not None
    floor_z_m = expected.floor_z_m
    low = expected.occluding & is_low(expected.position_m, extents.size_m, floor_z_m)

    def with_usual_foreground() -> Array:
        # No drone is inside of the floor. A drone expected there would hide its own shadow.
        least_m = floor_z_m + extents.size_m[:, 2] / 2
        above_m = jnp.asarray(expected.position_m).at[:, 2].max(least_m)
        boxes = project_boxes(extents, above_m)
        view = FloorView(extents, boxes, occluders, above_m, floor_z_m)
        dark = shadowed_pixels(coverage, view, at_px, reduction)
        usual = jnp.round(FULL * _usual_share(boxes, at_px)).astype(value.dtype)
        return jnp.where(dark & low[:, None, None, None], jnp.minimum(value, usual), value)

    # Mostly all drones are high, and the windows stay as they are.
    return jax.lax.cond(low.any(), with_usual_foreground, lambda: value)


def _usual_share(boxes: Boxes, at_px: Middles) -> Float[Array, "drones cameras side side"]:
    """Share of each pixel that is foreground of a usual drone in these boxes."""
    x_px, y_px = at_px

    def off(at_px: Array, middle: Array, half: Array) -> Array:
        return jnp.abs(at_px - middle[..., None, None]) / jnp.maximum(half, 1e-3)[..., None, None]

    farther = jnp.maximum(off(x_px, boxes.x_middle, boxes.x_half), off(y_px, boxes.y_middle, boxes.y_half))
    return jnp.clip(_EMPTY - farther, 0, 1)
