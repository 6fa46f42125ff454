"""Reading of markers: which marker of a dictionary, in which orientation and polarity, a quadrangle shows.

A dictionary's markers differ in many bits, so that a few wrong bits are corrected (Garrido-Jurado et al., Pattern
Recognition 47(6), 2014). A quadrangle of another kind may show a marker's bits by chance. The agreement of its
brightness with the marker's cells, those of the border included, tells the two apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64

#: Places inside a cell at which its brightness is sampled, along each side, in cells: blur mixes the rest.
_IN_CELL = np.array([0.3, 0.5, 0.7])
#: Share of a dictionary's correctable bits that are corrected, and wrong cells of the border per cell of the code: the
#: values of OpenCV's defaults.
_CORRECTED, _WRONG_BORDER = 0.6, 0.35
#: Distance from the outline, in cells, at which its two sides are compared, and number of places along each side.
_BESIDE, _ALONG = 0.4, 12
#: Smallest difference between the two sides of the outline, as a share of the contrast between white and black.
_LEAST_STEP = 0.2
#: Samples along each side of a cell where a whole marker is compared with its pattern, the widths of blur that the
#: pattern is tried with, in cells (up to half a cell's blur, above which cells cannot be read), and how much of the
#: outside the blur reaches, in cells.
_FINE, _BLURS, _OUTSIDE = 4, (0.0, 0.15, 0.3, 0.45, 0.6), 2
#: Largest number of quadrangles that are sampled at once: OpenCV's limit on image sizes is 32767.
_AT_ONCE = 8192
#: Number of quadrangles whose cells are compared with all codes at once: 32 MB for a dictionary of 1000 markers.
_COMPARED = 1024


@dataclass(frozen=True)
class ReadMarkers:
    """What quadrangles show.

    Attributes:
        index: (quads,), number of the marker among the codes; -1 where a quadrangle shows none.
        turn: (quads,), number of the quadrangle's corner that is the marker's own top left.
        inverted: (quads,), whether the print is white on black.
        agreement: (quads,), correlation of the cells' brightness with the marker's cells, -1 to 1.
        contrast: (quads,), difference of brightness between white and black cells, grey levels.
    """

    index: Int[np.ndarray, " quads"]
    turn: Int[np.ndarray, " quads"]
    inverted: Bool[np.ndarray, " quads"]
    agreement: Float[np.ndarray, " quads"]
    contrast: Float[np.ndarray, " quads"]


class MarkerCodes:
    """Codes of the markers of a dictionary, in all four orientations.

    Args:
        dictionary: the markers.

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
        self._most_wrong = int(dictionary.maxCorrectionBits * _CORRECTED)
        self._most_wrong_border = int(dictionary.markerSize**2 * _WRONG_BORDER)
        # What a camera sees in a quadrangle whose corner number `turn` is the marker's own top left.
        inner = self.white[:, 1:-1, 1:-1]
        turned = np.stack([np.rot90(inner, -turn, axes=(1, 2)) for turn in range(4)], axis=1)
        self._codes = _packed(turned.reshape(4 * len(inner), -1))

    @property
    def chance(self) -> float:
        """Probability that random cells are read as a marker, in one polarity."""
        bits = (self.cells - 2) ** 2
        near = sum(comb(bits, wrong) for wrong in range(self._most_wrong + 1))
        return len(self._codes) * near / 2.0**bits

    @property
    def plain(self) -> Bool[np.ndarray, " markers"]:
        """Which markers have, but for one cell, cells of one colour within the border: any frame looks like those."""
        white = self.white[:, 1:-1, 1:-1].sum(axis=(1, 2))
        return (white <= 1) | (white >= (self.cells - 2) ** 2 - 1)

    @property
    def cells(self) -> int:
        """Cells along a marker's side, with the border."""
        return self.white.shape[1]

    def read(
        self, gray: UInt8[np.ndarray, "rows columns"], quads_px: Float[np.ndarray, "quads 4 2"]
    ) -> ReadMarkers:
        """Read what quadrangles in an image show.

        Args:
            gray: (rows, columns).
            quads_px: (quads, 4, 2), clockwise, pixels.
        """
        levels = sample_cells(gray, quads_px, self.cells)
        bits = levels > _split(levels.reshape(len(levels), self.cells**2))[:, None, None]
        ring = np.ones((self.cells, self.cells), bool)
        ring[1:-1, 1:-1] = False
        wrong_border = bits[:, ring].sum(axis=1)
        inverted = 2 * wrong_border > ring.sum()
        wrong_border = np.where(inverted, ring.sum() - wrong_border, wrong_border)
        inner = (bits ^ inverted[:, None, None])[:, 1:-1, 1:-1]
        best, wrong = self._nearest(_packed(inner.reshape(len(levels), (self.cells - 2) ** 2)))
        is_read = (wrong <= self._most_wrong) & (wrong_border <= self._most_wrong_border)
        index, turn = best // 4, best % 4
        agreement, contrast = self.agreement(levels, index, turn, inverted)
        return ReadMarkers(np.where(is_read, index, -1), turn, inverted, agreement, contrast)

    def _nearest(
        self, seen: UInt64[np.ndarray, " quads"]
    ) -> tuple[Int[np.ndarray, " quads"], Int[np.ndarray, " quads"]]:
        """Number of the code with the fewest wrong bits, and the number of these bits."""
        best, wrong = np.zeros(len(seen), np.int64), np.zeros(len(seen), np.int64)
        for first in range(0, len(seen), _COMPARED):
            some = slice(first, first + _COMPARED)
            wrong_of_all = np.bitwise_count(seen[some, None] ^ self._codes)
            best[some], wrong[some] = wrong_of_all.argmin(axis=1), wrong_of_all.min(axis=1)
        return best, wrong

    def agreement(
        self,
        levels: Float[np.ndarray, "quads cells cells"],
        index: Int[np.ndarray, " quads"],
        turn: Int[np.ndarray, " quads"],
        inverted: Bool[np.ndarray, " quads"],
    ) -> tuple[Float[np.ndarray, " quads"], Float[np.ndarray, " quads"]]:
        """Correlation of the cells' brightness with those of markers, and the contrast between white and black."""
        shown = self.white[index]
        for times in (1, 2, 3):
            shown = np.where(
                (turn == times)[:, None, None], np.rot90(self.white[index], -times, axes=(1, 2)), shown
            )
        sign = np.where(shown ^ inverted[:, None, None], 1.0, -1.0).reshape(len(levels), self.cells**2)
        sign -= sign.mean(axis=1, keepdims=True)
        off = levels.reshape(len(levels), self.cells**2) - levels.mean(axis=(1, 2))[:, None]
        product, power = (sign * off).sum(axis=1), (sign**2).sum(axis=1)
        scatter = np.maximum((off**2).sum(axis=1), 1e-9)
        return product / np.sqrt(power * scatter), 2 * product / power


