"""Which blobs of changed pixels are objects: evidence from their strength, their sharpness and their edges.

- **Strength**: enough of a blob's pixels differ from the background by more than the place usually does.
- **Extent**: a blob ends where the difference falls below a share of the blob's contrast. A small share is tried first,
  so that the pale parts of a drone belong to the blob. Where the contour at this share is not steep almost all around,
  a larger share is taken, so that a small dark drone does not grow together with the faint change of a cloud.
- **Sharpness**: the difference to the background rises steeply at the blob's contour. Clouds, soft shadows and lamps
  change the image gradually. A fast object is blurred along its path; it is not where it was in the frame before.
- **Edges**: an object has edges of its own in the frame. Where an object left, the background has these edges instead
  (a ghost); where leaves or waves move, both have edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

#: Smallest number of strong pixels of a blob.
_STRONG_PIXELS = 2
#: Share of a blob's pixels that must be strong, at places that are calm and at places that are restless.
_CALM_SHARE, _RESTLESS_SHARE = 0.1, 0.3
#: Extents of a blob, in the order in which they are tried: share of the blob's contrast by which its pixels differ at
#: least, and part of the contour that must be steep.
_EXTENTS = ((0.2, 0.7), (0.4, 0.0))
#: A higher contrast, grey levels, counts as this one: objects also have parts that hardly differ from the background.
_LARGEST_CONTRAST = 80.0
#: A contour is steep where the difference rises by this share of the difference at which the blob ends, and by noise.
_STEEP = 0.5
#: Gradient of the difference at the contour, per 2 pixels: at least this share of the blob's mean difference, and what
#: noise and codecs add. In shares of the mean difference, drawn and real drones have 0.5 to 3 down to 3 px; drifting
#: clouds 0.06 to 0.5.
_SHARP, _NOISE_GRADIENT = 0.4, 2.0
#: The share for a fast object, such as a ball of 10 px that is blurred over 30. An object is fast if the frame before
#: showed less than the second share of its difference at the same place, and more than the third share of its pixels
#: are strong. Speckle in a codec's key frames comes suddenly too, but fewer of its pixels are strong.
_SHARP_FAST, _SEEN_BEFORE, _FAST_STRONG = 0.25, 0.5, 0.6
#: Larger differences do not need sharper contours, grey levels.
_SHARP_DIFFERENCE = 40.0
#: Edges of an object at its contour, relative to the background's edges at the same place, and above them.
_OWN_EDGES, _LEAST_EDGE = 1.3, 2.0
_AROUND = np.ones((3, 3), np.uint8)
#: Number of pixels about a blob that decide whether the blob is an object: foreground of MOG2 within 2 pixels touches
#: the blob, and the gradient at its contour uses 2 pixels beyond.
_MARGIN = 4

_Mask = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class ObjectBlobs:
    """Objects of one frame.

    Attributes:
        mask: (height, width), 255 at the pixels of blobs that are foreground, else 0.
        found: the same blobs, with their contours.
    """

    mask: _Mask
    found: list[tuple[_PixelBlobs, _PixelBlobs]]

    def with_own_edges(
        self, image: UInt8[np.ndarray, "height width 3"], background: UInt8[np.ndarray, "height width 3"]
    ) -> _Mask:
        """(height, width), 255 at the blobs that have edges of their own: objects, also if they stand still."""
        own = np.zeros_like(self.mask)
        for blobs, contours in self.found:
            edges, before = (
                contours.means(_gradient_at(levels, contours.pixels)) for levels in (image, background)
            )
            has_edges = edges > _OWN_EDGES * before + _LEAST_EDGE
            own.ravel()[blobs.chosen(has_edges).pixels] = 255
        return own


def find_objects(
    changed: _Mask,
    strong: _Mask,
    difference: _Mask,
    before: _Mask,
    restless: Bool[np.ndarray, "height width"],
    least_px: int,
) -> ObjectBlobs:
    """Find the objects among the blobs of changed pixels.

    Args:
        changed: (height, width), above 0 at the pixels that differ from the background.
        strong: (height, width), above 0 at the pixels that differ by more than the place usually does.
        difference: (height, width), the largest difference of the channels, grey levels.
        before: (height, width), that of the frame before.
        restless: (height, width), whether leaves, screens, waves or noise change the place again and again.
        least_px: smallest number of pixels of a blob.
    """
    mask, found = np.zeros_like(changed), []
    for share, steep_part in _EXTENTS:
        blobs = _find_blobs(changed, strong, difference, least_px, share)
        num_restless = blobs.sums(restless.ravel()[blobs.pixels])
        enough = _CALM_SHARE * (blobs.area - num_restless) + _RESTLESS_SHARE * num_restless
        num_strong = blobs.sums(strong.ravel()[blobs.pixels] > 0)
        mostly_strong = num_strong > _FAST_STRONG * blobs.area
        blobs = blobs.chosen(num_strong >= np.maximum(_STRONG_PIXELS, enough))
        if not blobs.area.any():
            break
        contours = _contours(blobs, changed.shape)
        levels, steepness = difference.ravel()[blobs.pixels], _gradient_at(difference, contours.pixels)
        mean = blobs.means(levels)
        is_fast = mostly_strong & (blobs.means(before.ravel()[blobs.pixels]) < _SEEN_BEFORE * mean)
        sharp = np.where(is_fast, _SHARP_FAST, _SHARP) * np.minimum(mean, _SHARP_DIFFERENCE)
        is_sharp = contours.means(steepness) > sharp + _NOISE_GRADIENT
        # Where the difference is a step, and not the slope of a cloud.
        step = _STEEP * _ending_level(blobs, levels, share) + _NOISE_GRADIENT
        is_steep = contours.means(steepness > step[contours.blob]) >= steep_part
        # A blob that fills the image has no contour.
        is_object = (contours.area == 0) | (is_sharp & is_steep)
        objects = blobs.chosen(is_object)
        mask.ravel()[objects.pixels] = 255
        found.append((objects, contours))
        if len(objects.pixels) == len(blobs.pixels):
            break
        changed = _mask_of(blobs.chosen(~is_object).pixels, changed.shape)
    return ObjectBlobs(mask, found)


def possible_objects(differs: _Mask, strong: _Mask) -> tuple[_Mask, tuple[slice, slice]]:
    """The blobs of pixels that differ which have enough strong pixels, and the part of the image that they need.

    Args:
        differs: (height, width), above 0 at the pixels that differ from the background.
        strong: (height, width), above 0 at those that differ by more than the place usually does.

    Returns:
        (height, width), 255 at the pixels of these blobs, else 0; rows and columns of them and what is beside them.
    """
    blobs = _connected(differs)
    enough = blobs.sums(strong.ravel()[blobs.pixels] > 0) >= _STRONG_PIXELS
    mask = _mask_of(blobs.chosen(enough).pixels, differs.shape)
    x, y, width, height = cv2.boundingRect(mask)
    rows, columns = (slice(max(0, at - _MARGIN), at + n + _MARGIN) for at, n in ((y, height), (x, width)))
    return mask, (rows, columns)


@dataclass(frozen=True)
class _PixelBlobs:
    """Blobs, or their contours, as a list of pixels.

    Attributes:
        pixels: (pixels,), indices into the flat image.
        blob: (pixels,), blob of each pixel.
        area: (blobs,), number of pixels of each blob; some have none.
    """

    pixels: Int[np.ndarray, "pixels"]
    blob: Int[np.ndarray, "pixels"]
    area: Int[np.ndarray, "blobs"]

    def sums(self, values: Shaped[np.ndarray, "pixels"]) -> Shaped[np.ndarray, "blobs"]:
        """(blobs,), sum of the values of each blob's pixels."""
        return np.bincount(self.blob, values, minlength=len(self.area))

    def means(self, values: Shaped[np.ndarray, "pixels"]) -> Float[np.ndarray, "blobs"]:
        """(blobs,), mean of the values of each blob's pixels; 0 where a blob has none."""
        return self.sums(values) / np.maximum(self.area, 1)

    def chosen(self, chosen: Bool[np.ndarray, "blobs"]) -> _PixelBlobs:
        """Some of the blobs; the others have no pixels."""
        kept = chosen[self.blob]
        return _PixelBlobs(self.pixels[kept], self.blob[kept], np.where(chosen, self.area, 0))


