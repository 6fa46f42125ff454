"""Search for the markers of an image: several passes, of which each finds candidates, and one choice among them all.

The first pass is OpenCV's detector with its defaults in the image as it is, so that no marker is overlooked that
OpenCV finds; where prints are inverted, another one is OpenCV's detector in the negative. The other passes are our own,
in images of equal brightness (see `brightness`): they find markers in the shade, blurred, small, large or inverted.
What only these passes find must look more like a marker than what OpenCV finds, because a wrong marker does more harm
than a missing one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.inside_out.detection.brightness import equalise_brightness, shrink
from psotrack.inside_out.detection.codes import MarkerCodes, sample_cells, share_outlined
from psotrack.inside_out.detection.quads import find_quads

_Image = UInt8[np.ndarray, "rows columns"]

#: Longer side of the image in which the quick search looks, in pixels: it shrinks larger images.
_SEARCHED_PX = 960
#: Side of the window of the quick search's adaptive threshold, as a share of the longer side, and its smallest side in
#: pixels. The window must be wider than motion blur is long. And how much darker than its surroundings a black pixel
#: is, of 255, in the image of equal brightness.
_WINDOW, _LEAST_WINDOW_PX, _DARKER = 0.04, 9, 20.0
#: Windows of the thorough search, pixels, each with its threshold: narrow windows part a marker from dark
#: surroundings, wide ones stand more blur.
_THOROUGH = ((11, 12.0), (23, 12.0), (77, 20.0))
#: Longer side, in pixels, below which the thorough search shrinks an image no further: a marker in it may fill it.
_SMALLEST_PX = 300
#: Shortest side of a candidate in the searched image: 1.5 pixels for each of 6 cells.
_SHORTEST_PX = 9.0
#: Smallest agreement of a marker (`ReadMarkers.agreement`) that OpenCV finds, and of any other, for dictionaries in
#: which a random square is hardly ever read as a marker, and for those in which one of 16 is; and these two chances.
#: Measured: of OpenCV's right markers in photographs and rendered pictures, small, blurred and noisy, none is below
#: 0.73 (AprilTags with cells of 2 px), and none of a 4x4 dictionary below 0.80 (glare). Its wrong ones are between
#: 0.77 and 0.91, and what no pass but ours reads wrongly reaches 0.93 and 0.95, in photographs of other dictionaries.
_LEAST_OPENCV, _LEAST_OTHER = (0.70, 0.78), (0.88, 0.955)
_RARE, _COMMON = 1e-3, 1 / 16
#: The same for markers that are hardly more than a frame.
_LEAST_FRAME = 0.96
#: Smallest share of the outline beside which a marker that OpenCV does not find is lighter than its border.
_LEAST_OUTLINED = 0.8
#: Smallest contrast, grey levels: below it, quadrangles are noise.
_LEAST_CONTRAST = 4.0


@dataclass(frozen=True)
class Candidates:
    """Quadrangles that are read as markers.

    Attributes:
        index: (candidates,), number of the marker among the codes.
        corners_px: (candidates, 4, 2), from the marker's own top left, in the full image, pixels.
        inverted: (candidates,), whether the print is white on black.
        agreement: (candidates,), as `ReadMarkers.agreement`.
        by_opencv: (candidates,), whether OpenCV found the marker.
    """

    index: Int[np.ndarray, " candidates"]
    corners_px: Float[np.ndarray, "candidates 4 2"]
    inverted: Bool[np.ndarray, " candidates"]
    agreement: Float[np.ndarray, " candidates"]
    by_opencv: Bool[np.ndarray, " candidates"]

    def __len__(self) -> int:
        return len(self.index)

    def select(self, chosen: np.ndarray) -> Candidates:
        """The candidates of a mask, or with given numbers, in their order."""
        return Candidates(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class FirstPass:
    """What OpenCV's detector finds in an image with its defaults.

    Attributes:
        index: (markers,), number of the marker among the codes.
        corners_px: (markers, 4, 2), from the marker's own top left, pixels.
    """

    index: Int[np.ndarray, " markers"]
    corners_px: Float[np.ndarray, "markers 4 2"]


class MarkerSearch:
    """Finds the markers of a dictionary, with corners that are good to a few pixels.

    Args:
        dictionary: the markers.
        codes: the same markers' codes.
        thorough: search in every size and with several windows, for photographs; else with one, for videos.
    """

    def __init__(self, dictionary: cv2.aruco.Dictionary, codes: MarkerCodes, thorough: bool) -> None:
        self._opencv = cv2.aruco.ArucoDetector(dictionary)
        self._codes, self._thorough = codes, thorough
        share = np.log(max(codes.chance, _RARE) / _RARE) / np.log(_COMMON / _RARE)
        self._least_opencv, self._least_other = (
            low + min(share, 1.0) * (high - low) for low, high in (_LEAST_OPENCV, _LEAST_OTHER)
        )

    def first_pass(self, gray: UInt8[np.ndarray, "height width"]) -> FirstPass:
        """Run OpenCV's detector. It does not hold Python's lock, so that several threads can run it at once."""
        quads, which, _ = self._opencv.detectMarkers(gray)
        index = np.zeros(0, np.int64) if which is None else np.asarray(which).ravel().astype(np.int64)
        corners_px = np.concatenate([np.zeros((0, 4, 2)), *(np.asarray(quad, np.float64) for quad in quads)])
        return FirstPass(index, corners_px)

    def find(self, gray: UInt8[np.ndarray, "height width"], first: FirstPass | None = None) -> Candidates:
        """Find the markers in an image; no two are at one place.

        Args:
            gray: (height, width).
            first: the first pass over this image; None to run it here.
        """
        passes = [self._choose_by_agreement(gray, first or self.first_pass(gray), inverted=False)]
        if self._thorough:
            times = 1.0
            while times == 1 or max(gray.shape) / times >= _SMALLEST_PX:
                passes.append(self._find_in(gray, times, _THOROUGH))
                times *= 2
        else:
            times = max(1.0, max(gray.shape) / _SEARCHED_PX)
            window_px = max(_LEAST_WINDOW_PX, 2 * round((_WINDOW * max(gray.shape) / times - 1) / 2) + 1)
            passes.append(self._find_in(gray, times, ((window_px, _DARKER),)))
        # A video's markers are printed alike, so that where none is inverted, OpenCV would find none either.
        if self._thorough or any(one.inverted.any() for one in passes):
            negative = np.asarray(cv2.bitwise_not(gray), np.uint8)
            passes.append(self._choose_by_agreement(gray, self.first_pass(negative), inverted=True))
        found = Candidates(
            *(
                np.concatenate([getattr(one, name) for one in passes])
                for name in Candidates.__dataclass_fields__
            )
        )
        return found.select(_best_of_each_place(found))

    def agreement(
        self,
        gray: UInt8[np.ndarray, "height width"],
        found: Candidates,
        corners_px: Float[np.ndarray, "candidates 4 2"],
    ) -> Float[np.ndarray, " candidates"]:
        """Agreement of the candidates if these were their corners."""
        levels = sample_cells(gray, corners_px, self._codes.cells)
        return self._codes.agreement(levels, found.index, np.zeros(len(found), np.int64), found.inverted)[0]

    def _choose_by_agreement(self, gray: _Image, first: FirstPass, *, inverted: bool) -> Candidates:
        """The markers of OpenCV's detector whose cells agree with the image; it ran in the negative if `inverted`."""
        of_opencv = np.ones(len(first.index), bool)
        found = Candidates(
            first.index, first.corners_px, of_opencv & inverted, np.zeros(len(of_opencv)), of_opencv
        )
        found = replace(found, agreement=self.agreement(gray, found, found.corners_px))
        return found.select(found.agreement >= self._least_opencv)

    def _find_in(self, gray: _Image, times: float, windows: tuple[tuple[int, float], ...]) -> Candidates:
        """Find markers in an image of equal brightness, shrunk by a factor, with windows of given sizes."""
        searched = shrink(gray, times)
        equal = equalise_brightness(searched)
        quads = np.concatenate([find_quads(_dark_parts(equal, *window), _SHORTEST_PX) for window in windows])
        read = self._codes.read(searched, quads)
        least = np.where(self._codes.plain[read.index], _LEAST_FRAME, self._least_other)
        kept = (read.index >= 0) & (read.agreement >= least) & (read.contrast >= _LEAST_CONTRAST)
        kept[kept] = (
            share_outlined(searched, quads[kept], self._codes.cells, read.inverted[kept], read.contrast[kept])
            >= _LEAST_OUTLINED
        )
        ordered = quads[kept][np.arange(kept.sum())[:, None], (read.turn[kept][:, None] + np.arange(4)) % 4]
        # Pixel centres are at whole numbers, so that the image begins at -0.5.
        scale = np.array(gray.shape[::-1]) / searched.shape[::-1]
        corners_px = (ordered + 0.5) * scale - 0.5
        no = np.zeros(len(ordered), bool)
        return Candidates(read.index[kept], corners_px, read.inverted[kept], read.agreement[kept], no)


def _dark_parts(equal: _Image, window_px: int, darker: float) -> _Image:
    """Binary image of what is darker than its surroundings."""
    method, kind = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV
    return np.asarray(cv2.adaptiveThreshold(equal, 255, method, kind, window_px, darker), np.uint8)


def _best_of_each_place(found: Candidates) -> Int[np.ndarray, " kept"]:
    """Numbers of the candidates that agree best, without others at their places and without parts of them."""
    centre = found.corners_px.mean(axis=1)
    side = np.linalg.norm(np.roll(found.corners_px, -1, axis=1) - found.corners_px, axis=-1).mean(axis=1)
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1)
    same = apart < 0.5 * np.minimum(side[:, None], side)
    hides = same | ((apart < 0.5 * side[:, None]) & ~found.by_opencv)
    kept: list[int] = []
    for one in np.argsort(-found.agreement, kind="stable").tolist():
        if not hides[kept, one].any():
            kept.append(one)
    return np.array(sorted(kept), np.int64)