def share_outlined(
    gray: UInt8[np.ndarray, "rows columns"],
    quads_px: Float[np.ndarray, "quads 4 2"],
    cells: int,
    inverted: Bool[np.ndarray, " quads"],
    contrast: Float[np.ndarray, " quads"],
) -> Float[np.ndarray, " quads"]:
    """Share of the outline at which the outside is lighter than the border; darker, around an inverted print.

    Where the outside is out of the image it counts as not lighter: what the image's border leaves of a marker may look
    like another one.

    Args:
        gray: (rows, columns).
        quads_px: (quads, 4, 2), pixels.
        cells: cells along a marker's side, with the border.
        inverted: (quads,), whether the print is white on black.
        contrast: (quads,), difference of brightness between white and black cells, grey levels.
    """
    along, beside = (np.arange(_ALONG) + 0.5) / _ALONG, _BESIDE / cells
    sides, places = [], []
    for across in (-beside, beside):
        first, last = np.full(_ALONG, across), np.full(_ALONG, 1.0 - across)
        u, v = np.concatenate([along, along, first, last]), np.concatenate([first, last, along, along])
        places.append(np.stack([u, v], axis=-1))
        sides.append(_sample(gray, quads_px, places[-1]))
    step = (sides[0] - sides[1]) * np.where(inverted, -1.0, 1.0)[:, None]
    is_edge = step > _LEAST_STEP * np.maximum(contrast, 1.0)[:, None]
    return (is_edge & _in_image(gray, quads_px, places[0])).mean(axis=1)


def pattern_agreement(
    gray: UInt8[np.ndarray, "rows columns"],
    quads_px: Float[np.ndarray, "quads 4 2"],
    white: Bool[np.ndarray, "quads cells cells"],
) -> Float[np.ndarray, " quads"]:
    """Correlation of quadrangles with a marker's pattern at every place, at the blur that fits best, -1 to 1.

    The middles of the cells alone look alike where the print has other cells: a marker of another dictionary, or the
    squares of a chessboard. Between the middles such a print has edges where the pattern has none.

    Args:
        gray: (rows, columns).
        quads_px: (quads, 4, 2), from the marker's own top left, pixels.
        white: (quads, cells, cells), which cells of each marker are white, those of the border included.
    """
    places = (np.arange(white.shape[1] * _FINE) + 0.5) / (white.shape[1] * _FINE)
    levels = _sample(gray, quads_px, np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2))
    fine = np.ones((_FINE, _FINE), np.float32)
    found = np.full(len(quads_px), -1.0)
    for quad, cells in enumerate(white):
        # Around the border lies the other colour.
        drawn = np.kron(np.pad(cells, _OUTSIDE, constant_values=not cells[0, 0]), fine)
        for blur in _BLURS:
            shown = cv2.GaussianBlur(drawn, (0, 0), blur * _FINE) if blur else drawn
            inside = np.asarray(shown)[
                _OUTSIDE * _FINE : -_OUTSIDE * _FINE, _OUTSIDE * _FINE : -_OUTSIDE * _FINE
            ]
            found[quad] = max(found[quad], _correlation(inside.ravel(), levels[quad]))
    return found


