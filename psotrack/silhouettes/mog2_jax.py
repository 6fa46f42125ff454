"""MOG2 in JAX: the background subtraction that OpenCV computes on processors, for accelerators.

Method: Zivkovic, "Improved adaptive Gaussian mixture model for background subtraction", ICPR 2004; Zivkovic
and van der Heijden, "Efficient adaptive density estimation per image pixel", 2006; shadows: Prati, Mikic, Trivedi,
Cucchiara, "Detecting moving shadows", IEEE PAMI 2003. Each pixel has a mixture of up to `NUM_MODES` Gaussians of
colour, the modes, sorted by falling weight. The labels are those of OpenCV's `BackgroundSubtractorMOG2`, apart from
pixels that lie within a rounding error of a threshold.

All pixels do all steps, and masks choose the results, so that the arrays keep their shapes. Scans go from mode to mode:
without them XLA fuses all modes, and computes a mode anew for every value that depends on it, thousands of times.
`jax.vmap` over states and images treats several cameras at once. The pipeline does not use this module: whether it pays
on a GPU is unproven.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt8

from psotrack._typing import Array

#: Largest number of modes of a pixel, OpenCV's default.
NUM_MODES = 5

#: Labels of background, shadow and foreground, as OpenCV's.
BACKGROUND, SHADOW, FOREGROUND = 0, 127, 255

#: A sum of weights below this cannot be divided by: the rounding unit of float32, as in OpenCV.
_LEAST_TOTAL = 1.1920929e-07

#: What a scan carries from mode to mode, and what it reads of each mode.
_Arrays = tuple[Any, ...]
#: A number, outside or inside of a compiled function.
_Number = float | Float[Array, ""]
_Plane = Float[Array, "height width"]
_Mask = Bool[Array, "height width"]
_Colours = Float[Array, "3 height width"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mog2Params:
    """Parameters of MOG2, with OpenCV's names in brackets and OpenCV's defaults.

    Other values cause no new compilation.

    Attributes:
        learning_rate: weight of the new image, from 0 (nothing is learned) to below 1.
        var_threshold: squared Mahalanobis distance below which a pixel shows a mode of the background (VarThreshold).
        var_threshold_gen: squared Mahalanobis distance below which a pixel belongs to a mode (VarThresholdGen).
        background_ratio: the background is the first modes, until their weights sum up to this (BackgroundRatio).
        var_init, var_min, var_max: first, smallest and largest variance of a mode, squared grey levels (VarInit, ...).
        complexity_reduction: share of the images that a mode must explain to be kept (ComplexityReductionThreshold).
        shadow_threshold: a pixel of the background's hue is a shadow if it keeps this share of the background's
            brightness (ShadowThreshold).
    """

    learning_rate: _Number
    var_threshold: _Number = 16.0
    var_threshold_gen: _Number = 9.0
    background_ratio: _Number = 0.9
    var_init: _Number = 15.0
    var_min: _Number = 4.0
    var_max: _Number = 75.0
    complexity_reduction: _Number = 0.05
    shadow_threshold: _Number = 0.5


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mog2State:
    """The mixtures of all pixels of one camera, or of several cameras with an axis in front.

    The modes from `num_modes` on are unused.

    Attributes:
        weight: (modes, height, width), weights; those of the used modes sum up to 1.
        variance: (modes, height, width), variance of each channel, squared grey levels.
        mean: (modes, 3, height, width), mean colours, grey levels.
        num_modes: (height, width), number of used modes.
    """

    weight: Float[Array, "*cameras modes height width"]
    variance: Float[Array, "*cameras modes height width"]
    mean: Float[Array, "*cameras modes 3 height width"]
    num_modes: Int[Array, "*cameras height width"]


def mog2_init(height: int, width: int) -> Mog2State:
    """Mixtures without modes; the first image becomes the background, at any learning rate."""
    planes = jnp.zeros((NUM_MODES, height, width), jnp.float32)
    mean = jnp.zeros((NUM_MODES, 3, height, width), jnp.float32)
    return Mog2State(planes, planes, mean, jnp.zeros((height, width), jnp.int32))


def mog2_step(
    state: Mog2State, image: UInt8[Array, "height width 3"], params: Mog2Params
) -> tuple[Mog2State, UInt8[Array, "height width"]]:
    """Learn an image, and label its pixels `BACKGROUND`, `SHADOW` or `FOREGROUND`.

    Args:
        state: mixtures before the image.
        image: (height, width, 3) uint8, BGR.
        params: parameters; the learning rate may differ from image to image.

    Returns:
        The mixtures after the image, and the labels.
    """
    colour = jnp.moveaxis(image, -1, 0).astype(jnp.float32)
    state, fits, background = _learn_modes(state, colour, params)
    state = _with_new_mode(state, ~fits, colour, params)
    shadow = _is_shadow(state, colour, params)
    labels = jnp.where(background, BACKGROUND, jnp.where(shadow, SHADOW, FOREGROUND))
    return state, labels.astype(jnp.uint8)


def _learn_modes(state: Mog2State, colour: _Colours, params: Mog2Params) -> tuple[Mog2State, _Mask, _Mask]:
    """Update the first mode that fits, lower the other weights, and drop modes of next to no weight.

    Returns:
        The mixtures, whether a mode fits, and whether the pixel shows the background.
    """
    rate, least = params.learning_rate, params.learning_rate * params.complexity_reduction

    def learn(carry: _Arrays, mode: _Arrays) -> tuple[_Arrays, _Arrays]:
        num_modes, total, fitting, background = carry
        number, weight, variance, mean = mode
        used = number < num_modes
        candidate = used & (fitting < 0)
        difference = mean - colour
        distance = _dot(difference, difference)
        is_background = (total < params.background_ratio) & (distance < params.var_threshold * variance)
        here = candidate & (distance < params.var_threshold_gen * variance)
        learned = (1 - rate) * weight - least
        learned = jnp.where(here, learned + rate, learned)
        gain = jnp.where(here, rate / learned, 0)
        changed = jnp.clip(variance + gain * (distance - variance), params.var_min, params.var_max)
        # As in OpenCV, the last mode falls out of the mixture when any mode is dropped.
        dropped = used & (learned < least)
        learned = jnp.where(dropped, 0, learned)
        carry = (
            num_modes - dropped.astype(jnp.int32),
            jnp.where(used, total + learned, total),
            jnp.where(here, number, fitting),
            background | (candidate & is_background),
        )
        weight, variance = jnp.where(used, learned, weight), jnp.where(here, changed, variance)
        return carry, (weight, variance, mean - gain * difference)

    shape = state.num_modes.shape
    begin: _Arrays = (
        state.num_modes,
        jnp.zeros(shape, jnp.float32),
        jnp.full(shape, -1, jnp.int32),
        jnp.zeros(shape, bool),
    )
    modes: _Arrays = (jnp.arange(NUM_MODES), state.weight, state.variance, state.mean)
    carried, (weight, variance, mean) = jax.lax.scan(learn, begin, modes)
    num_modes, total, fitting, background = carried
    state = _with_moved_mode(Mog2State(weight, variance, mean, num_modes), fitting)
    scale = jnp.where(jnp.abs(total) > _LEAST_TOTAL, 1 / total, 0)
    weight = jnp.where(_numbers() < num_modes, state.weight * scale, state.weight)
    return replace(state, weight=weight), fitting >= 0, background


def _with_new_mode(state: Mog2State, new: _Mask, colour: _Colours, params: Mog2Params) -> Mog2State:
    """Add a mode of the pixel's colour where `new`, in place of the last mode if all are used."""
    rate, numbers = params.learning_rate, _numbers()
    # At learning rate 0 the mixtures stay as they are, but a pixel's first image always makes a mode.
    new = new & ((rate > 0) | (state.num_modes == 0))
    place = jnp.minimum(state.num_modes, NUM_MODES - 1)
    here, others = new & (numbers == place), new & (numbers < place)
    weight = jnp.where(others, state.weight * (1 - rate), state.weight)
    added = Mog2State(
        weight=jnp.where(here, jnp.where(place == 0, 1, rate), weight),
        variance=jnp.where(here, params.var_init, state.variance),
        mean=jnp.where(here[:, None], colour, state.mean),
        num_modes=jnp.where(new, place + 1, state.num_modes),
    )
    return _with_moved_mode(added, jnp.where(new, place, -1))


