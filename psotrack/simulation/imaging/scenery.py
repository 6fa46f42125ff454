"""What changes behind the drones in one camera's image: a screen, leaves, a person; and the light of a lamp.

Everything is drawn in the image, from shares of its size, so that all scales show the same. What is at a place at a
time depends only on (seed, stream, time), so any frame can be drawn alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.simulation.imaging import sensor
from psotrack.simulation.imaging.backdrop import lens_blur
from psotrack.simulation.imaging.sensor import Image
from psotrack.simulation.scenarios import Surroundings

#: Third number of each thing's random seed.
_FOR_LAMP, _FOR_SCREEN, _FOR_FOLIAGE, _FOR_PERSON = range(4)
#: Width of the edge between the halves that a lamp lights and does not light, as a share of the image's width.
_LAMP_EDGE = 0.1

#: Width and height of a screen, its frame as a share of its height, and how long it shows one scene.
_SCREEN_WH, _SCREEN_FRAME, _SCREEN_SCENE_S = (16, 9), 0.05, 1.7
#: Side of the square picture from which a screen's content is cut, and width of the cut, pixels.
_CONTENT_PX, _CUT_PX = 256, 120

#: Length of a leaf, as a share of the square root of the area of all leaves and, at most, of the image's height.
_LEAF, _LONGEST_LEAF = 0.16, 0.05
#: Leaves per area of a leaf, and unevenness of the edge of all leaves: 0 is a circle.
_LEAF_LAYERS, _RAGGED = 4.0, 0.6
#: Largest sway as a share of the square root of the leaves' area, and frequencies of the two parts of a sway.
_SWAY, _SWAY_HZ = 0.03, (0.7, 1.7)

#: Share of the time between two entrances in which a person is in the image, and how far a person walks in, in widths.
_VISIT, _REACH = 0.6, (0.12, 0.3)
_STEPS_HZ = 0.9
#: Reflectance of skin, BGR, and largest reflectance of a person.
_SKIN, _BRIGHTEST = np.array([0.2, 0.27, 0.42]), 0.5
#: Bits of the fraction of a pixel in coordinates that OpenCV draws.
_FRACTION_BITS = 4


@dataclass(frozen=True)
class Layer:
    """Something in a window of the image.

    Attributes:
        x, y: first column and row of the window.
        seen: (rows, columns, 4), linear BGR light, and the share of the light from behind that is still seen.
    """

    x: int
    y: int
    seen: Float[np.ndarray, "rows columns 4"]

    def moved(self, shows_px: Float[np.ndarray, "height width 2"]) -> Layer | None:
        """The layer in another image whose pixels show given pixels of this one; None if it is not in view there."""
        rows, columns = self.seen.shape[:2]
        x, y = shows_px[..., 0] - self.x, shows_px[..., 1] - self.y
        inside = (x > -1) & (y > -1) & (x < columns) & (y < rows)
        left, top, width, height = cv2.boundingRect(inside.astype(np.uint8))
        if not width:
            return None
        window = slice(top, top + height), slice(left, left + width)
        x, y = (np.ascontiguousarray(part[window], np.float32) for part in (x, y))
        seen = cv2.remap(self.seen, x, y, cv2.INTER_LINEAR, borderValue=(0, 0, 0, 1))
        return Layer(left, top, seen)

    def draw(self, image: Image) -> None:
        """Draw the layer over an image of which a part may be outside."""
        rows, columns = self.seen.shape[:2]
        top, left = max(-self.y, 0), max(-self.x, 0)
        bottom, right = min(rows, image.shape[0] - self.y), min(columns, image.shape[1] - self.x)
        if top >= bottom or left >= right:
            return
        seen = self.seen[top:bottom, left:right]
        part = image[self.y + top : self.y + bottom, self.x + left : self.x + right]
        sensor.draw_over(part, seen)


class Scenery:
    """What changes behind the drones in the image of one static camera.

    Args:
        settings: what there is.
        seed: seed of the simulation.
        stream: number of the camera's random stream, as of its sensor.
        shape: height and width of the image, pixels.
        lens_blur_px: standard deviation of the lens's blur.
    """

    def __init__(
        self, settings: Surroundings, seed: int, stream: int, shape: tuple[int, int], lens_blur_px: float
    ) -> None:
        def rng(purpose: int) -> np.random.Generator:
            return np.random.default_rng([seed, stream, purpose, sensor.FOR_SCENERY])

        self._settings, self._blur_px = settings, lens_blur_px
        self._things: list[_Screen | _Foliage | _Person] = []
        if settings.screen:
            self._things.append(_Screen(rng(_FOR_SCREEN), settings.screen, shape))
        if settings.foliage:
            self._things.append(_Foliage(rng(_FOR_FOLIAGE), settings.foliage, shape))
        if settings.person:
            self._things.append(_Person(rng(_FOR_PERSON), settings.person, settings.person_period_s, shape))
        self._dark = _dark_half(rng(_FOR_LAMP), settings.lamp_drop, shape) if settings.lamp_drop else None

    def layers(self, time_s: float) -> list[Layer]:
        """What is in the image at a time, from far to near, after the lens's blur."""
        found = (thing.at(time_s) for thing in self._things)
        return [self._blurred(layer) for layer in found if layer is not None]

    def light(self, image: Image, time_s: float) -> None:
        """Darken a half of the image while the lamp is off."""
        switched = sum(at_s <= time_s for at_s in self._settings.lamp_s)
        if self._dark is not None and switched % 2:
            cv2.multiply(image, self._dark, dst=image, scale=1 / 255)

    def _blurred(self, layer: Layer) -> Layer:
        if not self._blur_px:
            return layer
        margin = 2 + int(np.ceil(4 * self._blur_px))
        wider = cv2.copyMakeBorder(
            layer.seen, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(0, 0, 0, 1)
        )
        return Layer(layer.x - margin, layer.y - margin, lens_blur(wider, self._blur_px))


