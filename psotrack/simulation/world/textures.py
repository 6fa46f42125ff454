"""Textures of rooms: reflectance, linear BGR, drawn with a seeded generator, so that they are always the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float

Texture = Float[np.ndarray, "rows columns 3"]
Bgr = tuple[float, float, float]
#: Multiplies the reflectance in a rectangle (x1, y1, x2, y2), metres, by a factor, or by one per channel.
_Factor = float | Bgr | Float[np.ndarray, "3"]
_Draw = Callable[[tuple[float, float, float, float], _Factor], None]


def plain(width_m: float, height_m: float, texel_m: float, bgr: Bgr, rng: np.random.Generator) -> Texture:
    """Texture of one colour with stains of three sizes and fine grain."""
    # A separate random stream: the number of draws here depends on the texel size, and later draws must not.
    rng = rng.spawn(1)[0]
    shape = (max(4, round(height_m / texel_m)), max(4, round(width_m / texel_m)))
    shade = 1 + 0.04 * rng.standard_normal(shape, np.float32)
    for size_m, strength in ((1.0, 0.06), (0.25, 0.05), (0.03, 0.06)):
        cells = max(2, round(size_m / texel_m))
        coarse = rng.uniform(-1, 1, [max(2, side // cells) for side in shape]).astype(np.float32)
        stains = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
        shade += strength * np.clip(stains, -1, 1)
    texture = np.array(bgr, np.float32) * shade[..., None]
    return np.clip(texture, 0.01, 0.95, out=texture)


def _begun(
    width_m: float, height_m: float, texel_m: float, bgr: Bgr, rng: np.random.Generator
) -> tuple[Texture, _Draw]:
    """A plain texture, and what draws into it."""
    texture = plain(width_m, height_m, texel_m, bgr, rng)
    return texture, partial(_rectangle, texture, texel_m)


def _rectangle(
    texture: Texture, texel_m: float, xyxy_m: tuple[float, float, float, float], factor: _Factor
) -> None:
    """Multiply the reflectance in a rectangle by a factor, or by one per channel."""
    x1, y1, x2, y2 = (round(side / texel_m) for side in xyxy_m)
    texture[max(y1, 0) : max(y2, y1 + 1), max(x1, 0) : max(x2, x1 + 1)] *= np.array(factor, np.float32)


def floor(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Texture:
    """Floor of boards with two mats and lines around the flight area."""
    texture, draw = _begun(width_m, height_m, texel_m, (0.37, 0.42, 0.46), rng)
    board_m, length_m, gap_m = 0.14, 1.2, 0.006
    for row in range(int(height_m / board_m)):
        y = row * board_m
        x = -rng.uniform(0, length_m)
        while x < width_m:
            shade = rng.uniform(0.8, 1.15)
            draw((x, y, x + length_m, y + board_m), shade)
            draw((x, y, x + gap_m, y + board_m), 0.6)
            x += length_m
        draw((0.0, y, width_m, y + gap_m), 0.6)
    of_flights_m = (0.2 * width_m, 0.125 * height_m, 0.8 * width_m, 0.875 * height_m)
    _outline(draw, of_flights_m, (0.7, 2.2, 2.4))
    x, y = 0.5 * width_m, 0.5 * height_m
    draw((x + 0.6, y - 1.0, x + 2.6, y + 1.0), (1.3, 0.8, 0.55))
    draw((x - 2.4, y + 0.6, x - 0.8, y + 2.2), (0.62, 0.58, 0.55))
    return np.clip(texture, 0.01, 0.95, out=texture)


def ceiling(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Texture:
    """Ceiling of tiles."""
    texture, draw = _begun(width_m, height_m, texel_m, (0.62, 0.64, 0.64), rng)
    for x in np.arange(0, width_m, 0.6):
        draw((x, 0.0, x + 0.02, height_m), 0.7)
    for y in np.arange(0, height_m, 0.6):
        draw((0.0, y, width_m, y + 0.02), 0.7)
    return texture


def wall(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Texture:
    """Painted wall with a darker lower part, acoustic panels, a door and posters."""
    texture, draw = _begun(width_m, height_m, texel_m, (0.50, 0.53, 0.54), rng)
    draw((0.0, height_m - 1.1, width_m, height_m), (0.75, 0.68, 0.6))
    draw((0.0, height_m - 1.12, width_m, height_m - 1.08), 0.5)
    draw((0.0, height_m - 0.1, width_m, height_m), 0.35)
    for x in np.arange(rng.uniform(0.3, 0.8), width_m - 0.8, 1.25):
        tint = rng.uniform(0.45, 1.15, 3) * rng.uniform(0.7, 1.1)
        top = rng.uniform(0.3, 0.5)
        draw((x, top, x + rng.uniform(0.5, 0.9), top + rng.uniform(0.7, 1.1)), tint)
    door = rng.uniform(0.5, width_m - 1.5)
    draw((door, height_m - 2.05, door + 0.92, height_m - 0.02), (0.45, 0.55, 0.75))
    draw((door + 0.78, height_m - 1.06, door + 0.88, height_m - 1.02), 2.0)
    _posters(draw, width_m, (1.2, 2.4), rng)
    return np.clip(texture, 0.01, 0.95, out=texture)


def _posters(draw: _Draw, width_m: float, tops_m: tuple[float, float], rng: np.random.Generator) -> None:
    for _ in range(5):
        x, top = rng.uniform(0.2, width_m - 1.0), rng.uniform(*tops_m)
        draw((x, top, x + 0.42, top + 0.6), rng.uniform(0.3, 1.6, 3))
        for line in range(6):
            y = top + 0.12 + 0.07 * line
            draw((x + 0.05, y, x + rng.uniform(0.2, 0.38), y + 0.02), 0.5)


def slab(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Texture:
    """Floor of a large hall: a painted slab with joints, lines of two courts, mats, and lines of the flight area."""
    texture, draw = _begun(width_m, height_m, texel_m, (0.40, 0.43, 0.40), rng)
    for x in np.arange(2.5, width_m, 2.5):
        draw((x, 0.0, x + 0.012, height_m), 0.5)
    for y in np.arange(2.0, height_m, 2.0):
        draw((0.0, y, width_m, y + 0.012), 0.5)
    for _ in range(60):
        x, y = rng.uniform(0, width_m), rng.uniform(0, height_m)
        length, width = rng.uniform(0.2, 1.6), rng.uniform(0.02, 0.3)
        draw((x, y, x + length, y + width), rng.uniform(0.85, 1.08))
    x, y = 0.5 * width_m, 0.5 * height_m
    draw((x + 1.2, y - 1.9, x + 4.4, y + 0.7), (1.25, 0.85, 0.55))
    draw((x - 5.0, y + 0.5, x - 2.2, y + 2.8), (0.5, 0.55, 0.95))
    draw((x - 3.6, y - 3.3, x - 0.4, y - 1.7), (0.6, 0.58, 0.56))
    white, blue, yellow = (2.1, 2.0, 2.1), (1.9, 0.9, 0.4), (0.7, 2.0, 2.2)
    _outline(draw, (0.08 * width_m, 0.1 * height_m, 0.92 * width_m, 0.9 * height_m), white)
    _outline(draw, (0.3 * width_m, 0.04 * height_m, 0.7 * width_m, 0.96 * height_m), blue)
    _outline(draw, (0.2 * width_m, 0.2 * height_m, 0.8 * width_m, 0.8 * height_m), yellow)
    draw((x - 0.025, 0.1 * height_m, x + 0.025, 0.9 * height_m), white)
    return np.clip(texture, 0.01, 0.95, out=texture)


def _outline(draw: _Draw, xyxy_m: tuple[float, float, float, float], factor: _Factor) -> None:
    """Draw a line of 5 cm along the edge of a rectangle."""
    line_m = 0.05
    x1, y1, x2, y2 = xyxy_m
    for y in (y1, y2):
        draw((x1, y, x2 + line_m, y + line_m), factor)
    for x in (x1, x2):
        draw((x, y1, x + line_m, y2), factor)


def sheeting(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Texture:
    """Roof of a large hall: steel sheets, purlins and girders."""
    texture, draw = _begun(width_m, height_m, texel_m, (0.52, 0.52, 0.50), rng)
    for y in np.arange(0, height_m, 0.25):
        draw((0.0, y, width_m, y + 0.06), 0.8)
    for y in np.arange(1.0, height_m, 2.0):
        draw((0.0, y, width_m, y + 0.12), 0.5)
    for x in np.arange(1.5, width_m, 4.2):
        draw((x, 0.0, x + 0.3, height_m), (0.35, 0.33, 0.33))
    return texture


def cladding(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Texture:
    """Wall of a large hall: impact boards below, steel sheets above, columns, a gate, windows, banners, pipes."""
    texture, draw = _begun(width_m, height_m, texel_m, (0.50, 0.53, 0.52), rng)
    boards = height_m - 2.4
    for x in np.arange(0, width_m, 0.3):
        draw((x, 0.0, x + 0.07, boards), 0.86)
    draw((0.0, 0.0, width_m, 0.35 * height_m), (0.85, 0.83, 0.82))
    for row in range(4):
        y = boards + 0.6 * row
        x = -rng.uniform(0, 1.5)
        while x < width_m:
            shade = rng.uniform(0.75, 1.05)
            draw((x, y, x + 1.5, y + 0.6), (0.42 * shade, 0.62 * shade, 0.85 * shade))
            draw((x, y, x + 0.012, y + 0.6), 0.5)
            x += 1.5
        draw((0.0, y, width_m, y + 0.012), 0.5)
    draw((0.0, height_m - 0.15, width_m, height_m), 0.35)
    for x in np.arange(rng.uniform(0.8, 1.6), width_m - 2.0, 2.6):
        # Frosted panes in a dark frame.
        draw((x, 0.7, x + 1.7, 1.75), (0.3, 0.28, 0.28))
        for pane in range(3):
            left = x + 0.05 + 0.55 * pane
            draw((left, 0.75, left + 0.5, 1.70), (6.3, 5.9, 5.5))
    for x in np.arange(rng.uniform(0.5, 2.0), width_m - 1.2, 3.4):
        top = rng.uniform(2.2, 2.8)
        tint = rng.uniform(0.15, 1.2, 3)
        draw((x, top, x + 1.0, top + 2.3), tint)
        draw((x + 0.15, top + 0.3, x + 0.85, top + 0.9), 1.7)
    gate = rng.uniform(1.0, width_m - 5.0)
    draw((gate, height_m - 3.4, gate + 3.6, height_m), (0.75, 0.7, 0.7))
    for y in np.arange(height_m - 3.4, height_m - 0.05, 0.17):
        draw((gate, y, gate + 3.6, y + 0.03), 0.6)
    for x in np.arange(2.0, width_m, 4.0):
        draw((x, 0.0, x + 0.32, height_m), (0.45, 0.42, 0.40))
    draw((0.0, 0.42, width_m, 0.50), (0.25, 0.25, 1.1))
    draw((0.0, 1.95, width_m, 2.13), 0.55)
    _posters(draw, width_m, (height_m - 2.0, height_m - 1.4), rng)
    return np.clip(texture, 0.01, 0.95, out=texture)
