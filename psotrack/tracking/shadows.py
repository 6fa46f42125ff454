"""Which foreground may be a shadow on the floor: what all cameras together say of the floor below a drone.

Nobody says where the lamps hang, so nobody knows where shadows fall. But they lie on the floor, and a point of it is in
shadow for all cameras alike, or for none: what is foreground wherever it is seen past the drones is a shadow, a drone
above the floor is not. This is the plane-sweep of R. T. Collins (CVPR 1996) with one plane, as crowds are found on
their ground plane (Khan and Shah, ECCV 2006), the other way about.

Only drones that are low are looked at: the shadow of one that is high is clear of it.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack._typing import Array, Coverage, Positions
from psotrack.geometry import NEAR_M, Boxes, Camera, Extents, distort, project
from psotrack.tracking.occlusion import CLAIM, Claims, ellipse_distance2

#: A drone that is less high above the floor than so many times its width is low.
LOW = 1.0
#: Of the floor so much is looked at, to every side beyond the drone, in heights of the drone: lamps that stand no lower
#: than at 45 degrees cast no farther.
CAST = 1.0
#: Of 255: what covers less of a pixel does not darken it. Shadows may have been given less weight than drones.
_FOREGROUND = 64
#: Cells of that floor, along each side: of two to four centimetres, as much as a pixel of the silhouettes sees of it.
_CELLS = 32
#: Middles of the cells, -1..1 from the middle to the border: (cells, 2).
_CELL_XY = (np.stack(np.meshgrid(*[np.arange(_CELLS)] * 2), axis=-1).reshape(-1, 2) + 0.5) * 2 / _CELLS - 1
#: Iterations that undo a lens: each makes the error several times smaller.
_UNBENDINGS = 6


def low(
    position_m: Float[Array, "*batch 3"], size_m: Float[Array, "*#batch 3"], floor_z_m: Float[Array, ""]
) -> Bool[Array, "*batch"]:
    """Whether a drone is so low that its shadow may touch it in the images."""
    return position_m[..., 2] - floor_z_m < LOW * size_m[..., 0]


def shadowed(
    coverage: Coverage,
    seen: Extents,
    boxes: Boxes,
    neighbours: Claims,
    expected_m: Positions,
    pixels_px: tuple[Float[Array, "drones cameras 1 columns"], Float[Array, "drones cameras rows 1"]],
    *,
    floor_z_m: Float[Array, ""],
    reduction: int,
) -> Bool[Array, "drones cameras rows columns"]:
    """Which pixels of the drones' windows look at floor that is in shadow, whatever is before it.

    Args:
        coverage: (cameras, height, width), 0..255, silhouettes reduced by `reduction`.
        seen, expected_m, boxes: the drones, where they are expected, and their boxes there.
        neighbours: what else hides the floor.
        pixels_px: x and y in the image of the windows' pixels.
        floor_z_m: height of the floor.
    """
    height_m = jnp.maximum(expected_m[:, 2] - floor_z_m, 0.0)
    half_m = CLAIM * seen.size_m[:, 0] / 2 + CAST * height_m
    dark = _dark_cells(coverage, seen, boxes, neighbours, expected_m[:, :2], half_m, floor_z_m, reduction)
    x_m, y_m = _on_floor(seen.cameras, *pixels_px, floor_z_m)

    def cell(at_m: Array, middle_m: Array) -> Array:
        off = (at_m - middle_m[:, None, None, None]) / half_m[:, None, None, None]
        # Off the floor that is looked at is -1, whatever it is: also the sky's infinity.
        return jnp.where(jnp.abs(off) < 1, jnp.floor((off + 1) / 2 * _CELLS), -1).astype(jnp.int32)

    column, row = cell(x_m, expected_m[:, 0]), cell(y_m, expected_m[:, 1])
    inside = (column >= 0) & (row >= 0)
    first = _CELLS**2 * jnp.arange(len(expected_m))[:, None, None, None]
    index = first + jnp.where(inside, row * _CELLS + column, 0)
    return inside & jnp.reshape(dark, -1).at[index].get(mode="promise_in_bounds")


def _dark_cells(
    coverage: Coverage,
    seen: Extents,
    boxes: Boxes,
    neighbours: Claims,
    middle_m: Float[Array, "drones 2"],
    half_m: Float[Array, "drones"],
    floor_z_m: Float[Array, ""],
    reduction: int,
) -> Bool[Array, "drones cells"]:
    """The cells of the floor about every drone that are foreground for the cameras that see them past all drones.

    A cell that none sees is right below a drone that nearly stands on it, where no light gets.
    """
    off_m = half_m[:, None, None] * jnp.asarray(_CELL_XY, jnp.float32)
    xy_m = middle_m[:, None, :] + off_m
    floor_m = jnp.concatenate([xy_m, jnp.full_like(xy_m[..., :1], floor_z_m)], axis=-1)
    pixel, depth = project(seen.cameras, floor_m[:, :, None, :])
    x_px, y_px, depth = (jnp.swapaxes(of, 1, 2) for of in (pixel[..., 0] + 0.5, pixel[..., 1] + 0.5, depth))
    num_cameras, height, width = coverage.shape
    inside = (x_px >= 0) & (y_px >= 0) & (x_px < width * reduction) & (y_px < height * reduction)
    own = (boxes.x_middle, boxes.y_middle, CLAIM * boxes.x_half, CLAIM * boxes.y_half)
    hidden = ellipse_distance2(x_px, y_px, *(of[..., None] for of in own)) < 1
    hidden |= neighbours.cover(x_px, y_px).any(axis=0)
    clear = inside & (depth > NEAR_M) & ~hidden

    row, column = (
        jnp.clip(of, 0, last - 1).astype(jnp.int32)
        for of, last in ((y_px / reduction, height), (x_px / reduction, width))
    )
    foreground = coverage[jnp.arange(num_cameras)[:, None], row, column] >= _FOREGROUND
    votes = jnp.where(clear, jnp.where(foreground, 1, -1), 0)

    def add(total: jax.Array, vote: Any) -> tuple[jax.Array, None]:
        return total + vote, None

    # A loop, so that the sums are made once: XLA on CPU would make a sum anew for every pixel that reads it.
    return jax.lax.scan(add, jnp.zeros_like(votes[:, 0]), jnp.swapaxes(votes, 0, 1))[0] >= 0


def _on_floor(
    cameras: Camera,
    x_px: Float[Array, "drones cameras *#pixels"],
    y_px: Float[Array, "drones cameras *#pixels"],
    floor_z_m: Float[Array, ""],
) -> tuple[Float[Array, "drones cameras *pixels"], Float[Array, "drones cameras *pixels"]]:
    """x and y of the floor that pixels look at; infinite where that is the sky."""
    of_pixels = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None, None], cameras)
    K, R, centre_m = of_pixels.K, of_pixels.T_cam_world[..., :3, :3], of_pixels.centre_world
    v = (y_px - 0.5 - K[..., 1, 2]) / K[..., 1, 1]
    u = (x_px - 0.5 - K[..., 0, 2] - K[..., 0, 1] * v) / K[..., 0, 0]
    if cameras.dist.shape[-1]:
        bent_u, bent_v = u, v = jnp.broadcast_arrays(u, v)
        for _ in range(_UNBENDINGS):
            again_u, again_v = distort(of_pixels, u, v)
            u, v = u + (bent_u - again_u), v + (bent_v - again_v)
    x, y, z = (R[..., 0, i] * u + R[..., 1, i] * v + R[..., 2, i] for i in range(3))
    along = (floor_z_m - centre_m[..., 2]) / jnp.where(jnp.abs(z) < 1e-6, 1e-6, z)
    along = jnp.where(along > 0, along, jnp.inf)
    return centre_m[..., 0] + along * x, centre_m[..., 1] + along * y
