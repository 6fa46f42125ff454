"""A small convolutional network that finds drones: for each pixel whether it shows one, and for each drone its box.

In: a reduced frame and the learned background of its camera. Out, per pixel of the input the logit of "drone", and at
half of the input's size, per cell, the logit of "the middle of a drone is here" and the box (Zhou et al., Objects as
points, 2019). The network is an encoder with skips to a decoder (Ronneberger et al., U-Net, MICCAI 2015), with
dilated convolutions at an eighth of the input's size.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

#: Height and width of an input are multiples of this number of pixels.
MULTIPLE = 8
#: Pixels of the input per cell of the middles and boxes, along each side.
CELL_PX = 2
#: Channels at a half, a quarter and an eighth of the input's size.
_CHANNELS = (16, 32, 64)
#: Dilations of the convolutions at an eighth of the size: together they see the surroundings of a drone.
_DILATIONS = (1, 2, 4)
#: Grey levels of a difference from the background that count as 1; larger ones count as twice that at most.
_DIFFERENCE, _LARGEST_DIFFERENCE = 64.0, 2.0
#: Share of the cells with the middle of a drone before training: the loss then begins near its right size.
_PRIOR = 0.01
#: Logarithms of a box's half lengths in cells are within these limits: 0.05 cells to 400.
LOG_SIZE = (-3.0, 6.0)

Images = UInt8[Array, "images height width 3"]


class Found(NamedTuple):
    """What the network says of images.

    Attributes:
        pixel: (images, height, width), logit of "this pixel shows a drone".
        middle: (images, rows, columns), logit of "this cell has the middle of a drone's box".
        box: (images, rows, columns, 4), middle of the box from the middle of the cell along x and y, in cells, and
            logarithms of its half width and half height in cells; of use where there is a middle.
    """

    pixel: Float[Array, "images height width"]
    middle: Float[Array, "images rows columns"]
    box: Float[Array, "images rows columns 4"]


class Conv(eqx.Module):
    """A convolution of images whose channels come last, which XLA computes fastest on a CPU.

    Attributes:
        weight: (side, side, channels in, channels out).
        bias: (channels out,).
        stride, dilation: steps of the output and of the kernel, pixels.
    """

    weight: Float[Array, "side side inputs outputs"]
    bias: Float[Array, "outputs"]
    stride: int = eqx.field(static=True)
    dilation: int = eqx.field(static=True)

    def __init__(
        self,
        key: PRNGKeyArray,
        inputs: int,
        outputs: int,
        side: int = 3,
        *,
        stride: int = 1,
        dilation: int = 1,
        gain: float = 2.0,
    ) -> None:
        deviation = (gain / (side * side * inputs)) ** 0.5  # He et al., ICCV 2015
        self.weight = deviation * jax.random.normal(key, (side, side, inputs, outputs))
        self.bias = jnp.zeros(outputs)
        self.stride, self.dilation = stride, dilation

    def __call__(
        self, images: Float[Array, "images height width inputs"]
    ) -> Float[Array, "images _ _ outputs"]:
        """The images after the convolution."""
        return (
            jax.lax.conv_general_dilated(
                images,
                self.weight,
                window_strides=(self.stride,) * 2,
                padding=self.padding(images.shape[1:3]),
                rhs_dilation=(self.dilation,) * 2,
                dimension_numbers=("NHWC", "HWIO", "NHWC"),
            )
            + self.bias
        )

    def padding(self, size: tuple[int, ...]) -> list[tuple[int, int]]:
        """Pixels before and after the image along each side, the same for all sizes that the network takes."""
        whole = self.dilation * (self.weight.shape[0] - 1) + 1 - self.stride
        return [(whole // 2, whole - whole // 2)] * len(size)


class Network(eqx.Module):
    """The network; see the module."""

    enter: Conv
    down: tuple[Conv, ...]
    middle: Conv
    around: tuple[Conv, ...]
    up: tuple[Conv, ...]
    joined: tuple[Conv, ...]
    heads: Conv

    def __init__(self, key: PRNGKeyArray) -> None:
        keys = iter(jax.random.split(key, 12))
        half, quarter, eighth = _CHANNELS
        self.enter = Conv(next(keys), 6, half, stride=2)
        self.down = (
            Conv(next(keys), half, quarter, stride=2),
            Conv(next(keys), quarter, eighth, stride=2),
        )
        self.middle = Conv(next(keys), quarter, quarter)
        self.around = tuple(Conv(next(keys), eighth, eighth, dilation=each, gain=1.0) for each in _DILATIONS)
        self.up = (Conv(next(keys), eighth, quarter, 1), Conv(next(keys), quarter, half, 1))
        self.joined = (Conv(next(keys), quarter, quarter), Conv(next(keys), half, half))
        # Four pixels of a cell, its middle and its box.
        heads = Conv(next(keys), half, CELL_PX**2 + 5, 1, gain=0.1)
        prior = jnp.log(_PRIOR / (1 - _PRIOR))
        bias = heads.bias.at[: CELL_PX**2 + 1].set(prior).at[-2:].set(jnp.log(4.0))
        self.heads = eqx.tree_at(lambda conv: conv.bias, heads, bias)

    def __call__(self, images: Float[Array, "images height width 6"]) -> Found:
        """What inputs from `inputs_of` show."""
        half = jax.nn.relu(self.enter(images))
        quarter = jax.nn.relu(self.down[0](half))
        quarter = quarter + jax.nn.relu(self.middle(quarter))
        eighth = jax.nn.relu(self.down[1](quarter))
        for conv in self.around:
            eighth = eighth + jax.nn.relu(conv(eighth))
        quarter = jax.nn.relu(self.joined[0](quarter + _doubled(self.up[0](eighth))))
        half = jax.nn.relu(self.joined[1](half + _doubled(self.up[1](quarter))))
        heads = self.heads(half)
        pixels, middle, box = heads[..., :4], heads[..., 4], heads[..., 5:]
        log_size = jnp.clip(box[..., 2:], *LOG_SIZE)
        return Found(_spread(pixels), middle, jnp.concatenate([box[..., :2], log_size], axis=-1))


def untrained(seed: int = 0) -> Network:
    """A network before training."""
    return Network(jax.random.key(seed))


def inputs_of(
    image: Float[Array, "images height width 3"],
    background: Float[Array, "images height width 3"],
    is_known: Bool[Array, "images"],
) -> Float[Array, "images height width 6"]:
    """What the network sees: the image, and its difference from the background, which is 0 where it is not known.

    Args:
        image, background: (images, height, width, 3), BGR, grey levels.
        is_known: (images,), whether there is a background.
    """
    difference = jnp.clip((image - background) / _DIFFERENCE, -_LARGEST_DIFFERENCE, _LARGEST_DIFFERENCE)
    difference = jnp.where(is_known[:, None, None, None], difference, 0.0)
    return jnp.concatenate([image / 127.5 - 1.0, difference], axis=-1)


def _doubled(images: Float[Array, "images height width channels"]) -> Float[Array, "images _ _ channels"]:
    """Images of twice the size, each pixel four times."""
    count, height, width, channels = images.shape
    whole = jnp.broadcast_to(images[:, :, None, :, None], (count, height, 2, width, 2, channels))
    return whole.reshape(count, 2 * height, 2 * width, channels)


def _spread(cells: Float[Array, "images rows columns 4"]) -> Float[Array, "images _ _"]:
    """(images, height, width), the four channels of each cell at its four pixels (Shi et al., CVPR 2016)."""
    count, rows, columns, _ = cells.shape
    parts = cells.reshape(count, rows, columns, CELL_PX, CELL_PX)
    return parts.swapaxes(2, 3).reshape(count, rows * CELL_PX, columns * CELL_PX)