def _find_blobs(changed: _Mask, strong: _Mask, difference: _Mask, least_px: int, share: float) -> _PixelBlobs:
    """The blobs with strong pixels and enough changed pixels, each as far as a share of its contrast goes."""
    wide = _connected(changed)
    strong_of_pixels = strong.ravel()[wide.pixels] > 0
    levels = difference.ravel()[wide.pixels]
    num_strong = wide.sums(strong_of_pixels)
    least = _ending_level(wide, np.where(strong_of_pixels, levels, 0), share)
    enough = (num_strong >= _STRONG_PIXELS) & (wide.area >= least_px)
    kept = enough[wide.blob] & (levels > least[wide.blob])
    return _connected(_mask_of(wide.pixels[kept], changed.shape))


def _ending_level(
    blobs: _PixelBlobs, levels: Shaped[np.ndarray, "pixels"], share: float
) -> Float[np.ndarray, "blobs"]:
    """(blobs,), the difference at which a blob ends: a share of the blob's contrast, the mean of its levels.

    The levels themselves are the weights of the mean: many faint pixels of a cloud do not outvote a small drone.
    """
    weights = levels.astype(float)
    contrast = blobs.sums(weights**2) / np.maximum(blobs.sums(weights), 1)
    return share * np.minimum(contrast, _LARGEST_CONTRAST)


