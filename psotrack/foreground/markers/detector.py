"""Detection of markers: their ids, corners and the corners' accuracy in an image.

OpenCV's detector searches the image as it is, so that no marker is overlooked that it finds with its defaults, and
images in which every place has the same brightness: there it finds markers in the shade, blurred, small or large. What
it finds counts where it looks like the marker, because a wrong marker does more harm than a missing one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import comb

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.errors import SettingsError
from psotrack.foreground.markers.corners import refine_corners, undistort_pixels
from psotrack.foreground.markers.patterns import MarkerPatterns, marker_dictionary
from psotrack.geometry import Camera

#: An image, also one of another size than the image that is searched.
_Image = UInt8[np.ndarray, "_ _"]

#: Shortest side of a marker, in pixels of the full image: one pixel for each of 6 cells, border cells included.
_SHORTEST_PX = 6.0
#: Number of tiles along the image's longer side, and side, in tiles, of the square in which the brightest tile is the
#: white of a place. The square is wider than neighbouring black cells of a marker that fills half of the image;
#: otherwise such cells would count as white.
_TILES, _WHITE_SQUARE = 240, 31
#: Smallest grey level of white (darker surroundings show only noise), and its level in the image of equal brightness;
#: levels above it are for pixels brighter than their white.
_LEAST_WHITE, _WHITE = 16, 200
#: Grey levels of the searched image, half way between grey and light: blur in light hides black cells, blur in grey
#: levels hides white cells.
_HALF_LINEAR = np.round(255 * (np.arange(256) / 255) ** 1.5).astype(np.uint8)
#: Longer side, in pixels, of the image of equal brightness in which a video's markers are searched, and of the smallest
#: one in which a photograph's are: a marker in it may fill it.
_SEARCHED_PX, _SMALLEST_PX = 960, 300
#: Windows of OpenCV's adaptive threshold, smallest, largest and step, pixels, and how much darker than its surroundings
#: black is, of 255: in the image as it is (OpenCV's defaults), and in those of equal brightness, of a video and of a
#: photograph. Narrow windows part a marker from dark surroundings, wide ones stand more blur.
_AS_IT_IS, _VIDEO, _PHOTOGRAPH = (3, 23, 10, 7.0), (39, 39, 1, 15.0), (7, 43, 18, 10.0)
#: Shortest side of a marker in a searched image: 1.5 pixels for each of 6 cells.
_SHORTEST_SEARCHED_PX = 9.0
#: Fraction of a dictionary's correctable bits that are corrected: the value of OpenCV's defaults.
_CORRECTED = 0.6
#: Smallest agreement of a marker for dictionaries in which a random square is hardly ever read as a marker, less often
#: than this chance, and for others. Measured in photographs: of right AprilTags 36h11 with cells of 2 px, one of 51 is
#: below 0.74; of right markers of a 4x4 dictionary, 1 of 200 is below 0.86; wrong ones of the latter reach 0.83.
_LEAST_OF_RARE, _RARE, _LEAST_AGREEMENT = 0.70, 1e-3, 0.86


@dataclass(frozen=True)
class DetectedMarkers:
    """Markers in one image.

    Attributes:
        ids: (markers,); an image may show several markers with one id.
        corners_px: (markers, 4, 2), clockwise from the marker's own top left, pixels.
        std_px: (markers,), standard deviation of a corner along x and along y, pixels; NaN if unknown.
    """

    ids: Int[np.ndarray, " markers"]
    corners_px: Float[np.ndarray, "markers 4 2"]
    std_px: Float[np.ndarray, " markers"]

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, kept: Bool[np.ndarray, " markers"]) -> DetectedMarkers:
        """The markers that a mask keeps."""
        return DetectedMarkers(self.ids[kept], self.corners_px[kept], self.std_px[kept])

    def of_single_ids(self) -> DetectedMarkers:
        """The markers whose id is seen once, for rooms in which all markers differ.

        Of two markers with the same id at least one is false, and the image does not show which: both are left out.
        """
        _, inverse, count = np.unique(self.ids, return_inverse=True, return_counts=True)
        return self.select(count[inverse] == 1)


class MarkerDetector:
    """Finds the markers of a dictionary in images, black on white or inverted.

    It finds what OpenCV's detector finds with its defaults in the full image, if the marker's cells are 1.5 pixels or
    larger and it looks like the marker; and markers that OpenCV overlooks. Quadrangles that are too small, folded or
    mirrored are left out.

    Args:
        dictionary: name of the markers' dictionary, such as 4x4_1000.
        lens: lens whose distortion bends the edges; None for straight edges, or edges that are slightly bent.
        ids: ids of the markers to search; None for all of the dictionary, which takes longer if it is large.
        thorough: search in images of every size and with several windows, for photographs; else once, for videos.

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
        self,
        dictionary: str = "4x4_1000",
        lens: Camera | None = None,
        *,
        ids: Iterable[int] | None = None,
        thorough: bool = False,
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
        self._ids, self._thorough = np.array(wanted), thorough
        # As many wrong bits are corrected as in the whole dictionary, so that the same markers are read.
        self._dictionary = cv2.aruco.Dictionary(
            np.ascontiguousarray(whole.bytesList[self._ids]), whole.markerSize, whole.maxCorrectionBits
        )
        bits, corrected = whole.markerSize**2, int(_CORRECTED * whole.maxCorrectionBits)
        near = sum(comb(bits, wrong) for wrong in range(corrected + 1))
        is_rare = 4 * len(wanted) * near < _RARE * 2.0**bits
        self._least_agreement = _LEAST_OF_RARE if is_rare else _LEAST_AGREEMENT
        self._patterns = MarkerPatterns(self._dictionary)
        is_bent = lens is not None and (np.any(lens.dist) or bool(lens.fisheye))
        self._lens = lens if is_bent else None

    def detect(self, gray: UInt8[np.ndarray, "height width"]) -> DetectedMarkers:
        """Detect the markers in an image; empty if there are none."""
        found = [self._find(gray, *search) for search in self._searches(gray)]
        index, quads_px = np.concatenate([one for one, _ in found]), np.concatenate([one for _, one in found])
        # A marker that reaches beyond what the lens model shows has no place without distortion.
        shown = np.isfinite(undistort_pixels(quads_px, self._lens)).all(axis=(1, 2)) & valid_quads(quads_px)
        index, quads_px = index[shown], quads_px[shown]
        agreement = self._patterns.agreement(gray, quads_px, index)
        best = best_of_each_place(quads_px, np.abs(agreement))
        index, quads_px, agreement = index[best], quads_px[best], agreement[best]
        white = self._patterns.white[index] ^ (agreement < 0)[:, None, None]
        refined = refine_corners(gray, quads_px, white, self._lens)
        # Where something hides a part of an edge, the corners before the refinement may be the better ones.
        again = self._patterns.agreement(gray, refined.corners_px, index)
        alike = np.maximum(np.abs(agreement), np.abs(again))
        kept = (alike >= self._least_agreement) & valid_quads(refined.corners_px)
        return DetectedMarkers(self._ids[index], refined.corners_px, refined.std_px).select(kept)

    def _searches(self, gray: _Image) -> Iterator[tuple[_Image, tuple[int, int, int, float]]]:
        """Images in which markers are searched, each with windows and a threshold."""
        yield gray, _AS_IT_IS
        longer = max(gray.shape)
        times = 1.0 if self._thorough else max(1.0, longer / _SEARCHED_PX)
        while True:
            size_wh = [max(round(side / times), 1) for side in gray.shape[::-1]]
            small = cv2.resize(gray, size_wh, interpolation=cv2.INTER_AREA) if times > 1 else gray
            yield equalise_brightness(np.asarray(small, np.uint8)), _PHOTOGRAPH if self._thorough else _VIDEO
            times *= 2
            if not self._thorough or longer / times < _SMALLEST_PX:
                return

    def _find(
        self, gray: _Image, image: _Image, windows: tuple[int, int, int, float]
    ) -> tuple[Int[np.ndarray, " markers"], Float[np.ndarray, "markers 4 2"]]:
        """Numbers of the markers that OpenCV finds in an image, and their corners in the full one."""
        options = cv2.aruco.DetectorParameters()
        (
            options.adaptiveThreshWinSizeMin,
            options.adaptiveThreshWinSizeMax,
            options.adaptiveThreshWinSizeStep,
            options.adaptiveThreshConstant,
        ) = windows
        options.detectInvertedMarker, options.errorCorrectionRate = True, _CORRECTED
        options.minMarkerPerimeterRate = 4 * _SHORTEST_SEARCHED_PX / max(image.shape)
        # In small and blurred markers, only the middle of a cell shows it: 3 of 7 samples along each side.
        options.perspectiveRemovePixelPerCell, options.perspectiveRemoveIgnoredMarginPerCell = 7, 0.29
        quads, which, _ = cv2.aruco.ArucoDetector(self._dictionary, options).detectMarkers(image)
        index = np.zeros(0, np.int64) if which is None else np.asarray(which).ravel().astype(np.int64)
        corners_px = np.concatenate([np.zeros((0, 4, 2)), *(np.asarray(quad, np.float64) for quad in quads)])
        # Pixel centres are at whole numbers, so that the image begins at -0.5.
        scale = np.array(gray.shape[::-1]) / image.shape[::-1]
        return index, (corners_px + 0.5) * scale - 0.5


