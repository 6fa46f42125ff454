"""What the network learns: the share of each pixel that drones cover, and the middle and box of each drone."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from psotrack.foreground.network import CELL_PX, Found

#: Standard deviation of the bell about a drone's middle, as a share of the box's length, and at least, cells.
_BELL, _LEAST_BELL = 1 / 6, 0.6
#: A cell learns the box of a drone where the drone's bell is above this value.
_LEARNS_BOX = 0.4
#: Exponents of the focal loss (Law and Deng, CornerNet, ECCV 2018).
_FOCUS, _NEAR_MIDDLE = 2.0, 4.0
#: Weights of the middles and of the boxes beside the pixels.
_MIDDLE_WEIGHT, _BOX_WEIGHT = 0.5, 0.2
#: Pixels that count as covered in each image beside those that are, so that images without drones count too.
_LEAST_COVERED_PX = 30.0


class Targets(NamedTuple):
    """What images show.

    Attributes:
        covered: (images, height, width), share of each pixel that drones cover.
        counts: (images, height, width), whether `covered` is known.
        box_px: (images, drones, 4), xyxy of each drone's visible part, pixels of the input; NaN for no drone.
    """

    covered: Float[Array, "images height width"]
    counts: Bool[Array, "images height width"]
    box_px: Float[Array, "images drones 4"]


class Losses(NamedTuple):
    """Parts of the loss, each a mean over the images."""

    pixel: Float[Array, ""]
    middle: Float[Array, ""]
    box: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """What the training minimises."""
        return self.pixel + _MIDDLE_WEIGHT * self.middle + _BOX_WEIGHT * self.box


def losses(found: Found, targets: Targets) -> Losses:
    """How far from the truth the network's output is.

    The pixels' loss is the cross entropy, so that the probability of a pixel that drones cover by a half is a half.
    """
    count = len(targets.covered)
    entropy = -targets.covered * jax.nn.log_sigmoid(found.pixel)
    entropy -= (1 - targets.covered) * jax.nn.log_sigmoid(-found.pixel)
    covered = jnp.where(targets.counts, targets.covered, 0.0)
    scale = covered.sum() + _LEAST_COVERED_PX * count
    pixel = jnp.where(targets.counts, entropy, 0.0).sum() / scale
    bells, boxes = bells_and_boxes(targets.box_px, found.middle.shape[1:])
    is_drone = jnp.isfinite(targets.box_px).all(axis=-1)
    bell = bells.max(axis=1)
    share, rest = jax.nn.sigmoid(found.middle), jax.nn.sigmoid(-found.middle)
    is_middle = bell == 1
    focal = jnp.where(
        is_middle,
        -(rest**_FOCUS) * jax.nn.log_sigmoid(found.middle),
        -((1 - bell) ** _NEAR_MIDDLE) * share**_FOCUS * jax.nn.log_sigmoid(-found.middle),
    )
    middle = focal.sum() / (is_drone.sum().astype(jnp.float32) + count)
    nearest = bells.argmax(axis=1)
    wanted = jnp.take_along_axis(boxes, nearest[:, None, ..., None], axis=1)[:, 0]
    learns = bell > _LEARNS_BOX
    error = jnp.abs(found.box - jnp.where(learns[..., None], wanted, found.box)).sum(axis=-1)
    return Losses(pixel, middle, error.sum() / (learns.sum().astype(jnp.float32) + 1))


def bells_and_boxes(
    box_px: Float[Array, "images drones 4"], shape: tuple[int, ...]
) -> tuple[Float[Array, "images drones rows columns"], Float[Array, "images drones rows columns 4"]]:
    """For each drone a bell about its middle, 1 in the cell of the middle, and its box as each cell tells it.

    A drone that is none has a bell of 0.

    Args:
        box_px: (images, drones, 4), xyxy, pixels of the input; NaN for no drone.
        shape: numbers of rows and columns of cells.
    """
    is_drone = jnp.isfinite(box_px).all(axis=-1)[..., None, None]
    low, high = box_px[..., None, None, :2] / CELL_PX, box_px[..., None, None, 2:] / CELL_PX
    middle, half = (low + high) / 2, (high - low) / 2
    sides = [jnp.arange(each, dtype=jnp.float32) + 0.5 for each in shape]
    cells = jnp.stack(jnp.meshgrid(*sides, indexing="ij")[::-1], axis=-1)
    away = middle - cells
    deviation = jnp.maximum(2 * _BELL * half, _LEAST_BELL)
    bell = jnp.exp(-0.5 * jnp.square(away / deviation).sum(axis=-1))
    is_in_cell = (jnp.floor(middle) + 0.5 == cells).all(axis=-1)
    bell = jnp.where(is_drone, jnp.where(is_in_cell, 1.0, jnp.minimum(bell, 0.999)), 0.0)
    log_half = jnp.broadcast_to(jnp.log(jnp.maximum(half, 1e-3)), away.shape)
    boxes = jnp.concatenate([away, log_half], axis=-1)
    return bell, jnp.where(is_drone[..., None], boxes, 0.0)
