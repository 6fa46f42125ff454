"""Markers in an image: which they are.

OpenCV finds and reads them (Garrido-Jurado et al., Pattern Recognition 47(6), 2014) in one binary image, of one window,
instead of three. It is made of the image as if all of it were lit alike, so that what is dim is found as well.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.detection import marker_dictionary
from psotrack.errors import SettingsError
from psotrack.geometry import Camera
from psotrack.inside_out.detection.corners import refined_corners

#: Longer side of the images that are searched: larger ones are made smaller by a whole number that comes nearest. What
#: is found is looked at closely in the image itself.
_SEARCHED_PX = 1920
#: Side of the window of the adaptive threshold, as a share of the searched image's longer side, and the least. It must
#: be wider than the blur of motion is long.
_WINDOW = 0.04
_LEAST_WINDOW_PX = 9
#: How much darker than its surroundings black is, of 255 in an image that is lit alike.
_DARKER = 20.0
#: The white of a place is looked for in tiles, so many along the longer side, and about it in a square of so many. It
#: is wider than black cells that are side by side in a marker of half the image, which else had a white of their own.
_TILES, _AROUND = 240, 31
#: Darker surroundings than this are taken to be as bright: only noise is in them.
_LEAST_WHITE = 16
#: What white becomes: there is room for what is brighter than its surroundings.
_WHITE = 200
#: Grey levels of the searched image, half way between grey and light: a blur of one hides black, of the other white.
_BETWEEN = np.round(255 * (np.arange(256) / 255) ** 1.5).astype(np.uint8)
#: Sides that are shorter tell no cell of a 4 x 4 marker, its border among them, from the next.
_SHORTEST_PX = 6.0


@dataclass(frozen=True)
class SeenMarkers:
    """Markers in one image.

    Attributes:
        ids: (markers,), no two alike.
        corners_px: (markers, 4, 2), clockwise from the marker's own top left.
    """

    ids: Int[np.ndarray, " markers"]
    corners_px: Float[np.ndarray, "markers 4 2"]

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, kept: Bool[np.ndarray, " markers"]) -> SeenMarkers:
        """Some of them."""
        return SeenMarkers(self.ids[kept], self.corners_px[kept])


class MarkerDetector:
    """Finds the markers of a dictionary.

    Of two with the same id at least one is something else, and the image does not tell which: neither counts. Nor does
    a quadrangle that is too small, folded or mirrored.

    Args:
        dictionary: of the markers, such as 4x4_1000.
        lens: whose distortion bends the edges; None for straight ones.
        ids: markers that are sought; None for all of the dictionary, which takes longer where that is large.

    Raises:
        SettingsError: there is no such dictionary, or it has none of the markers.

    Example:
        >>> white = np.full((400, 400), 255, np.uint8)
        >>> white[100:300, 100:300] = cv2.aruco.generateImageMarker(marker_dictionary("4x4_50"), 7, 200)
        >>> seen = MarkerDetector("4x4_50").detect(white)
        >>> seen.ids.tolist(), seen.corners_px.round(1)[0].tolist()
        ([7], [[99.5, 99.5], [299.5, 99.5], [299.5, 299.5], [99.5, 299.5]])
    """

    def __init__(
        self, dictionary: str = "4x4_1000", lens: Camera | None = None, *, ids: Iterable[int] | None = None
    ) -> None:
        whole = marker_dictionary(dictionary)
        count = len(whole.bytesList)
        sought = range(count) if ids is None else sorted({marker for marker in ids if 0 <= marker < count})
        if not sought:
            raise SettingsError(
                "dictionary",
                expected="one that has markers of the map",
                found=f"{dictionary}, 0 to {count - 1}",
            )
        self._ids = np.array(sought)
        # With as many wrong bits allowed as in the whole one, it reads the same markers.
        self._dictionary = cv2.aruco.Dictionary(
            np.ascontiguousarray(whole.bytesList[self._ids]), whole.markerSize, whole.maxCorrectionBits
        )
        self._lens = lens if lens is not None and np.any(lens.dist) else None

    def detect(self, gray: UInt8[np.ndarray, "height width"]) -> SeenMarkers:
        """The markers in an image, (height, width); without any, none."""
        searched = _smaller(gray)
        detector = cv2.aruco.ArucoDetector(self._dictionary, _parameters(max(searched.shape)))
        quads, which, _ = detector.detectMarkers(_lit_alike(searched))
        if which is None:
            return SeenMarkers(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
        # Pixel centres are at whole numbers.
        scale = np.array(gray.shape[::-1]) / searched.shape[::-1]
        corners_px = (np.concatenate(quads).reshape(-1, 4, 2) + 0.5) * scale - 0.5
        found = SeenMarkers(self._ids[which.ravel()], corners_px)
        _, inverse, count = np.unique(found.ids, return_inverse=True, return_counts=True)
        found = found.select((count[inverse] == 1) & _sound(found.corners_px))
        corners_px = refined_corners(gray, found.corners_px, self._white(found.ids), self._lens)
        return SeenMarkers(found.ids, corners_px).select(_sound(corners_px))

    def _white(self, ids: Int[np.ndarray, " markers"]) -> Bool[np.ndarray, "markers cells cells"]:
        """Which cells of markers are white, those of their borders among them."""
        cells = self._dictionary.markerSize + 2
        drawn = [
            cv2.aruco.generateImageMarker(self._dictionary, int(which), cells)
            for which in np.searchsorted(self._ids, ids)
        ]
        return np.array(drawn, np.uint8).reshape(-1, cells, cells) > 0


def _smaller(gray: UInt8[np.ndarray, "height width"]) -> UInt8[np.ndarray, "rows columns"]:
    times = round(max(gray.shape) / _SEARCHED_PX)
    if times < 2:
        return gray
    size_wh = (gray.shape[1] // times, gray.shape[0] // times)
    return np.asarray(cv2.resize(gray, size_wh, interpolation=cv2.INTER_AREA), np.uint8)


def _lit_alike(gray: UInt8[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """The image over how bright the brightest is about each place."""
    # Noise makes specks, which cost time, and hide markers where it is strong.
    smooth = np.asarray(cv2.GaussianBlur(gray, (3, 3), 0))
    tile = max(1, round(max(gray.shape) / _TILES))
    around = (_AROUND, _AROUND)
    white = cv2.blur(cv2.dilate(smooth[::tile, ::tile], np.ones(around, np.uint8)), around)
    white = cv2.resize(np.maximum(white, _LEAST_WHITE), gray.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.LUT(cv2.divide(smooth, white, scale=_WHITE), _BETWEEN), np.uint8)


def _parameters(longer_side_px: int) -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    window_px = max(_LEAST_WINDOW_PX, 2 * round((_WINDOW * longer_side_px - 1) / 2) + 1)
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window_px
    parameters.adaptiveThreshConstant = _DARKER
    return parameters


def _sound(corners_px: Float[np.ndarray, "markers 4 2"]) -> Bool[np.ndarray, " markers"]:
    """Quadrangles that are convex, clockwise, and not too small."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    following = np.roll(sides, -1, axis=1)
    turns = sides[..., 0] * following[..., 1] - sides[..., 1] * following[..., 0]
    # With y down, clockwise is towards positive.
    return (turns > 0).all(axis=1) & (np.linalg.norm(sides, axis=-1) >= _SHORTEST_PX).all(axis=1)