def equalise_brightness(gray: UInt8[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """The image divided by the white of each place: the brightest tile around the place."""
    # Without smoothing, noise makes specks, which take time and hide markers.
    smooth = np.asarray(cv2.GaussianBlur(gray, (3, 3), 0))
    tile = max(1, round(max(gray.shape) / _TILES))
    around = (_WHITE_SQUARE, _WHITE_SQUARE)
    white = cv2.blur(cv2.dilate(smooth[::tile, ::tile], np.ones(around, np.uint8)), around)
    white = cv2.resize(np.maximum(white, _LEAST_WHITE), gray.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.LUT(cv2.divide(smooth, white, scale=_WHITE), _HALF_LINEAR), np.uint8)


def valid_quads(corners_px: Float[np.ndarray, "markers 4 2"]) -> Bool[np.ndarray, " markers"]:
    """Which quadrangles are convex, clockwise and not too small."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    following = np.roll(sides, -1, axis=1)
    turns = sides[..., 0] * following[..., 1] - sides[..., 1] * following[..., 0]
    # With y down, the turns of a clockwise outline are positive.
    return (turns > 0).all(axis=1) & (np.linalg.norm(sides, axis=-1) >= _SHORTEST_PX).all(axis=1)


def best_of_each_place(
    corners_px: Float[np.ndarray, "markers 4 2"], agreement: Float[np.ndarray, " markers"]
) -> Int[np.ndarray, " kept"]:
    """Numbers of the markers that agree best, without others at their places."""
    centre = corners_px.mean(axis=1)
    side = np.linalg.norm(np.roll(corners_px, -1, axis=1) - corners_px, axis=-1).mean(axis=1)
    same = np.linalg.norm(centre[:, None] - centre, axis=-1) < 0.5 * np.minimum(side[:, None], side)
    kept: list[int] = []
    for one in np.argsort(-agreement, kind="stable").tolist():
        if not same[kept, one].any():
            kept.append(one)
    return np.array(sorted(kept), np.int64)