def _with_moved_mode(state: Mog2State, place: Int[Array, "height width"]) -> Mog2State:
    """Move the mode at `place` before the modes that weigh no more; the other modes are sorted. -1 moves none."""
    numbers = _numbers()
    weight = jnp.where(numbers == place, state.weight, 0).sum(axis=0)
    # Behind the last mode before it that weighs more.
    heavier = (numbers < place) & (weight < state.weight)
    target = jnp.where(place < 0, NUM_MODES, jnp.where(heavier, numbers + 1, 0).max(axis=0))
    source = jnp.where((numbers > target) & (numbers <= place), numbers - 1, numbers)
    source = jnp.where(numbers == target, place, source)
    # A gather takes a third of the time of masks, which XLA fuses with what comes before and after.
    return Mog2State(
        jnp.take_along_axis(state.weight, source, axis=0),
        jnp.take_along_axis(state.variance, source, axis=0),
        jnp.take_along_axis(state.mean, source[:, None], axis=0),
        state.num_modes,
    )


def _is_shadow(state: Mog2State, colour: _Colours, params: Mog2Params) -> _Mask:
    """Whether a pixel is a darker version of a mode of the background."""

    def search(carry: _Arrays, mode: _Arrays) -> tuple[_Arrays, None]:
        found, searched, total = carry
        number, weight, variance, mean = mode
        along, square = _dot(colour, mean), _dot(mean, mean)
        searched &= (number < state.num_modes) & (square > 0)
        brightness = along / jnp.where(square > 0, square, 1)
        off = brightness * mean - colour
        limit = params.var_threshold * variance * brightness * brightness
        darker = (along <= square) & (along >= params.shadow_threshold * square)
        found |= searched & darker & (_dot(off, off) < limit)
        total = total + weight
        return (found, searched & (total <= params.background_ratio), total), None

    shape = state.num_modes.shape
    begin: _Arrays = jnp.zeros(shape, bool), jnp.ones(shape, bool), jnp.zeros(shape, jnp.float32)
    modes: _Arrays = (jnp.arange(NUM_MODES), state.weight, state.variance, state.mean)
    (found, _, _), _ = jax.lax.scan(search, begin, modes)
    return found


def _numbers() -> Int[Array, "modes 1 1"]:
    """Number of each mode, which broadcasts against images."""
    return jnp.arange(NUM_MODES)[:, None, None]


def _dot(first: _Colours, second: _Colours) -> _Plane:
    product = first * second
    return product[0] + product[1] + product[2]
