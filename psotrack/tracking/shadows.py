"""Shadows on the floor: which foreground near a low drone may be the drone's shadow.

The lamps are not known, so the places of shadows are not known either. But a shadow lies on the floor: a point of the
floor is in shadow for all cameras or for none. Foreground that all cameras see at the same point of the floor, where
no drone hides that point, is a shadow. This is the plane sweep of R. T. Collins (CVPR 1996) with one plane, as used for
crowds on a ground plane (Khan and Shah, ECCV 2006), here in order to remove what lies on the plane.

Only low drones are examined: the shadow of a high drone is far from the drone in the images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack._typing import Array, Coverage, Positions
from psotrack.geometry import NEAR_M, Boxes, Camera, Extents, project_visible, undistort_approximately
from psotrack.tracking.occlusion import OCCLUDER_SCALE, Occluders, ellipse_distance2

#: A drone is low if its height above the floor is less than this many times its width.
LOW = 1.0
#: Extent of the floor that is examined on every side of the drone, as a multiple of the drone's height above the floor:
#: a lamp that stands at 45 degrees or more casts the shadow no farther.
CAST = 1.0
#: Coverage, of 255, from which on a cell counts as foreground. Settings may give shadows less weight than drones.
_FOREGROUND = 64
#: Cells of the examined floor along each side: two to four centimetres, about one pixel of the silhouettes.
_CELLS = 32
#: (cells, 2), middles of the cells, from -1 to 1.
_CELL_XY = (np.stack(np.meshgrid(*[np.arange(_CELLS)] * 2), axis=-1).reshape(-1, 2) + 0.5) * 2 / _CELLS - 1


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FloorView:
    """The drones at their expected positions above the floor, in all cameras.

    Attributes:
        extents: the drones' extents in the cameras.
        boxes: the drones' boxes at the expected positions.
        occluders: other drones that hide the floor.
        position_m: (drones, 3), expected positions, metres.
        floor_z_m: height of the floor, metres.
    """

    extents: Extents
    boxes: Boxes
    occluders: Occluders
    position_m: Positions
    floor_z_m: Float[Array, ""]


def is_low(
    position_m: Float[Array, "*batch 3"], size_m: Float[Array, "*#batch 3"], floor_z_m: Float[Array, ""]
) -> Bool[Array, "*batch"]:
    """Whether a drone is so low that its shadow may touch the drone in the images."""
    return position_m[..., 2] - floor_z_m < LOW * size_m[..., 0]


def shadowed_pixels(
    coverage: Coverage,
    view: FloorView,
    pixels_px: tuple[Float[Array, "drones cameras 1 columns"], Float[Array, "drones cameras rows 1"]],
    reduction: int,
) -> Bool[Array, "drones cameras rows columns"]:
    """Which pixels of the drones' windows look at floor that is in shadow.

    Args:
        coverage: (cameras, height, width), 0..255, silhouettes reduced by `reduction`.
        view: the drones above the floor.
        pixels_px: x and y of the windows' pixels in the image.
        reduction: image pixels per silhouette pixel, along each side.
    """
    middle_m = view.position_m[:, :2]
    height_m = jnp.maximum(view.position_m[:, 2] - view.floor_z_m, 0.0)
    half_m = OCCLUDER_SCALE * view.extents.size_m[:, 0] / 2 + CAST * height_m
    dark = _dark_cells(coverage, view, middle_m, half_m, reduction)
    x_m, y_m = _on_floor(view.extents.cameras, *pixels_px, view.floor_z_m)

    def cell(at_m: Array, centre_m: Array) -> Array:
        off = (at_m - centre_m[:, None, None, None]) / half_m[:, None, None, None]
        # -1 stands for points outside of the examined floor, also for points at infinity.
        return jnp.where(jnp.abs(off) < 1, jnp.floor((off + 1) / 2 * _CELLS), -1).astype(jnp.int32)

    column, row = cell(x_m, middle_m[:, 0]), cell(y_m, middle_m[:, 1])
    inside = (column >= 0) & (row >= 0)
    first = _CELLS**2 * jnp.arange(len(middle_m))[:, None, None, None]
    index = first + jnp.where(inside, row * _CELLS + column, 0)
    return inside & jnp.reshape(dark, -1).at[index].get(mode="promise_in_bounds")


def _dark_cells(
    coverage: Coverage,
    view: FloorView,
    middle_m: Float[Array, "drones 2"],
    half_m: Float[Array, "drones"],
    reduction: int,
) -> Bool[Array, "drones cells"]:
    """Cells of the floor around every drone that are foreground in at least half of the cameras with a free view.

    A cell that no camera sees is directly below a drone that nearly stands on it, where no light arrives: it is dark.
    """
    off_m = half_m[:, None, None] * jnp.asarray(_CELL_XY, jnp.float32)
    xy_m = middle_m[:, None, :] + off_m
    floor_m = jnp.concatenate([xy_m, jnp.full_like(xy_m[..., :1], view.floor_z_m)], axis=-1)
    pixel, depth = project_visible(view.extents.cameras, floor_m[:, :, None, :])
    x_px, y_px, depth = (jnp.swapaxes(of, 1, 2) for of in (pixel[..., 0] + 0.5, pixel[..., 1] + 0.5, depth))
    num_cameras, height, width = coverage.shape
    inside = (x_px >= 0) & (y_px >= 0) & (x_px < width * reduction) & (y_px < height * reduction)
    boxes = view.boxes
    own = (boxes.x_middle, boxes.y_middle, OCCLUDER_SCALE * boxes.x_half, OCCLUDER_SCALE * boxes.y_half)
    hidden = ellipse_distance2(x_px, y_px, *(of[..., None] for of in own)) < 1
    hidden |= view.occluders.cover(x_px, y_px).any(axis=0)
    clear = inside & (depth > NEAR_M) & ~hidden

    row, column = (
        jnp.clip(jnp.nan_to_num(of), 0, last - 1).astype(jnp.int32)
        for of, last in ((y_px / reduction, height), (x_px / reduction, width))
    )
    foreground = coverage[jnp.arange(num_cameras)[:, None], row, column] >= _FOREGROUND
    votes = jnp.where(clear, jnp.where(foreground, 1, -1), 0)

    def add(total: jax.Array, vote: Any) -> tuple[jax.Array, None]:
        return total + vote, None

    # A scan makes the sums once: XLA on CPU would compute a plain sum anew for every pixel that reads it.
    return jax.lax.scan(add, jnp.zeros_like(votes[:, 0]), jnp.swapaxes(votes, 0, 1))[0] >= 0


def _on_floor(
    cameras: Camera,
    x_px: Float[Array, "drones cameras *#pixels"],
    y_px: Float[Array, "drones cameras *#pixels"],
    floor_z_m: Float[Array, ""],
) -> tuple[Float[Array, "drones cameras *pixels"], Float[Array, "drones cameras *pixels"]]:
    """x and y of the points of the floor that pixels look at; infinite where a pixel looks above the horizon, NaN
    where the lens shows nothing.
    """
    of_pixels = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None, None], cameras)
    K, R, centre_m = of_pixels.K, of_pixels.T_cam_world[..., :3, :3], of_pixels.centre_world
    v = (y_px - 0.5 - K[..., 1, 2]) / K[..., 1, 1]
    u = (x_px - 0.5 - K[..., 0, 2] - K[..., 0, 1] * v) / K[..., 0, 0]
    if cameras.dist.shape[-1]:
        u, v = undistort_approximately(of_pixels.dist, of_pixels.fisheye, u, v)
    x, y, z = (R[..., 0, i] * u + R[..., 1, i] * v + R[..., 2, i] for i in range(3))
    along = (floor_z_m - centre_m[..., 2]) / jnp.where(jnp.abs(z) < 1e-6, 1e-6, z)
    along = jnp.where(along > 0, along, jnp.inf)
    return centre_m[..., 0] + along * x, centre_m[..., 1] + along * y