def _correlation(one: Float[np.ndarray, " values"], other: Float[np.ndarray, " values"]) -> float:
    off, other_off = one - one.mean(), other - other.mean()
    return float(off @ other_off / np.sqrt(max(float(off @ off) * float(other_off @ other_off), 1e-9)))


def sample_cells(
    gray: UInt8[np.ndarray, "rows columns"], quads_px: Float[np.ndarray, "quads 4 2"], cells: int
) -> Float[np.ndarray, "quads cells cells"]:
    """Mean brightness of the inner part of each cell of quadrangles, rows of cells from the first side on."""
    places = ((np.arange(cells)[:, None] + _IN_CELL) / cells).ravel()
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    inside = len(_IN_CELL)
    return _sample(gray, quads_px, grid).reshape(-1, cells, inside, cells, inside).mean(axis=(2, 4))


def _sample(
    gray: UInt8[np.ndarray, "rows columns"],
    quads_px: Float[np.ndarray, "quads 4 2"],
    places: Float[np.ndarray, "places 2"],
) -> Float[np.ndarray, "quads places"]:
    """Brightness at places of the unit square that each quadrangle is."""
    found = np.zeros((len(quads_px), len(places)))
    for first in range(0, len(quads_px), _AT_ONCE):
        x, y = _pixels(quads_px[first : first + _AT_ONCE], places)
        at = (x.astype(np.float32), y.astype(np.float32))
        found[first : first + _AT_ONCE] = cv2.remap(
            gray, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return found


def _in_image(
    gray: UInt8[np.ndarray, "rows columns"],
    quads_px: Float[np.ndarray, "quads 4 2"],
    places: Float[np.ndarray, "places 2"],
) -> Bool[np.ndarray, "quads places"]:
    """Which places of the unit square that each quadrangle is are in the image."""
    x, y = _pixels(quads_px, places)
    rows, columns = gray.shape
    return (x > -0.5) & (x < columns - 0.5) & (y > -0.5) & (y < rows - 0.5)


def _pixels(
    quads_px: Float[np.ndarray, "quads 4 2"], places: Float[np.ndarray, "places 2"]
) -> tuple[Float[np.ndarray, "quads places"], Float[np.ndarray, "quads places"]]:
    """Pixels, x and y, of places of the unit square that each quadrangle is."""
    to_image = homographies(quads_px)
    x, y, depth = np.moveaxis(to_image[..., :2] @ places.T + to_image[..., 2:], 1, 0)
    return x / depth, y / depth


def homographies(quads_px: Float[np.ndarray, "quads 4 2"]) -> Float[np.ndarray, "quads 3 3"]:
    """Homographies from the unit square to quadrangles (Heckbert, Fundamentals of texture mapping, 1989, section 2)."""
    a, b, c, d = np.moveaxis(np.asarray(quads_px, np.float64), 1, 0)
    ab, cd, both = b - c, d - c, a - b + c - d
    area = ab[:, 0] * cd[:, 1] - ab[:, 1] * cd[:, 0]
    area = np.where(np.abs(area) < 1e-12, 1e-12, area)
    g = (both[:, 0] * cd[:, 1] - both[:, 1] * cd[:, 0]) / area
    h = (ab[:, 0] * both[:, 1] - ab[:, 1] * both[:, 0]) / area
    columns = [b - a + g[:, None] * b, d - a + h[:, None] * d, a]
    top = np.stack(columns, axis=-1)
    return np.concatenate([top, np.stack([g, h, np.ones_like(g)], axis=-1)[:, None]], axis=1)


def _packed(bits: Bool[np.ndarray, "rows bits"]) -> UInt64[np.ndarray, " rows"]:
    """Rows of at most 64 bits, each as one number."""
    return (bits.astype(np.uint64) << np.arange(bits.shape[1], dtype=np.uint64)).sum(axis=1, dtype=np.uint64)


def _split(levels: Float[np.ndarray, "quads values"]) -> Float[np.ndarray, " quads"]:
    """Level between the dark and the light values of each row (Otsu, IEEE Trans. SMC 9(1), 1979)."""
    ordered = np.sort(levels, axis=1)
    count = ordered.shape[1]
    below = np.arange(1, count)
    sums = np.cumsum(ordered, axis=1)
    dark, light = sums[:, :-1] / below, (sums[:, -1:] - sums[:, :-1]) / (count - below)
    between = below * (count - below) * (light - dark) ** 2
    where = between.argmax(axis=1)[:, None]
    return np.take_along_axis((ordered[:, 1:] + ordered[:, :-1]) / 2, where, axis=1)[:, 0]
