"""What the markers of a dictionary look like, and how well quadrangles in an image look like them.

A quadrangle of another kind may show a marker's bits by chance. Its brightness at every place, between the cells'
middles too, and on both sides of its outline, tells the two apart.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.errors import SettingsError

#: Samples along each side of a cell; the widths of blur that a pattern is tried with, in cells (up to half a cell's
#: blur, above which cells cannot be read); and how much of the outside is compared, and reached by blur, in cells.
_FINE, _BLURS, _COMPARED, _OUTSIDE = 4, (0.0, 0.15, 0.3, 0.45, 0.6), 0.5, 2


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's ArUco dictionary with a name such as 4x4_50 or DICT_4X4_50.

    Raises:
        SettingsError: OpenCV has no dictionary with this name.
    """
    known = {key[5:].lower(): number for key, number in vars(cv2.aruco).items() if key.startswith("DICT_")}
    short = name.lower().removeprefix("dict_")
    if short not in known:
        raise SettingsError("dictionary", expected=f"one of {', '.join(sorted(known))}", found=name)
    return cv2.aruco.getPredefinedDictionary(known[short])


class MarkerPatterns:
    """Patterns of the markers of a dictionary.

    Attributes:
        white: (markers, cells, cells), which cells of each marker are white; cells of the border are black.
    """

    def __init__(self, dictionary: cv2.aruco.Dictionary) -> None:
        cells = dictionary.markerSize + 2
        drawn = [
            cv2.aruco.generateImageMarker(dictionary, index, cells)
            for index in range(len(dictionary.bytesList))
        ]
        self.white: Bool[np.ndarray, "markers cells cells"] = np.array(drawn, np.uint8) > 0
        side = round(_FINE * (cells + 2 * _COMPARED))
        places = ((np.arange(side) + 0.5) / _FINE - _COMPARED) / cells
        self._places = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
        self._drawn: dict[int, Float[np.ndarray, "blurs places"]] = {}

    def agreement(
        self,
        gray: UInt8[np.ndarray, "height width"],
        quads_px: Float[np.ndarray, "quads 4 2"],
        index: Int[np.ndarray, " quads"],
    ) -> Float[np.ndarray, " quads"]:
        """Correlation of quadrangles with markers, at the blur that fits best: 1 to -1, negative for inverted prints.

        Args:
            gray: (height, width).
            quads_px: (quads, 4, 2), from the marker's own top left, pixels.
            index: (quads,), number of each marker among `white`.
        """
        if not len(index):
            return np.zeros(0)
        at = to_pixels(quads_px, self._places).astype(np.float32)
        levels = cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        levels = _normalised(np.asarray(levels, np.float64))
        found = np.stack(
            [self._pattern(one) @ level for one, level in zip(index.tolist(), levels, strict=True)]
        )
        return found[np.arange(len(index)), np.abs(found).argmax(axis=1)]

    def _pattern(self, index: int) -> Float[np.ndarray, "blurs places"]:
        """A marker with what lies around it, at each blur."""
        if index not in self._drawn:
            fine = np.kron(
                np.pad(self.white[index], _OUTSIDE, constant_values=True), np.ones((_FINE, _FINE), np.float32)
            )
            cut = slice(round(_FINE * (_OUTSIDE - _COMPARED)), -round(_FINE * (_OUTSIDE - _COMPARED)))
            blurred = [cv2.GaussianBlur(fine, (0, 0), blur * _FINE) if blur else fine for blur in _BLURS]
            self._drawn[index] = _normalised(np.stack([each[cut, cut].ravel() for each in blurred]))
        return self._drawn[index]


def to_pixels(
    quads_px: Float[np.ndarray, "quads 4 2"], places: Float[np.ndarray, "places 2"]
) -> Float[np.ndarray, "quads places 2"]:
    """Pixels of places of the unit square that each quadrangle is (Heckbert, Fundamentals of texture mapping, 1989)."""
    a, b, c, d = np.moveaxis(np.asarray(quads_px, np.float64), 1, 0)
    ab, cd, both = b - c, d - c, a - b + c - d
    area = ab[:, 0] * cd[:, 1] - ab[:, 1] * cd[:, 0]
    area = np.where(np.abs(area) < 1e-12, 1e-12, area)
    g = ((both[:, 0] * cd[:, 1] - both[:, 1] * cd[:, 0]) / area)[:, None]
    h = ((ab[:, 0] * both[:, 1] - ab[:, 1] * both[:, 0]) / area)[:, None]
    u, v = places.T[:, None, :, None]
    depth = 1 + g[..., None] * u + h[..., None] * v
    return (a[:, None] + (b - a + g * b)[:, None] * u + (d - a + h * d)[:, None] * v) / depth


def _normalised(rows: Float[np.ndarray, "rows values"]) -> Float[np.ndarray, "rows values"]:
    rows = rows - rows.mean(axis=1, keepdims=True)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