def _dark_half(rng: np.random.Generator, drop: float, shape: tuple[int, int]) -> Image:
    """Factors of grey levels, in 1/255, of an image of which half has less light."""
    angle = rng.uniform(0, 2 * np.pi)
    rows, columns = np.indices(shape, np.float32) / np.float32(shape[1])
    along = np.cos(angle) * columns + np.sin(angle) * rows
    lost = 1 / (1 + np.exp((np.median(along) - along) * (8 / _LAMP_EDGE)))
    grey = (255 * (1 - drop * lost) ** (1 / sensor.GAMMA)).round().astype(np.uint8)
    return np.asarray(cv2.merge([grey, grey, grey]), np.uint8)


class _Screen:
    """A bright screen: a new scene every `_SCREEN_SCENE_S`, which moves."""

    def __init__(self, rng: np.random.Generator, share: float, shape: tuple[int, int]) -> None:
        height, width = shape
        aspect = _SCREEN_WH[0] / _SCREEN_WH[1]
        self._wh = (
            max(2, round(np.sqrt(share * height * width * aspect))),
            max(2, round(np.sqrt(share * height * width / aspect))),
        )
        self._frame_px = max(1, round(_SCREEN_FRAME * self._wh[1]))
        across, along = rng.uniform(0.05, 0.95), rng.uniform(0.1, 0.6)
        self._x = round(across * (width - self._wh[0]))
        self._y = round(along * (height - self._wh[1]))
        self._content = _content(rng)
        self._seed = int(rng.integers(1 << 31))
        self._late_s = float(rng.uniform(0, _SCREEN_SCENE_S))

    def at(self, time_s: float) -> Layer:
        scene, since_s = divmod(time_s + self._late_s, _SCREEN_SCENE_S)
        # The time of frame 0 may be before 0 in clocks of several cameras; a seed may not.
        rng = np.random.default_rng([self._seed, int(scene) + (1 << 20)])
        start, velocity = rng.uniform(0, _CONTENT_PX, 2), rng.uniform(-60, 60, 2)
        zoom, brightness = rng.uniform(0.5, 1.5) * _CUT_PX / self._wh[0], rng.uniform(0.35, 1.0)
        A = np.column_stack([zoom * np.eye(2), start + velocity * since_s])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        shown = cv2.warpAffine(self._content, A, self._wh, flags=flags, borderMode=cv2.BORDER_WRAP)
        wide = self._frame_px
        seen = np.zeros((self._wh[1] + 2 * wide, self._wh[0] + 2 * wide, 4), np.float32)
        seen[..., :3] = 0.01
        seen[wide:-wide, wide:-wide, :3] = brightness * shown
        return Layer(self._x - wide, self._y - wide, seen)


