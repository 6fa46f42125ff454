"""Where the rise from black to white is, across edges that are known to some pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

#: Grey levels of a video, or light.
Levels = UInt8[np.ndarray, "height width"] | UInt16[np.ndarray, "height width"]

#: Samples across an edge, in units of the step, and the middles between them.
_ACROSS = np.linspace(-1.0, 1.0, 17)
_MIDDLES = (_ACROSS[1:] + _ACROSS[:-1]) / 2
#: What sums over them make of a rise: how high it is, and where.
_MOMENTS = np.stack([_MIDDLES**0, _MIDDLES, _MIDDLES**2], axis=-1).astype(np.float32)
#: Of the steepest rise across an edge, below which another is noise: there is more light, and more noise, on its white
#: side, which would draw it there.
_NOISE = 0.1


@dataclass(frozen=True)
class Rises:
    """What was found across edges.

    Attributes:
        off: (edges, points), how far the middle of the rise is along the step, in steps, -1 to 1.
        spread: (edges, points), standard deviation of the rise about it, in steps.
        weight: (edges, points), how high it is; 0 where there is none.
    """

    off: Float[np.ndarray, "edges points"]
    spread: Float[np.ndarray, "edges points"]
    weight: Float[np.ndarray, "edges points"]


def rises(
    levels: Levels,
    places_px: Float[np.ndarray, "edges points 2"],
    steps_px: Float[np.ndarray, "edges points 2"],
) -> Rises:
    """The rises about places in an image, from a step before each to a step after it.

    Args:
        levels: (height, width).
        places_px: (edges, points, 2); fewer than 32768 edges, and points, which is as large as OpenCV's images may be.
        steps_px: (edges, points, 2), towards white. Without length, nothing rises.
    """
    x, y = (
        (places_px[..., axis, None] + steps_px[..., axis, None] * _ACROSS).astype(np.float32)
        for axis in (0, 1)
    )
    flat = (len(places_px), -1)
    image = cv2.remap(
        levels, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    # As single precision, which is twice as fast.
    rise = np.maximum(np.diff(np.asarray(image, np.float32).reshape(x.shape), axis=-1), 0.0)
    rise = np.maximum(rise - np.float32(_NOISE) * rise.max(axis=-1, keepdims=True), 0.0)
    weight, first, second = np.moveaxis((rise @ _MOMENTS).astype(np.float64), -1, 0)
    total = np.maximum(weight, 1e-9)
    off = first / total
    return Rises(off, np.sqrt(np.maximum(second / total - off**2, 0.0)), weight)
