"""Random changes of the frames that the network learns from, so that it is at home in pictures that it has not seen.

A part of a frame gets another scene behind its drones, more drones at other sizes, other paint, drones that the
background shows too, objects that are no drones, leaves that move, other light, a camera that trembles, blur, noise and
compression. The probabilities and limits below are guesses: wide enough for pictures that nobody here has seen.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

#: Probabilities of the changes.
_OTHER_SCENE, _DRAWN_SCENE, _PAINT, _FLAT_PAINT, _HOVERS, _GHOST = 0.5, 0.4, 0.4, 0.15, 0.2, 0.15
_LEAVES, _LIGHT_OF_FRAME, _BANDS, _TREMBLES, _BLUR, _COMPRESSION, _KNOWN = 0.2, 0.5, 0.1, 0.3, 0.4, 0.5, 0.8
#: Probabilities of 0, 1, 2, ... more drones and objects that are no drones.
_MORE_DRONES, _OBJECTS = (0.4, 0.3, 0.2, 0.1), (0.3, 0.3, 0.2, 0.2)
#: Limits of the scale of further drones, and of the half lengths of objects as shares of the part's side.
_DRONE_SCALE, _OBJECT_SIDE = (0.12, 1.2), (0.01, 0.2)
#: Standard deviations of logarithms: of paint, of all light, of its colour, of gamma, of the light of the frame alone.
_PAINT_SPREAD, _LIGHT_SPREAD, _COLOUR_SPREAD, _GAMMA_SPREAD, _FRAME_SPREAD = 0.5, 0.25, 0.06, 0.2, 0.1
#: Largest tremble and movement of leaves, pixels; largest blur, pixels, and noise, grey levels; limits of JPEG quality.
_TREMBLE_PX, _LEAVES_PX, _BLUR_PX, _NOISE, _JPEG = 2.5, 4.0, 1.5, 8.0, (10, 95)
#: Noise of a learned background, as a share of that of a frame.
_LEARNED_NOISE = 0.2
#: Difference from the background, grey levels, from which on a pixel of a drone hides the background: rotors that turn
#: differ less, because the background shows through them.
_OPAQUE = 40.0
#: Tries to find a free place for a drone.
_TRIES = 5

_Image = Float[np.ndarray, "side side 3"]


@dataclass(frozen=True)
class Part:
    """A square part of a frame.

    Attributes:
        image, background: BGR, grey levels; the background is of use where it is known.
        covered: share of each pixel that drones cover.
        box_px: xyxy of each drone, pixels of the part; NaN for no drone.
        by_boxes: whether only the boxes are known (see `Samples`).
        is_known: whether the background is known.
    """

    image: _Image
    background: _Image
    covered: Float[np.ndarray, "side side"]
    box_px: Float[np.ndarray, "drones 4"]
    by_boxes: bool
    is_known: bool


def varied(part: Part, other: Callable[[], Part], random: np.random.Generator) -> Part:
    """A part with random changes.

    Args:
        part: a part of a frame.
        other: gives another random part, of the same size.
        random: random numbers.
    """
    if not part.by_boxes:
        part = _elsewhere(part, other, random)
        for _ in range(_number(_MORE_DRONES, random)):
            part = _one_more(part, other(), random)
        part = _painted(part, random)
        part = _remembered(part, random)
    part = _among_objects(part, other, random)
    return _taken(part, random)


# --- drones and scenes


def _elsewhere(part: Part, other: Callable[[], Part], random: np.random.Generator) -> Part:
    """Another scene behind the drones: what differs from the old background stays, as shadows and people."""
    if random.random() >= _OTHER_SCENE:
        return part
    if random.random() < _DRAWN_SCENE:
        scene = _drawn_scene(len(part.image), random)
    else:
        scene = other().background
    image = part.image + (1 - _hiding(part)) * (scene - part.background)
    return replace(part, image=np.clip(image, 0, 255), background=scene)


def _drawn_scene(side: int, random: np.random.Generator) -> _Image:
    """A sky or a wall that changes slowly, and on most of it patches of several sizes, which end at a line or not."""
    ends = random.uniform(20, 255, (2, 2, 3)).astype(np.float32)
    ends = ends.mean(axis=(0, 1)) + random.uniform(0, 0.6) * (ends - ends.mean(axis=(0, 1)))
    scene = cv2.resize(ends, (side, side), interpolation=cv2.INTER_LINEAR)
    if random.random() < 0.7:
        texture = np.zeros_like(scene)
        for size in (64, 16, 4, 1):
            across = -(-side // size)
            small = random.standard_normal((across, across, random.choice([1, 3])), np.float32)
            grown = cv2.resize(small, (side, side), interpolation=int(random.choice([0, 1])))
            texture += random.uniform(0, 1) * grown.reshape(side, side, -1)
        rows, columns = np.mgrid[:side, :side] / side - random.uniform(0, 1, (2, 1, 1))
        angle = random.uniform(0, 2 * np.pi)
        shown = (np.cos(angle) * rows + np.sin(angle) * columns > 0) | (random.random() < 0.5)
        scene = scene + random.uniform(2, 40) * texture * shown[..., None]
    return np.clip(scene, 0, 255)


def _one_more(part: Part, other: Part, random: np.random.Generator) -> Part:
    """A drone of another part, at a random place and scale."""
    is_seen = np.isfinite(other.box_px[:, 0]), np.isfinite(part.box_px[:, 0])
    seen, free = np.flatnonzero(is_seen[0]), np.flatnonzero(~is_seen[1])
    if other.by_boxes or not len(seen) or not len(free):
        return part
    x0, y0, x1, y1 = _whole(other.box_px[random.choice(seen)], len(other.image))
    place = np.s_[y0:y1, x0:x1]
    layers = [each[place] for each in (other.covered, _hiding(other)[..., 0], _drones(other))]
    scale = np.exp(random.uniform(*np.log(_DRONE_SCALE)))
    width, height = (max(2, round(scale * length)) for length in (x1 - x0, y1 - y0))
    side = len(part.image)
    if max(width, height) > side / 2 or not layers[0].any():
        return part
    covered, hides, drone = (
        cv2.resize(each, (width, height), interpolation=cv2.INTER_AREA) for each in layers
    )
    for _ in range(_TRIES):
        x, y = random.integers(0, side - width + 1), random.integers(0, side - height + 1)
        box = np.array([x, y, x + width, y + height], float)
        low, high = np.fmax(box[:2], part.box_px[:, :2]), np.fmin(box[2:], part.box_px[:, 2:])
        if (high <= low)[is_seen[1]].any(axis=1).all():
            break
    else:
        return part
    image, whole, boxes = part.image.copy(), part.covered.copy(), part.box_px.copy()
    place = np.s_[y : y + height, x : x + width]
    image[place] = (1 - hides[..., None]) * image[place] + drone
    whole[place] = 1 - (1 - covered) * (1 - whole[place])
    boxes[free[0]] = box
    return replace(part, image=image, covered=whole, box_px=boxes)


def _hiding(part: Part) -> Float[np.ndarray, "side side 1"]:
    """The share of the background that drones hide."""
    # Several times as fast as the maximum of an array's last axis.
    difference = functools.reduce(np.maximum, cv2.split(cv2.absdiff(part.image, part.background)))
    return (part.covered * np.minimum(difference / _OPAQUE, 1))[..., None]


def _drones(part: Part) -> _Image:
    """What the drones add to the image where they hide the background, or take away where it shows through."""
    drones = part.image - (1 - _hiding(part)) * part.background
    return drones * (part.covered[..., None] > 0)


def _painted(part: Part, random: np.random.Generator) -> Part:
    """Drones of another colour, or of one colour as before a bright sky."""
    is_flat, is_painted = random.random() < _FLAT_PAINT, random.random() < _PAINT
    if not (is_flat or is_painted):
        return part
    drones, hides = _drones(part), _hiding(part)
    if is_flat:
        colour = random.uniform(0, 255) ** 2 / 255 * np.exp(random.normal(0, 0.2, 3))
        shown = random.uniform(0, 0.3) * drones + hides * colour
    else:
        shown = drones * np.exp(random.normal(0, _PAINT_SPREAD, 3))
    return replace(part, image=np.clip(part.image - drones + shown, 0, 255).astype(np.float32))


def _remembered(part: Part, random: np.random.Generator) -> Part:
    """A background that shows the drones too, wholly or in part, or shows drones that have left."""
    chance = random.random()
    if chance < _HOVERS:
        near = cv2.dilate(part.covered, np.ones((7, 7))) > 0
        share = near[..., None] * np.float32(random.uniform(0.3, 1))
        return replace(part, background=part.background + share * (part.image - part.background))
    if chance < _HOVERS + _GHOST:
        by = random.integers(-len(part.image) // 3, len(part.image) // 3, 2)
        drones, hides = (np.roll(each, by, axis=(0, 1)) for each in (_drones(part), _hiding(part)))
        strength = np.float32(random.uniform(0.3, 1))
        ghost = (1 - strength * hides) * part.background + strength * drones
        return replace(part, background=ghost)
    return part


# --- what is no drone


def _among_objects(part: Part, other: Callable[[], Part], random: np.random.Generator) -> Part:
    """Objects that are no drones behind the drones, or that have left the background; leaves that moved."""
    image, background, side = part.image, part.background, len(part.image)
    shown: np.ndarray
    for _ in range(_number(_OBJECTS, random)):
        share = _object(side, random)[..., None]
        fill = random.choice(["colour", "scene", "shadow"])
        if fill == "colour":
            shown = np.asarray(random.uniform(0, 255, 3), np.float32)
        elif fill == "scene":
            shown = other().background[::-1, ::-1]
        else:
            shown = random.uniform(0.3, 0.9) * image
        if random.random() < 0.2 and not part.by_boxes:
            background = (1 - share) * background + share * shown
        else:
            share = share * (1 - part.covered[..., None])
            image = (1 - share) * image + share * shown
    if random.random() < _LEAVES and not part.by_boxes:
        field = random.standard_normal((2, -(-side // 6), -(-side // 6)), np.float32)
        moved = (
            _LEAVES_PX * random.uniform(0.2, 1) * np.stack([cv2.resize(each, (side, side)) for each in field])
        )
        rows, columns = np.mgrid[:side, :side].astype(np.float32) + _object(side, random, least=0.1) * moved
        background = cv2.remap(
            background.astype(np.float32), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return replace(part, image=image, background=background)


def _object(
    side: int, random: np.random.Generator, *, least: float = _OBJECT_SIDE[0]
) -> Float[np.ndarray, "side side"]:
    """The share of each pixel that an object with a random contour covers."""
    corners = int(random.integers(3, 12))
    angles = np.sort(random.uniform(0, 2 * np.pi, corners))
    half = side * np.exp(random.uniform(np.log(least), np.log(_OBJECT_SIDE[1]), 2))
    contour = (
        random.uniform(0.4, 1, corners)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]) * half
    )
    turn = random.uniform(0, np.pi)
    contour = contour @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    place = np.round(16 * (contour + random.uniform(0, side, 2))).astype(np.int32)
    mask = np.zeros((side, side), np.uint8)
    cv2.fillPoly(mask, [place], 255, cv2.LINE_AA, shift=4)
    blurred = cv2.GaussianBlur(mask, (0, 0), random.uniform(0.3, 1.5))
    return blurred.astype(np.float32) / 255


# --- light and camera


def _taken(part: Part, random: np.random.Generator) -> Part:
    """The part in other light, as another camera takes it."""
    image, background = (
        np.round(np.clip(each, 0, 255)).astype(np.uint8) for each in (part.image, part.background)
    )
    light = random.normal(0, _LIGHT_SPREAD) + random.normal(0, _COLOUR_SPREAD, 3)
    gamma = np.exp(random.normal(0, _GAMMA_SPREAD))
    of_frame = random.normal(0, _FRAME_SPREAD) if random.random() < _LIGHT_OF_FRAME else 0.0
    image, background = (
        _lit(each, gain, gamma) for each, gain in ((image, light + of_frame), (background, light))
    )
    if random.random() < _BANDS:
        rows = np.arange(len(image)) * random.uniform(0.02, 0.5) + random.uniform(0, 6.3)
        image = image * (1 + random.uniform(0, 0.15) * np.sin(rows))[:, None, None]
    image, background = image.astype(np.float32), background.astype(np.float32)
    if random.random() < _TREMBLES:
        by = np.column_stack([np.eye(2), random.uniform(-_TREMBLE_PX, _TREMBLE_PX, 2)])
        background = cv2.warpAffine(background, by, background.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
    if random.random() < _BLUR:
        blur = random.uniform(0.3, _BLUR_PX)
        image, background = (cv2.GaussianBlur(each, (0, 0), blur) for each in (image, background))
    noise = _NOISE * random.uniform() ** 2
    image = image + noise * random.standard_normal(image.shape, np.float32)
    background = background + _LEARNED_NOISE * noise * random.standard_normal(image.shape, np.float32)
    image, background = (np.round(np.clip(each, 0, 255)).astype(np.uint8) for each in (image, background))
    if random.random() < _COMPRESSION:
        quality = int(random.integers(*_JPEG))
        image, background = (_compressed(each, quality) for each in (image, background))
    is_known = part.is_known and random.random() < _KNOWN
    return replace(
        part, image=image.astype(np.float32), background=background.astype(np.float32), is_known=is_known
    )


def _lit(
    image: UInt8[np.ndarray, "side side 3"], log_gain: Float[np.ndarray, "3"], gamma: float
) -> UInt8[np.ndarray, "side side 3"]:
    levels = (np.arange(256)[:, None] / 255) ** gamma * np.exp(log_gain)
    return np.asarray(cv2.LUT(image, np.round(np.clip(255 * levels, 0, 255)).astype(np.uint8)[:, None]))


def _compressed(image: UInt8[np.ndarray, "side side 3"], quality: int) -> UInt8[np.ndarray, "side side 3"]:
    _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR))


def _number(probabilities: tuple[float, ...], random: np.random.Generator) -> int:
    return int(random.choice(len(probabilities), p=probabilities))


def _whole(box: Float[np.ndarray, "4"], side: int) -> tuple[int, int, int, int]:
    """The whole pixels of a box."""
    x0, y0 = np.floor(box[:2]).astype(int)
    x1, y1 = np.minimum(np.ceil(box[2:]), side).astype(int)
    return max(x0, 0), max(y0, 0), x1, y1
