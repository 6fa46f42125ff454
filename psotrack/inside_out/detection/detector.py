"""Detection of markers: their ids, corners and the corners' accuracy in an image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.errors import SettingsError
from psotrack.foreground.detection import marker_dictionary
from psotrack.geometry import Camera
from psotrack.inside_out.detection.codes import MarkerCodes, pattern_agreement
from psotrack.inside_out.detection.corners import refine_corners
from psotrack.inside_out.detection.distortion import undistort_pixels
from psotrack.inside_out.detection.search import FirstPass, MarkerSearch

#: Shortest side of a marker, in pixels of the full image: one pixel for each of 6 cells, border cells included.
_SHORTEST_PX = 6.0
#: Agreement of the cells' middles (`ReadMarkers.agreement`) above which a marker is certain, bent sheets included; and
#: smallest agreement of the whole pattern of all others. Measured: of 4,700 markers in photographs, videos and drawn
#: pictures, small, blurred, bent and in glare, none that agrees less than 0.98 in the middles is below 0.79 as a whole;
#: of 12 wrong readings in photographs of other dictionaries and of chessboards none is above 0.74.
_CERTAIN, _LEAST_PATTERN = 0.98, 0.765


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

    It finds what OpenCV's detector finds with its defaults in the full image, unless the brightness of the cells says
    that it is none; and markers that OpenCV overlooks. Quadrangles that are too small, folded or mirrored are left out.

    Args:
        dictionary: name of the markers' dictionary, such as 4x4_1000.
        lens: lens whose distortion bends the edges; None for straight edges.
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
        self._ids = np.array(wanted)
        # As many wrong bits are corrected as in the whole dictionary, so that the same markers are read.
        searched = cv2.aruco.Dictionary(
            np.ascontiguousarray(whole.bytesList[self._ids]), whole.markerSize, whole.maxCorrectionBits
        )
        self._codes = MarkerCodes(searched)
        self._search = MarkerSearch(searched, self._codes, thorough)
        is_bent = lens is not None and (np.any(lens.dist) or bool(lens.fisheye))
        self._lens = lens if is_bent else None

    def first_pass(self, gray: UInt8[np.ndarray, "height width"]) -> FirstPass:
        """OpenCV's part of `detect`, which several threads can run at once; the other part holds Python's lock."""
        return self._search.first_pass(gray)

    def detect(
        self, gray: UInt8[np.ndarray, "height width"], first: FirstPass | None = None
    ) -> DetectedMarkers:
        """Detect the markers in an image; empty if there are none.

        Args:
            gray: (height, width).
            first: what `first_pass` returned for this image; None to run this pass here.
        """
        found = self._search.find(gray, first)
        # A marker that reaches beyond what the lens model shows has no place without distortion.
        is_shown = np.isfinite(undistort_pixels(found.corners_px, self._lens)).all(axis=(1, 2))
        found = found.select(valid_quads(found.corners_px) & is_shown)
        white = self._codes.white[found.index] ^ found.inverted[:, None, None]
        refined = refine_corners(gray, found.corners_px, white, self._lens)
        kept = valid_quads(refined.corners_px)
        unsure = np.flatnonzero(kept & (found.agreement < _CERTAIN))
        # Where something hides a part of an edge, the corners before the refinement may be the better ones.
        kept[unsure] = (
            np.maximum(
                *(
                    pattern_agreement(gray, corners_px[unsure], white[unsure])
                    for corners_px in (found.corners_px, refined.corners_px)
                )
            )
            >= _LEAST_PATTERN
        )
        return DetectedMarkers(self._ids[found.index], refined.corners_px, refined.std_px).select(kept)


def valid_quads(corners_px: Float[np.ndarray, "markers 4 2"]) -> Bool[np.ndarray, " markers"]:
    """Which quadrangles are convex, clockwise and not too small."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    following = np.roll(sides, -1, axis=1)
    turns = sides[..., 0] * following[..., 1] - sides[..., 1] * following[..., 0]
    # With y down, the turns of a clockwise outline are positive.
    return (turns > 0).all(axis=1) & (np.linalg.norm(sides, axis=-1) >= _SHORTEST_PX).all(axis=1)
