"""Position of the transition from black to white across edges that are known to a few pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

#: An image of grey levels, or of linear light (`gamma.linearise`).
Levels = UInt8[np.ndarray, "height width"] | UInt16[np.ndarray, "height width"]

#: Positions of the samples across an edge, and of the middles between samples, in steps.
_ACROSS = np.linspace(-1.0, 1.0, 17)
_MIDDLES = (_ACROSS[1:] + _ACROSS[:-1]) / 2
#: Weights whose sums over the middles give the height of a transition, and its first and second moment.
_MOMENTS = np.stack([_MIDDLES**0, _MIDDLES, _MIDDLES**2], axis=-1).astype(np.float32)
#: Share of the steepest rise across an edge below which a rise counts as noise. Noise grows with light, so that the
#: noise of the white side would draw the transition to that side.
_NOISE = 0.1


@dataclass(frozen=True)
class EdgeTransitions:
    """Transitions from black to white across edges.

    Attributes:
        offset: (edges, points), middle of the transition along the step, in steps, -1 to 1.
        spread: (edges, points), standard deviation of the transition about its middle, in steps.
        height: (edges, points), difference of levels across the transition; 0 where there is none.
    """

    offset: Float[np.ndarray, "edges points"]
    spread: Float[np.ndarray, "edges points"]
    height: Float[np.ndarray, "edges points"]


def find_transitions(
    levels: Levels,
    places_px: Float[np.ndarray, "edges points 2"],
    steps_px: Float[np.ndarray, "edges points 2"],
) -> EdgeTransitions:
    """Find the transition near each place, between one step before the place and one step after it.

    Args:
        levels: (height, width).
        places_px: (edges, points, 2). OpenCV's limit on image sizes allows fewer than 32768 edges, and fewer than
            32768 samples (17 for each point).
        steps_px: (edges, points, 2), towards white. A step of length 0 finds no transition.
    """
    x, y = (
        (places_px[..., axis, None] + steps_px[..., axis, None] * _ACROSS).astype(np.float32)
        for axis in (0, 1)
    )
    flat = (len(places_px), -1)
    image = cv2.remap(
        levels, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    # Single precision is twice as fast.
    rise = np.maximum(np.diff(np.asarray(image, np.float32).reshape(x.shape), axis=-1), 0.0)
    rise = np.maximum(rise - np.float32(_NOISE) * rise.max(axis=-1, keepdims=True), 0.0)
    height, first, second = np.moveaxis((rise @ _MOMENTS).astype(np.float64), -1, 0)
    total = np.maximum(height, 1e-9)
    offset = first / total
    return EdgeTransitions(offset, np.sqrt(np.maximum(second / total - offset**2, 0.0)), height)
