"""Random changes of the frames that the network learns from, so that it is at home in pictures that it has not seen.

Each image of a batch gets changes of its own: another scene behind its drones, other paint, objects that are no drones,
drones that the background shows too, ghosts of drones in the background, other light, a camera that trembles, blur and
noise.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt8

from psotrack.foreground.learning.loss import Targets
from psotrack.foreground.network import inputs_of

#: Probabilities of the changes.
_OTHER_SCENE, _TEXTURE, _PAINT, _OBJECTS, _KNOWN = 0.4, 0.1, 0.4, 0.5, 0.8
_HOVERS, _GHOST, _TREMBLES, _BLUR, _LIGHT_OF_FRAME = 0.2, 0.15, 0.3, 0.3, 0.5
#: Number of objects that are no drones, and limits of their half lengths as shares of the image's side.
_NUM_OBJECTS, _OBJECT_SIDE = 2, (0.01, 0.15)
#: Standard deviations of logarithms: of paint, of light in image and background, of gamma, of light in the image alone.
_PAINT_SPREAD, _LIGHT_SPREAD, _GAMMA_SPREAD, _FRAME_SPREAD = 0.5, 0.25, 0.15, 0.06
#: Largest tremble, pixels, and largest noise, grey levels.
_TREMBLE_PX, _NOISE = 2, 6.0


_Arrays = Array | np.ndarray


class Batch(NamedTuple):
    """Parts of frames of one size, as they are stored.

    Attributes:
        image, background: BGR; the background is of use where `is_known`.
        covered: share of each pixel that drones cover, 0 to 255.
        counts: whether `covered` is known.
        box_px: xyxy of each drone, pixels; NaN for no drone.
        is_known: whether the background is known.
    """

    image: UInt8[_Arrays, "images height width 3"]
    background: UInt8[_Arrays, "images height width 3"]
    covered: UInt8[_Arrays, "images height width"]
    counts: Bool[_Arrays, "images height width"]
    box_px: Float[_Arrays, "images drones 4"]
    is_known: Bool[_Arrays, "images"]


def plain(batch: Batch) -> tuple[Float[Array, "images height width 6"], Targets]:
    """Inputs and targets without changes."""
    image, background, covered, counts, box_px, is_known = map(jnp.asarray, batch)
    inputs = inputs_of(image.astype(jnp.float32), background.astype(jnp.float32), is_known)
    return inputs, Targets(covered.astype(jnp.float32) / 255, counts, box_px)


def varied(key: Key[Array, ""], batch: Batch) -> tuple[Float[Array, "images height width 6"], Targets]:
    """Inputs and targets with random changes. The key is consumed."""
    stored, old, shown, counts, box_px, has_background = map(jnp.asarray, batch)
    keys = iter(jax.random.split(key, 24))
    count, height, width, _ = stored.shape

    def happens(probability: float) -> Bool[Array, "images 1 1 1"]:
        return jax.random.bernoulli(next(keys), probability, (count, 1, 1, 1))

    image, background = stored.astype(jnp.float32), old.astype(jnp.float32)
    covered = (shown.astype(jnp.float32) / 255)[..., None]
    is_known = has_background[:, None, None, None]
    background = jnp.where(is_known, background, image)
    # Other scenes: what differs from the old background stays, drones, their shadows and noise.
    other = jnp.roll(background, 1, axis=0)[:, :, ::-1]
    scene = jnp.where(is_known & happens(_OTHER_SCENE), other, background)
    scene = jnp.where(is_known & happens(_TEXTURE), _texture(next(keys), count, height, width), scene)
    image = jnp.clip(image + (1 - covered) * (scene - background), 0, 255)
    background = scene
    # Other paint.
    drone = image - (1 - covered) * background
    paint = jnp.exp(_PAINT_SPREAD * jax.random.normal(next(keys), (count, 1, 1, 3)))
    painted = jnp.clip(drone * paint, 0, 255 * covered)
    image = jnp.where(is_known & happens(_PAINT), image - drone + painted, image)
    # A drone that the background shows too, and one that has left its place.
    near = _largest_around(covered) > 0
    hovers = is_known & happens(_HOVERS)
    background = jnp.where(hovers & near, image, background)
    ghost = is_known & ~hovers & happens(_GHOST)
    away, part = (jnp.roll(each, (height // 3, -width // 4), axis=(1, 2)) for each in (drone, covered))
    background = jnp.where(ghost, away + (1 - part) * background, background)
    # Objects that are no drones, behind the drones.
    fill = jnp.roll(image, 2, axis=0)[:, ::-1]
    for _ in range(_NUM_OBJECTS):
        inside = _object(next(keys), count, height, width) & happens(_OBJECTS)
        image = jnp.where(inside & (covered == 0), fill, image)
    # Light.
    light = jnp.exp(_LIGHT_SPREAD * jax.random.normal(next(keys), (count, 1, 1, 1)))
    light = light * jnp.exp(_FRAME_SPREAD * jax.random.normal(next(keys), (count, 1, 1, 3)))
    gamma = jnp.exp(_GAMMA_SPREAD * jax.random.normal(next(keys), (count, 1, 1, 1)))
    # As exponential and logarithm, which XLA computes many times faster than a power.
    image, background = (
        255 * light * jnp.exp(gamma * jnp.log(jnp.clip(each, 0.1, 255) / 255)) for each in (image, background)
    )
    of_frame = jnp.exp(_FRAME_SPREAD * jax.random.normal(next(keys), (count, 1, 1, 1)))
    image = jnp.where(happens(_LIGHT_OF_FRAME), image * of_frame, image)
    # The camera.
    shift = jax.random.randint(next(keys), (count, 2), -_TREMBLE_PX, _TREMBLE_PX + 1)
    shift = jnp.where(happens(_TREMBLES)[:, 0, 0], shift, 0)
    background = jax.vmap(lambda one, by: jnp.roll(one, by, axis=(0, 1)))(background, shift)
    blurred = happens(_BLUR)
    image, background = (jnp.where(blurred, _blurred(each), each) for each in (image, background))
    noise = _NOISE * jax.random.uniform(next(keys), (count, 1, 1, 1)) ** 2
    image = image + noise * jax.random.normal(next(keys), image.shape)
    image, background = (jnp.round(jnp.clip(each, 0, 255)) for each in (image, background))
    known = has_background & happens(_KNOWN)[:, 0, 0, 0]
    return inputs_of(image, background, known), Targets(covered[..., 0], counts, box_px)


def _texture(
    key: Key[Array, ""], count: int, height: int, width: int
) -> Float[Array, "images height width 3"]:
    """Images of random patches of several sizes."""
    image = jnp.zeros((count, height, width, 3))
    for size, one in zip((64, 16, 4), jax.random.split(key, 3), strict=True):
        small = jax.random.uniform(one, (count, -(-height // size), -(-width // size), 3), maxval=255)
        image += jax.image.resize(small, (count, height, width, 3), "linear") / 3
    return image


def _object(key: Key[Array, ""], count: int, height: int, width: int) -> Bool[Array, "images height width 1"]:
    """Pixels of one round or square object in each image."""
    place, size, turn, corners = jax.random.split(key, 4)
    middle = jax.random.uniform(place, (count, 1, 1, 2)) * jnp.array([height, width], jnp.float32)
    half = jnp.exp(
        jax.random.uniform(
            size, (count, 1, 1, 2), minval=jnp.log(_OBJECT_SIDE[0]), maxval=jnp.log(_OBJECT_SIDE[1])
        )
    )
    angle = jax.random.uniform(turn, (count, 1, 1), maxval=jnp.pi)
    is_round = jax.random.bernoulli(corners, 0.5, (count, 1, 1))
    sides = jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32)
    pixels = jnp.stack(jnp.meshgrid(*sides, indexing="ij"), axis=-1)
    y, x = jnp.moveaxis(pixels - middle, -1, 0)
    turned = jnp.stack(
        [jnp.cos(angle) * y - jnp.sin(angle) * x, jnp.sin(angle) * y + jnp.cos(angle) * x], axis=-1
    )
    square = jnp.square(turned / (half * max(height, width)))
    return jnp.where(is_round, square.sum(axis=-1), square.max(axis=-1))[..., None] < 1


def _largest_around(images: Float[Array, "images height width 1"]) -> Float[Array, "images height width 1"]:
    """The largest value in the 7 x 7 pixels about each pixel."""
    return jax.lax.reduce_window(images, -jnp.inf, jax.lax.max, (1, 7, 7, 1), (1, 1, 1, 1), "SAME")


def _blurred(images: Float[Array, "images height width 3"]) -> Float[Array, "images height width 3"]:
    for axis in (1, 2):
        images = (jnp.roll(images, 1, axis) + 2 * images + jnp.roll(images, -1, axis)) / 4
    return images
