"""Occlusion: the foreground in a drone's window that other drones are expected to cover.

Every other drone is taken to cover an ellipse a little larger than its own. Foreground in that ellipse says nothing
about this drone, except in the core of this drone's own ellipse, which this drone is expected to cover itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import Boxes
from psotrack.support.array_types import Array

#: Largest number of other drones that are considered per drone and camera: those whose ellipses are nearest.
NUM_NEIGHBOURS = 3
#: Scale of the ellipse that an occluding drone is taken to cover: outlines of drones are no ellipses.
OCCLUDER_SCALE = 1.15
#: Scale of the ellipse in which this drone's own foreground always counts.
CORE_SCALE = 0.7
#: Points of an ellipse that are tested for occlusion: a power of two, so that shares of the points are exact.
_NUM_POINTS = 128


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Occluders:
    """Ellipses of other drones that may cover each drone in each camera, nearest first.

    Attributes:
        boxes: (ranks, drones, cameras), the boxes about the ellipses.
        exists: (ranks, drones, cameras), whether there is an ellipse of this rank.
    """

    boxes: Boxes
    exists: Bool[Array, "ranks drones cameras"]

    def cover(
        self, x_px: Float[Array, "drones cameras *#points"], y_px: Float[Array, "drones cameras *#points"]
    ) -> Bool[Array, "drones cameras *points"]:
        """Which image points, several per drone and camera, lie in one of the ellipses."""
        inner = (slice(None),) * 2 + (None,) * (x_px.ndim - 2)
        boxes = self.boxes
        covered: Array = jnp.zeros(np.broadcast_shapes(x_px.shape, y_px.shape), bool)
        # One rank after the other: XLA on a CPU computes a reduction over ranks number by number.
        for rank in range(len(self.exists)):
            ellipse = boxes.x_middle, boxes.y_middle, 1 / boxes.x_half, 1 / boxes.y_half, self.exists
            x_middle, y_middle, x_per_half, y_per_half, exists = (of[rank][inner] for of in ellipse)
            across, along = (x_px - x_middle) * x_per_half, (y_px - y_middle) * y_per_half
            covered |= exists & (jnp.square(across) + jnp.square(along) < 1)
        return covered


def ellipse_distance2(
    x_px: Array, y_px: Array, x_middle: Array, y_middle: Array, x_half: Array, y_half: Array
) -> Array:
    """Squared distance from an ellipse's middle in units of its half lengths: 1 is on the ellipse."""
    return jnp.square((x_px - x_middle) / x_half) + jnp.square((y_px - y_middle) / y_half)


def find_occluders(
    boxes: Boxes, *, occluding: Bool[Array, "drones"], pixel_px: Float[Array, "drones cameras"]
) -> Occluders:
    """The ellipses of other drones that may cover each drone in each camera.

    Args:
        boxes: boxes of the drones at their expected positions.
        occluding: (drones,), whether a drone's expected position is certain enough to occlude other drones.
        pixel_px: image pixels per pixel of the drone's window. An ellipse covers every pixel that it touches.
    """
    drones = occluding.shape[0]
    order, exists = _nearest(boxes, occluding & ~jnp.eye(drones, dtype=bool), min(NUM_NEIGHBOURS, drones - 1))

    def of_order(of: Array) -> Array:
        return jnp.take_along_axis(of[:, None], order, axis=0)

    near: Boxes = jax.tree.map(of_order, boxes)
    x_half, y_half = (OCCLUDER_SCALE * half + pixel_px / 2 for half in (near.x_half, near.y_half))
    return Occluders(replace(near, x_half=x_half, y_half=y_half), exists)


def unoccluded_share(occluders: Occluders, boxes: Boxes) -> Float[Array, "drones cameras"]:
    """Share of each drone's ellipse that no other drone covers, however small the ellipse is in the image."""
    # Points are spread evenly over the disc (Vogel's spiral).
    rank = np.arange(_NUM_POINTS)
    radius, angle = np.sqrt((rank + 0.5) / _NUM_POINTS), np.pi * (3 - 5**0.5) * rank
    x_px, y_px = (
        middle[..., None] + half[..., None] * jnp.asarray(along, jnp.float32)
        for middle, half, along in (
            (boxes.x_middle, boxes.x_half, radius * np.cos(angle)),
            (boxes.y_middle, boxes.y_half, radius * np.sin(angle)),
        )
    )
    covered = occluders.cover(x_px, y_px)
    return 1 - jnp.sum(covered, axis=-1, dtype=jnp.float32) / _NUM_POINTS


def _nearest(
    boxes: Boxes, occluding: Bool[Array, "drones others"], ranks: int
) -> tuple[Int[Array, "ranks drones cameras"], Bool[Array, "ranks drones cameras"]]:
    """For every drone and camera the nearest occluding drones, and whether there is one of each rank."""

    def gap2(middle: Array, half: Array) -> Array:
        return jnp.square((middle - middle[:, None]) / jnp.maximum(half[:, None] + half, 1e-3))

    gap = gap2(boxes.x_middle, boxes.x_half) + gap2(boxes.y_middle, boxes.y_half)
    gap = jnp.where(occluding[..., None] & boxes.in_front, gap, jnp.inf)
    order = jnp.argsort(gap, axis=1)[:, :ranks]
    exists = jnp.isfinite(jnp.take_along_axis(gap, order, axis=1))
    return jnp.swapaxes(order, 0, 1), jnp.swapaxes(exists, 0, 1)
