"""What a network finds in one frame: the probability of each pixel, and boxes."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from psotrack.foreground.network.network import CELL_PX, MULTIPLE, Found, Network, inputs_of
from psotrack.support import as_written

#: Version of the findings: what is stored of another version is not used again.
FINDING_VERSION = 2
#: Confidence from which on a box counts where the caller names none.
USUAL_CONFIDENCE = 0.3
#: A box of which nine of ten pixels differ from the background by less, grey levels, shows nothing that moves. Chosen
#: on published clips and simulated drones: those that hover differ more, because rotors turn and drones sway.
_STANDS_STILL = 10.0
#: Factor of the confidence of such a box, which is mostly about a thing of the scene that looks like a drone.
_DOUBT = 0.5


@as_written()
def findings(
    network: Network,
    image: UInt8[np.ndarray, "height width 3"],
    background: UInt8[np.ndarray, "height width 3"] | None,
    confidence: float = USUAL_CONFIDENCE,
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "found 4"], Float[np.ndarray, "found"]]:
    """The probability of each pixel of a reduced frame, and boxes, xyxy in its pixels, with their confidences.

    A box in which nothing differs from the background has half of the confidence that the network tells.

    Args:
        network: the network.
        image: the reduced frame, BGR.
        background: the learned background; None where it is not known.
        confidence: least confidence of a box.
    """
    height, width = image.shape[:2]
    known = image if background is None else background
    arrays = padded(np.asarray(image)), padded(np.asarray(known)), np.array(background is not None)
    share, middle, box = _find(network, *jax.device_put([each[None] for each in arrays]))
    boxes, told = boxes_of(np.asarray(middle), np.asarray(box), confidence)
    if background is not None:
        told = np.where(_stand_still(boxes, image, background), _DOUBT * told, told)
    counts = told >= confidence
    return np.asarray(share)[:height, :width], boxes[counts], told[counts]


def _stand_still(
    boxes: Float[np.ndarray, "found 4"],
    image: UInt8[np.ndarray, "height width 3"],
    background: UInt8[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "found"]:
    """Whether nothing in a box, xyxy in pixels of the image, differs from the background."""
    limits = np.tile(image.shape[1::-1], 2)
    whole = np.clip(np.column_stack([np.floor(boxes[:, :2]), np.ceil(boxes[:, 2:])]), 0, limits).astype(int)
    still = np.zeros(len(boxes), bool)
    for index, (x0, y0, x1, y1) in enumerate(whole):
        differs = np.abs(image[y0:y1, x0:x1].astype(np.int16) - background[y0:y1, x0:x1]).max(axis=-1)
        still[index] = differs.size > 0 and np.percentile(differs, 90) < _STANDS_STILL
    return still


@eqx.filter_jit
def _find(
    network: Network,
    image: UInt8[Array, "1 height width 3"],
    background: UInt8[Array, "1 height width 3"],
    is_known: Bool[Array, "1"],
) -> tuple[Array, Array, Array]:
    return peaks_of(network(inputs_of(image.astype(jnp.float32), background.astype(jnp.float32), is_known)))


def padded(image: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
    """The image with pixels at its lower and right border repeated, so that its size is one that the network takes."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, -height % MULTIPLE), (0, -width % MULTIPLE), (0, 0)), mode="edge")


def peaks_of(
    found: Found,
) -> tuple[Float[Array, "height width"], Float[Array, "rows columns"], Float[Array, "rows columns 4"]]:
    """Of one image the probability of each pixel, that of each cell that is more than its neighbours, and the boxes."""
    share = jax.nn.sigmoid(found.middle[0])
    around = jax.lax.reduce_window(share, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")
    return jax.nn.sigmoid(found.pixel[0]), jnp.where(share == around, share, 0.0), found.box[0]


def boxes_of(
    middle: Float[np.ndarray, "rows columns"], box: Float[np.ndarray, "rows columns 4"], confidence: float
) -> tuple[Float[np.ndarray, "found 4"], Float[np.ndarray, "found"]]:
    """Boxes, xyxy in pixels of the input, and their confidences, the highest first.

    Args:
        middle, box: see `peaks_of`.
        confidence: least confidence of a box.
    """
    row, column = np.nonzero(middle >= confidence)
    order = np.argsort(-middle[row, column], kind="stable")
    row, column = row[order], column[order]
    told = box[row, column].astype(np.float64)
    place, half = np.column_stack([column, row]) + 0.5 + told[:, :2], np.exp(told[:, 2:])
    return CELL_PX * np.hstack([place - half, place + half]), middle[row, column].astype(np.float64)