def _connected(mask: _Mask) -> _PixelBlobs:
    """The 8-connected blobs of a mask."""
    _, top, _, height = cv2.boundingRect(mask)
    rows = mask[top : top + height]
    count, labels = cv2.connectedComponents(rows, connectivity=8) if height else (1, rows)
    inside = np.flatnonzero(rows > 0)  # several times faster than of the labels
    blob = labels.ravel()[inside].astype(np.intp)
    return _PixelBlobs(inside + top * mask.shape[1], blob, np.bincount(blob, minlength=count))


def _contours(blobs: _PixelBlobs, shape: tuple[int, ...]) -> _PixelBlobs:
    """Pixels on both sides of the contours of blobs.

    A pixel outside belongs to the blob with the largest number beside the pixel.
    """
    labels = np.zeros(shape, np.float32)
    labels.ravel()[blobs.pixels] = blobs.blob
    # Two blobs never touch, so that at a pixel inside, the largest number around is its own.
    largest_around = cv2.dilate(labels, _AROUND)
    points = np.flatnonzero((largest_around > 0) & (cv2.erode(labels, _AROUND) == 0))
    blob = largest_around.ravel()[points].astype(np.intp)
    return _PixelBlobs(points, blob, np.bincount(blob, minlength=len(blobs.area)))


def _gradient_at(
    image: UInt8[np.ndarray, "height width *channels"], points: Int[np.ndarray, "points"]
) -> Float[np.ndarray, "points"]:
    """What `gradient` is at some pixels, given as flat indices; beyond the border, its pixels are repeated."""
    along = [cv2.Sobel(image, cv2.CV_16S, dx, 1 - dx, borderType=cv2.BORDER_REPLICATE) for dx in (1, 0)]
    along_x, along_y = (way.reshape(-1, *image.shape[2:]).take(points, axis=0) for way in along)
    square = along_x.astype(np.float32) ** 2 + along_y.astype(np.float32) ** 2
    return np.sqrt(square if square.ndim == 1 else largest(square[None])[0]) / 4


def gradient(image: UInt8[np.ndarray, "height width *channels"]) -> Float[np.ndarray, "height width"]:
    """Length of the gradient, grey levels per 2 pixels (the height of a step between two pixels); of all channels the
    largest."""
    along_x = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
    along_y = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
    length = cv2.magnitude(along_x, along_y)
    return np.asarray(length if length.ndim == 2 else largest(length))


def largest(image: Shaped[np.ndarray, "height width 3"]) -> Shaped[np.ndarray, "height width"]:
    """The largest of the three channels."""
    blue, green, red = cv2.split(image, list(np.empty((3, *image.shape[:2]), image.dtype)))
    return np.asarray(cv2.max(cv2.max(blue, green), red))


def _mask_of(pixels: Int[np.ndarray, "pixels"], shape: tuple[int, ...]) -> _Mask:
    mask = np.zeros(shape, np.uint8)
    mask.ravel()[pixels] = 255
    return mask
