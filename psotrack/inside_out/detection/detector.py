"""Detection of markers: their ids and corners in an image.

OpenCV finds and reads them (Garrido-Jurado et al., Pattern Recognition 47(6), 2014), in one binary image with one size
of window instead of three. Before the threshold, each pixel is divided by the brightness of its surroundings, so that
markers in dim places are found as well.
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
from psotrack.inside_out.detection.corners import refine_corners
from psotrack.inside_out.detection.distortion import undistort_pixels

#: Longer side, in pixels, near which images are searched: larger images are shrunk by the whole number that comes
#: nearest. Corners are then refined in the full image.
_SEARCHED_PX = 1920
#: Side of the window of the adaptive threshold, as a share of the searched image's longer side, and the smallest side
#: in pixels. The window must be wider than motion blur is long.
_WINDOW = 0.04
_LEAST_WINDOW_PX = 9
#: How much darker than its surroundings a black pixel is, of 255, in the image of equal brightness.
_DARKER = 20.0
#: Number of tiles along the image's longer side, and side, in tiles, of the square in which the brightest tile is the
#: white of a place. The square is wider than neighbouring black cells of a marker that fills half of the image;
#: otherwise such cells would count as white.
_TILES, _WHITE_SQUARE = 240, 31
#: Smallest grey level of white: darker surroundings show only noise.
_LEAST_WHITE = 16
#: Grey level of white in the image of equal brightness; levels above it are for pixels brighter than their white.
_WHITE = 200
#: Grey levels of the searched image, half way between grey and light: blur in light hides black cells, blur in grey
#: levels hides white cells.
_HALF_LINEAR = np.round(255 * (np.arange(256) / 255) ** 1.5).astype(np.uint8)
#: Shortest side of a marker, in pixels of the full image: one pixel for each of 6 cells, border cells included.
_SHORTEST_PX = 6.0


@dataclass(frozen=True)
class DetectedMarkers:
    """Markers in one image.

    Attributes:
        ids: (markers,), all different.
        corners_px: (markers, 4, 2), clockwise from the marker's own top left, pixels.
    """

    ids: Int[np.ndarray, " markers"]
    corners_px: Float[np.ndarray, "markers 4 2"]

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, kept: Bool[np.ndarray, " markers"]) -> DetectedMarkers:
        """The markers that a mask keeps."""
        return DetectedMarkers(self.ids[kept], self.corners_px[kept])


class MarkerDetector:
    """Finds the markers of a dictionary in images.

    If two markers have the same id, at least one is false, and the image does not show which: both are left out.
    Quadrangles that are too small, folded or mirrored are left out too.

    Small markers are overlooked. Images are searched at a longer side of about 1920 pixels, where the sides of a marker
    need about 24 pixels. In an image of 3840 x 2160 pixels, markers whose sides are shorter than 48 pixels are
    overlooked.

    Args:
        dictionary: name of the markers' dictionary, such as 4x4_1000.
        lens: lens whose distortion bends the edges; None for straight edges.
        ids: ids of the markers to search; None for all of the dictionary, which takes longer if it is large.

    Raises:
        SettingsError: there is no dictionary of this name, or it has none of the ids.

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
        wanted = range(count) if ids is None else sorted({marker for marker in ids if 0 <= marker < count})
        if not wanted:
            raise SettingsError(
                "dictionary",
                expected="one that has markers of the map",
                found=f"{dictionary}, 0 to {count - 1}",
            )
        self._ids = np.array(wanted)
        # As many wrong bits are corrected as in the whole dictionary, so that the same markers are read.
        self._dictionary = cv2.aruco.Dictionary(
            np.ascontiguousarray(whole.bytesList[self._ids]), whole.markerSize, whole.maxCorrectionBits
        )
        is_bent = lens is not None and (np.any(lens.dist) or bool(lens.fisheye))
        self._lens = lens if is_bent else None

    def detect(self, gray: UInt8[np.ndarray, "height width"]) -> DetectedMarkers:
        """Detect the markers in an image, (height, width); empty if there are none."""
        searched = _shrink(gray)
        detector = cv2.aruco.ArucoDetector(self._dictionary, _parameters(max(searched.shape)))
        quads, which, _ = detector.detectMarkers(_equalise_brightness(searched))
        if which is None:
            return DetectedMarkers(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
        # Pixel centres are at whole numbers, so that the image begins at -0.5.
        scale = np.array(gray.shape[::-1]) / searched.shape[::-1]
        corners_px = (np.concatenate(quads).reshape(-1, 4, 2) + 0.5) * scale - 0.5
        found = DetectedMarkers(self._ids[which.ravel()], corners_px)
        _, inverse, count = np.unique(found.ids, return_inverse=True, return_counts=True)
        # A marker that reaches beyond what the lens model shows has no place without distortion.
        is_shown = np.isfinite(undistort_pixels(found.corners_px, self._lens)).all(axis=(1, 2))
        found = found.select((count[inverse] == 1) & _valid_quads(found.corners_px) & is_shown)
        corners_px = refine_corners(gray, found.corners_px, self._white_cells(found.ids), self._lens)
        return DetectedMarkers(found.ids, corners_px).select(_valid_quads(corners_px))

    def _white_cells(self, ids: Int[np.ndarray, " markers"]) -> Bool[np.ndarray, "markers cells cells"]:
        """Which cells of each marker are white; the cells of the border are included."""
        cells = self._dictionary.markerSize + 2
        drawn = [
            cv2.aruco.generateImageMarker(self._dictionary, int(which), cells)
            for which in np.searchsorted(self._ids, ids)
        ]
        return np.array(drawn, np.uint8).reshape(-1, cells, cells) > 0


def _shrink(gray: UInt8[np.ndarray, "height width"]) -> UInt8[np.ndarray, "rows columns"]:
    """The image at about the size at which it is searched."""
    times = round(max(gray.shape) / _SEARCHED_PX)
    if times < 2:
        return gray
    size_wh = (gray.shape[1] // times, gray.shape[0] // times)
    return np.asarray(cv2.resize(gray, size_wh, interpolation=cv2.INTER_AREA), np.uint8)


def _equalise_brightness(gray: UInt8[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """The image divided by the white of each place: the brightest tile around the place."""
    # Without smoothing, noise makes specks, which take time and hide markers.
    smooth = np.asarray(cv2.GaussianBlur(gray, (3, 3), 0))
    tile = max(1, round(max(gray.shape) / _TILES))
    around = (_WHITE_SQUARE, _WHITE_SQUARE)
    white = cv2.blur(cv2.dilate(smooth[::tile, ::tile], np.ones(around, np.uint8)), around)
    white = cv2.resize(np.maximum(white, _LEAST_WHITE), gray.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.LUT(cv2.divide(smooth, white, scale=_WHITE), _HALF_LINEAR), np.uint8)


def _parameters(longer_side_px: int) -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    window_px = max(_LEAST_WINDOW_PX, 2 * round((_WINDOW * longer_side_px - 1) / 2) + 1)
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window_px
    parameters.adaptiveThreshConstant = _DARKER
    return parameters


def _valid_quads(corners_px: Float[np.ndarray, "markers 4 2"]) -> Bool[np.ndarray, " markers"]:
    """Which quadrangles are convex, clockwise and not too small."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    following = np.roll(sides, -1, axis=1)
    turns = sides[..., 0] * following[..., 1] - sides[..., 1] * following[..., 0]
    # With y down, the turns of a clockwise outline are positive.
    return (turns > 0).all(axis=1) & (np.linalg.norm(sides, axis=-1) >= _SHORTEST_PX).all(axis=1)
