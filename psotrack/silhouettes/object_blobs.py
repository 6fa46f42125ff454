"""Which blobs of changed pixels are objects: evidence from their strength, their sharpness and their edges.

- **Strength**: enough of a blob's pixels differ from the background by more than the place usually does.
- **Sharpness**: the difference to the background rises steeply at the blob's contour. Clouds, soft shadows and lamps
  change the image gradually.
- **Edges**: an object has edges of its own in the frame. Where an object left, the background has these edges instead
  (a ghost); where leaves or waves move, both have edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

#: Smallest number of strong pixels of a blob.
_STRONG_PIXELS = 2
#: Share of a blob's pixels that must be strong, at places that are calm and at places that are restless.
_CALM_SHARE, _RESTLESS_SHARE = 0.1, 0.3
#: Gradient of the difference at the contour, per 2 pixels, as a share of the blob's mean difference. Drawn and real
#: drones have 0.6 to 1.3, also at 8 px; drifting clouds 0.06 to 0.3.
_SHARP = 0.4
#: Larger differences do not need sharper contours, grey levels.
_SHARP_DIFFERENCE = 40.0
#: Edges of an object at its contour, relative to the background's edges at the same place, and above them.
_OWN_EDGES, _LEAST_EDGE = 1.3, 2.0

_AROUND = np.ones((3, 3), np.uint8)

_Mask = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class ObjectBlobs:
    """Objects of one frame.

    Attributes:
        mask: (height, width), 255 at the pixels of blobs that are foreground, else 0.
        own: (height, width), 255 at those of them that have edges of their own: objects, also if they stand still.
    """

    mask: _Mask
    own: _Mask


def find_objects(
    changed: _Mask,
    strong: _Mask,
    image: UInt8[np.ndarray, "height width 3"],
    background: UInt8[np.ndarray, "height width 3"],
    difference: _Mask,
    restless: Bool[np.ndarray, "height width"],
    least_px: int,
) -> ObjectBlobs:
    """Find the objects among the blobs of changed pixels.

    Args:
        changed: (height, width), above 0 at the pixels that differ from the background.
        strong: (height, width), above 0 at the pixels that differ by more than the place usually does.
        image: (height, width, 3), the frame.
        background: (height, width, 3), the background.
        difference: (height, width), the largest difference of the channels, grey levels.
        restless: (height, width), whether leaves, screens, waves or noise change the place again and again.
        least_px: smallest number of pixels of a blob.
    """
    nothing = np.zeros_like(changed)
    if not strong.any():
        return ObjectBlobs(nothing, nothing)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    pixels = np.flatnonzero(changed)
    of_pixels = labels.ravel()[pixels]
    num_strong = np.bincount(of_pixels[strong.ravel()[pixels] > 0], minlength=count)
    num_restless = np.bincount(of_pixels[restless.ravel()[pixels]], minlength=count)
    enough = _CALM_SHARE * (area - num_restless) + _RESTLESS_SHARE * num_restless
    is_object = (num_strong >= np.maximum(_STRONG_PIXELS, enough)) & (area >= least_px)
    is_object[0] = False
    if not is_object.any():
        return ObjectBlobs(nothing, nothing)
    mean_difference = np.bincount(of_pixels, difference.ravel()[pixels], minlength=count) / np.maximum(
        area, 1
    )
    mask = _mask_of(is_object, labels)
    contour = (cv2.dilate(mask, _AROUND) > 0) & (cv2.erode(mask, _AROUND) == 0)
    # A pixel outside belongs to the contour of the blob with the largest label beside the pixel.
    of_contour = cv2.dilate(np.where(mask > 0, labels, 0).astype(np.float32), _AROUND)[contour].astype(int)
    length = np.maximum(np.bincount(of_contour, minlength=count), 1)
    edges, edges_before, steepness = (
        np.bincount(of_contour, gradient(levels)[contour], minlength=count) / length
        for levels in (image, background, difference)
    )
    has_contour = np.bincount(of_contour, minlength=count) > 0
    sharp = steepness > _SHARP * np.minimum(mean_difference, _SHARP_DIFFERENCE)
    # A blob that fills the image has no contour.
    is_object &= sharp | ~has_contour
    own = is_object & (edges > _OWN_EDGES * edges_before + _LEAST_EDGE)
    return ObjectBlobs(_mask_of(is_object, labels), _mask_of(own, labels))


def gradient(image: UInt8[np.ndarray, "height width *channels"]) -> Float[np.ndarray, "height width"]:
    """Length of the gradient, grey levels per 2 pixels (the height of a step between two pixels); of all channels the
    largest."""
    along_x = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
    along_y = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
    length = cv2.magnitude(along_x, along_y)
    return np.asarray(length if length.ndim == 2 else largest(length))


def largest(image: Shaped[np.ndarray, "height width 3"]) -> Shaped[np.ndarray, "height width"]:
    """The largest of the three channels."""
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red))


def _mask_of(chosen: Bool[np.ndarray, "blobs"], labels: np.ndarray) -> _Mask:
    return np.where(chosen[labels], np.uint8(255), np.uint8(0))
