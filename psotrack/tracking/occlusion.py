"""Whose foreground it is: what neighbours are expected to cover of a drone's window.

A neighbour claims its ellipse, a little enlarged. Claimed foreground is no evidence of this drone, except in the core
of its own ellipse, which it is expected to cover itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack._typing import Array
from psotrack.geometry import Boxes

#: Other drones that are looked at, per drone and camera: those whose ellipses come nearest.
NUM_NEIGHBOURS = 3
#: What a drone claims is that much larger than its ellipse along each axis: outlines are no ellipses.
CLAIM = 1.15
#: Where this drone is expected to cover what is claimed: its ellipse, that much smaller along each axis.
CORE = 0.7
#: Points of an ellipse that are asked about: a power of two, so that shares of them are exact.
_NUM_POINTS = 128


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Claims:
    """The ellipses that claim from every drone in every camera, nearest first.

    Attributes:
        x_middle, y_middle, x_half, y_half: in pixels of the image.
        near: whether there is one of this rank.
    """

    x_middle: Float[Array, "ranks drones cameras"]
    y_middle: Float[Array, "ranks drones cameras"]
    x_half: Float[Array, "ranks drones cameras"]
    y_half: Float[Array, "ranks drones cameras"]
    near: Bool[Array, "ranks drones cameras"]

    def cover(
        self, x_px: Float[Array, "drones cameras *#points"], y_px: Float[Array, "drones cameras *#points"]
    ) -> Bool[Array, "ranks drones cameras *points"]:
        """Which points of the image, some for every drone and camera, are in each of the ellipses."""
        inner = (slice(None),) * 3 + (None,) * (x_px.ndim - 2)
        distance2 = ellipse_distance2(
            x_px, y_px, self.x_middle[inner], self.y_middle[inner], self.x_half[inner], self.y_half[inner]
        )
        return (distance2 < 1) & self.near[inner]


def ellipse_distance2(
    x_px: Array, y_px: Array, x_middle: Array, y_middle: Array, x_half: Array, y_half: Array
) -> Array:
    """Squared distance from an ellipse's middle, in its halves: 1 is on the ellipse."""
    return jnp.square((x_px - x_middle) / x_half) + jnp.square((y_px - y_middle) / y_half)


def claims_on(
    boxes: Boxes, *, claiming: Bool[Array, "drones"], pixel_px: Float[Array, "drones cameras"]
) -> Claims:
    """What is claimed from each drone in each camera.

    Args:
        boxes: of the drones where they are expected.
        claiming: (drones,), whether a drone's expected place is good enough to claim foreground.
        pixel_px: pixels of the image per pixel of the drone's window. A claim takes every pixel that it touches.
    """
    drones = claiming.shape[0]
    order, near = _nearest(boxes, claiming & ~jnp.eye(drones, dtype=bool), min(NUM_NEIGHBOURS, drones - 1))

    def of_order(of: Array) -> Array:
        return jnp.take_along_axis(of[:, None], order, axis=0)

    return Claims(
        x_middle=of_order(boxes.x_middle),
        y_middle=of_order(boxes.y_middle),
        x_half=of_order(CLAIM * boxes.x_half) + pixel_px / 2,
        y_half=of_order(CLAIM * boxes.y_half) + pixel_px / 2,
        near=near,
    )


def clear_share(claims: Claims, boxes: Boxes) -> Float[Array, "drones cameras"]:
    """Share of each drone's ellipse that no other drone claims, however small it is in the image."""
    # Evenly spread over the disc (Vogel's spiral).
    rank = np.arange(_NUM_POINTS)
    radius, angle = np.sqrt((rank + 0.5) / _NUM_POINTS), np.pi * (3 - 5**0.5) * rank
    x_px, y_px = (
        middle[..., None] + half[..., None] * jnp.asarray(along, jnp.float32)
        for middle, half, along in (
            (boxes.x_middle, boxes.x_half, radius * np.cos(angle)),
            (boxes.y_middle, boxes.y_half, radius * np.sin(angle)),
        )
    )
    taken = jnp.any(claims.cover(x_px, y_px), axis=0)
    return 1 - jnp.sum(taken, axis=-1, dtype=jnp.float32) / _NUM_POINTS


def _nearest(
    boxes: Boxes, claiming: Bool[Array, "drones others"], ranks: int
) -> tuple[Int[Array, "ranks drones cameras"], Bool[Array, "ranks drones cameras"]]:
    """Which of the others that claim come nearest to every drone in every camera, and whether there are as many."""

    def gap2(middle: Array, half: Array) -> Array:
        return jnp.square((middle - middle[:, None]) / jnp.maximum(half[:, None] + half, 1e-3))

    gap = gap2(boxes.x_middle, boxes.x_half) + gap2(boxes.y_middle, boxes.y_half)
    gap = jnp.where(claiming[..., None] & boxes.in_front, gap, jnp.inf)
    order = jnp.argsort(gap, axis=1)[:, :ranks]
    near = jnp.isfinite(jnp.take_along_axis(gap, order, axis=1))
    return jnp.swapaxes(order, 0, 1), jnp.swapaxes(near, 0, 1)