def _content(rng: np.random.Generator) -> Float[np.ndarray, "side side 3"]:
    """Coloured stains and rectangles, linear BGR light from 0.02 to 1."""
    side = _CONTENT_PX
    image = 0.5 + 0.35 * np.dstack([_smooth(rng, (side, side), 6) for _ in range(3)])
    for _ in range(60):
        (x, y), (w, h) = rng.integers(0, side, 2), rng.integers(4, 50, 2)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), rng.uniform(0, 1, 3).tolist(), -1)
    return np.asarray(np.clip(image, 0.02, 1), np.float32)


class _Foliage:
    """Leaves about a place near the border, which sway."""

    def __init__(self, rng: np.random.Generator, share: float, shape: tuple[int, int]) -> None:
        height, width = shape
        extent = np.sqrt(share * width / height)
        leaf = min(_LEAF * extent, _LONGEST_LEAF)
        self._sway_px = _SWAY * extent * height
        pad = int(np.ceil(1.5 * self._sway_px)) + 2
        side = rng.uniform(0.05, 0.2)
        middle = np.array(
            [width / height * (side if rng.uniform() < 0.5 else 1 - side), rng.uniform(0.4, 0.8)]
        )
        leaves = _leaves(rng, leaf, width / height, middle)
        canvas = np.zeros((height + 2 * pad, width + 2 * pad, 4), np.float32)
        covered = canvas[pad:-pad, pad:-pad, 3]
        wanted, used = share * height * width, 0
        while used < len(leaves) and np.count_nonzero(covered) < wanted:
            batch = leaves[used : used + max(1, used // 100)]
            _draw_leaves(canvas, batch, height, pad)
            used += len(batch)
        canvas[...] = 0
        _draw_leaves(canvas, leaves[rng.permutation(used)], height, pad)
        canvas[..., 3] = 1 - canvas[..., 3]
        x, y, w, h = cv2.boundingRect((canvas[..., 3] < 1).astype(np.uint8))
        x, y, right, bottom = max(x - pad, 0), max(y - pad, 0), x + w + pad, y + h + pad
        self._still = canvas[y:bottom, x:right].copy()
        self._x, self._y = x - pad, y - pad
        rows, columns = self._still.shape[:2]
        self._columns, self._rows = np.meshgrid(
            np.arange(columns, dtype=np.float32), np.arange(rows, dtype=np.float32)
        )
        # Leaves that are more than a sixth of the height apart sway independently.
        phase = 3 * cv2.resize(_smooth(rng, (64, 64), 6), (columns, rows), interpolation=cv2.INTER_CUBIC)
        self._waves = [(np.cos(turn * phase), np.sin(turn * phase)) for turn in (1, 2)]

    def at(self, time_s: float) -> Layer:
        sway = np.zeros_like(self._rows)
        for hz, amplitude, (cosine, sine) in zip(_SWAY_HZ, (1.0, 0.5), self._waves, strict=True):
            angle = 2 * np.pi * hz * time_s
            sway += np.float32(amplitude * self._sway_px * np.sin(angle)) * cosine
            sway += np.float32(amplitude * self._sway_px * np.cos(angle)) * sine
        seen = cv2.remap(
            self._still,
            self._columns + sway,
            self._rows + np.float32(0.4) * sway,
            cv2.INTER_LINEAR,
            borderValue=(0, 0, 0, 1),
        )
        return Layer(self._x, self._y, seen)


def _leaves(
    rng: np.random.Generator, leaf: float, width: float, middle: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "leaves 8"]:
    """(leaves, 8), middle, half length, half width, angle and BGR light; those near `middle` first.

    Lengths are in image heights.
    """
    number = int(_LEAF_LAYERS * width / (0.3 * leaf**2)) + 1
    at = rng.uniform(0, 1, (number, 2)) * [width, 1.0]
    half = 0.5 * leaf * rng.uniform(0.6, 1.2, (number, 1))
    angle = rng.uniform(0, 180, (number, 1))
    green = (
        rng.uniform(0.02, 0.22, (number, 1))
        * np.array([[0.35, 1.0, 0.5]])
        * rng.uniform(0.7, 1.3, (number, 3))
    )
    away = at - middle
    around = np.arctan2(away[:, 1], away[:, 0])
    turns, phase = np.arange(2, 8), rng.uniform(0, 2 * np.pi, 6)
    distance = np.linalg.norm(away, axis=1) * (
        1 + _RAGGED * np.sin(turns * around[:, None] + phase).mean(axis=1)
    )
    return np.hstack([at, half, 0.4 * half, angle, green])[np.argsort(distance)]


def _draw_leaves(
    canvas: Float[np.ndarray, "rows columns 4"], leaves: Float[np.ndarray, "leaves 8"], height: int, pad: int
) -> None:
    """Draw leaves with a coverage of 1 in the last channel."""
    for x, y, long, wide, angle, *bgr in leaves:
        middle = round(x * height) + pad, round(y * height) + pad
        axes = max(1, round(long * height)), max(1, round(wide * height))
        cv2.ellipse(canvas, middle, axes, angle, 0, 360, (*bgr, 1.0), -1)


class _Person:
    """A person who walks in from one side, turns, and walks out again."""

    def __init__(
        self, rng: np.random.Generator, share: float, period_s: float, shape: tuple[int, int]
    ) -> None:
        height, width = shape
        self._width, self._period_s, self._tall_px = width, period_s, share * height
        self._from_left = bool(rng.uniform() < 0.5)
        self._reach_px = rng.uniform(*_REACH) * width
        self._foot_px = rng.uniform(max(share, 0.8), 1.02) * height
        # Nobody is in the image at time 0.
        self._phase = rng.uniform(_VISIT, 1)
        self._shirt, self._trousers = rng.uniform(0.03, 0.5, 3), rng.uniform(0.01, 0.12, 3)

    def at(self, time_s: float) -> Layer | None:
        share = (time_s / self._period_s + self._phase) % 1 / _VISIT
        if share >= 1:
            return None
        outside_px = 0.32 * self._tall_px
        x_px = (self._reach_px + outside_px) * np.sin(np.pi * share) - outside_px
        x_px = float(x_px if self._from_left else self._width - 1 - x_px)
        ahead = 1 if self._from_left == (share < 0.5) else -1
        x, y = int(np.floor(x_px - outside_px)), int(np.floor(self._foot_px - 1.05 * self._tall_px))
        body = np.zeros((max(8, round(1.1 * self._tall_px)), max(8, round(2 * outside_px)), 4), np.uint8)
        one = 1 << _FRACTION_BITS
        for points, thick, bgr in self._parts(np.sin(2 * np.pi * _STEPS_HZ * time_s), ahead):
            # Points are to the right of the feet and above them, in heights of the person.
            at_px = np.array([x_px - x, self._foot_px - y]) + self._tall_px * np.array(points) * [1, -1]
            line = [(at_px * one).round().astype(np.int32)]
            colour = (*(255 / _BRIGHTEST * bgr).tolist(), 255.0)
            wide_px = max(1, round(thick * self._tall_px))
            cv2.polylines(body, line, False, colour, wide_px, cv2.LINE_AA, _FRACTION_BITS)
        seen = body * np.float32(_BRIGHTEST / 255)
        seen[..., 3] = 1 - body[..., 3] / np.float32(255)
        return Layer(x, y, seen)

    def _parts(
        self, swing: float, ahead: int
    ) -> Iterator[tuple[list[tuple[float, float]], float, Float[np.ndarray, "3"]]]:
        """Yield legs, arms, body and head: points of a line, its thickness, and its light."""
        for step in (-swing, swing):
            knee = 0.08 * step + 0.05 * max(0.0, step) * ahead
            yield [(0.0, 0.5), (knee, 0.26), (0.17 * step, 0.03)], 0.085, self._trousers
            hand = 0.04 * ahead - 0.13 * step
            yield [(0.0, 0.76), (-0.09 * step, 0.62), (hand, 0.48)], 0.05, self._shirt
        yield [(0.0, 0.55), (0.0, 0.75)], 0.17, self._shirt
        yield [(0.01 * ahead, 0.9), (0.01 * ahead, 0.94)], 0.11, _SKIN


def _smooth(
    rng: np.random.Generator, shape: tuple[int, int], cells: int
) -> Float[np.ndarray, "rows columns"]:
    """(rows, columns), smooth random values with mean 0 and standard deviation of about 1."""
    coarse = rng.standard_normal((cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC))
