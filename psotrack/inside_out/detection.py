"""Markers in an image: which they are, and where their corners are to a tenth of a pixel.

OpenCV finds and reads the markers (Garrido-Jurado et al., Pattern Recognition 47(6), 2014) in one binary image, of one
window, instead of three. Their corners are then where straight lines through their edges meet: an edge is the middle
of the rise from black to white across it, in light. A blur, of a lens or of motion, that is the same on both sides
moves no edge, but it rounds corners off: OpenCV's own refinements look at those, and find markers too small.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.cameras import Camera, distort, undistort
from psotrack.errors import SettingsError
from psotrack.lenses import marker_dictionary

_Points = Float[np.ndarray, "markers 4 points 2"]

#: The light that grey levels stand for, as video codes about its square root (ITU-R BT.709). Blurs mix light; the
#: middle of grey levels is too far inside of a black marker.
_LIGHT = np.round(np.arange(256) ** 2 / 255).astype(np.uint8)
#: Side of the window of the adaptive threshold, as a share of the image's longer side, and the least. It must be wider
#: than the blur of motion is long.
_WINDOW = 0.012
_LEAST_WINDOW_PX = 9
#: Sides that are shorter tell no cell of a 4 x 4 marker, its border among them, from the next.
_SHORTEST_PX = 6.0
#: Cells across a marker of 4 x 4 bits; the others have more, and edges are then looked at over more than one.
_CELLS = 6
#: Of a cell, to both sides of an edge, that the rise is looked for in; and limits in pixels.
_REACH, _LEAST_REACH_PX, _MOST_REACH_PX = 0.7, 2.0, 4.0
#: Passes over the edges: the first is misled by what OpenCV is off, the others look around where the edges are.
_PASSES = 3
#: Places along an edge where it is looked for, in shares of its length; near the corners two edges are one blur.
_ALONG = np.linspace(0.15, 0.85, 16)
#: Samples across an edge, in units of the reach, and the middles between them.
_ACROSS = np.linspace(-1.0, 1.0, 17)
_MIDDLES = (_ACROSS[1:] + _ACROSS[:-1]) / 2
#: Of the steepest rise across an edge, below which another is noise: there is more light, and more noise, on its white
#: side, which would draw it there.
_NOISE = 0.1
#: Times a line is fitted anew with less weight for what is off it, such as where a drone hides the edge.
_REWEIGHTINGS = 3
#: What is off a line by less, in pixels, is not doubted.
_SURE_PX = 0.1
#: Reaches that a corner may move by.
_FARTHEST = 2.0


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
        detector = cv2.aruco.ArucoDetector(self._dictionary, _parameters(max(gray.shape)))
        # Noise makes specks, which cost time, and hide markers where it is strong.
        quads, ids, _ = detector.detectMarkers(cv2.GaussianBlur(gray, (3, 3), 0))
        if ids is None:
            return SeenMarkers(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
        found = SeenMarkers(
            self._ids[ids.ravel()], np.concatenate(quads).reshape(-1, 4, 2).astype(np.float64)
        )
        _, inverse, count = np.unique(found.ids, return_inverse=True, return_counts=True)
        found = found.select((count[inverse] == 1) & _sound(found.corners_px))
        light = np.asarray(cv2.LUT(gray, _LIGHT), np.uint8)
        refined = SeenMarkers(found.ids, refined_corners(light, found.corners_px, self._lens))
        return refined.select(_sound(refined.corners_px))


def refined_corners(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    lens: Camera | None = None,
) -> Float[np.ndarray, "markers 4 2"]:
    """Where the lines through the edges of markers meet.

    Args:
        gray: (height, width), black markers on white; levels that are in proportion to light.
        corners_px: (markers, 4, 2), clockwise, right to some pixels.
        lens: whose distortion bends the edges; None for straight ones.

    Returns:
        (markers, 4, 2). A corner whose edges cannot be found stays as it was.
    """
    if not len(corners_px):
        return corners_px
    sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=1) - corners_px, axis=-1)
    # A cell is as wide, across an edge, as the two edges beside it say.
    across_px = (np.roll(sides_px, 1, axis=1) + np.roll(sides_px, -1, axis=1)) / 2
    reach_px = np.clip(_REACH * across_px / _CELLS, _LEAST_REACH_PX, _MOST_REACH_PX)
    farthest_px = _FARTHEST * reach_px.max(axis=1, keepdims=True)
    found = corners_px
    for _ in range(_PASSES):
        points_px, weight = _edges(gray, found, reach_px)
        moved = _bent(_meeting(*_lines(_straight(points_px, lens), weight)), lens)
        near = np.linalg.norm(moved - corners_px, axis=-1) <= farthest_px
        found = np.where(near[..., None], moved, found)
    return found


def _parameters(longer_side_px: int) -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    window_px = max(_LEAST_WINDOW_PX, 2 * round((_WINDOW * longer_side_px - 1) / 2) + 1)
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window_px
    return parameters


def _sound(corners_px: Float[np.ndarray, "markers 4 2"]) -> Bool[np.ndarray, " markers"]:
    """Quadrangles that are convex, clockwise, and not too small."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    following = np.roll(sides, -1, axis=1)
    turns = sides[..., 0] * following[..., 1] - sides[..., 1] * following[..., 0]
    # With y down, clockwise is towards positive.
    return (turns > 0).all(axis=1) & (np.linalg.norm(sides, axis=-1) >= _SHORTEST_PX).all(axis=1)


def _edges(
    gray: UInt8[np.ndarray, "height width"],
    corners_px: Float[np.ndarray, "markers 4 2"],
    reach_px: Float[np.ndarray, "markers 4"],
) -> tuple[_Points, Float[np.ndarray, "markers 4 points"]]:
    """Points on the edges, and how strong the rise from black to white is there; 0 where there is none."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    ahead = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-9)
    # Of a clockwise outline, with y down.
    outward = np.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
    places = corners_px[:, :, None] + _ALONG[:, None] * sides[:, :, None]
    step = (reach_px[..., None] * _ACROSS)[:, :, None, :, None] * outward[:, :, None, None]
    samples = places[:, :, :, None] + step
    # A row for each edge: OpenCV's images have fewer than 32768 rows and columns.
    x, y = (
        np.ascontiguousarray(samples[..., axis], np.float32).reshape(4 * len(corners_px), -1)
        for axis in (0, 1)
    )
    image = np.asarray(cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64)
    rise = np.maximum(np.diff(image.reshape(samples.shape[:-1]), axis=-1), 0.0)
    rise = np.maximum(rise - _NOISE * rise.max(axis=-1, keepdims=True), 0.0)
    weight = rise.sum(axis=-1)
    off_px = (rise @ _MIDDLES) / np.maximum(weight, 1e-9) * reach_px[..., None]
    return places + off_px[..., None] * outward[:, :, None], weight


def _lines(
    points: _Points, weight: Float[np.ndarray, "markers 4 points"]
) -> tuple[Float[np.ndarray, "markers 4 2"], Float[np.ndarray, "markers 4 2"]]:
    """A point on each line and its direction, by least squares of the distances, those far off counting less."""
    counts = weight
    for _ in range(1 + _REWEIGHTINGS):
        total = np.maximum(counts.sum(axis=-1), 1e-9)[..., None]
        middle = (counts[..., None] * points).sum(axis=2) / total
        apart = points - middle[:, :, None]
        xx, yy, xy = (
            (counts * apart[..., i] * apart[..., j]).sum(axis=-1) for i, j in ((0, 0), (1, 1), (0, 1))
        )
        angle = np.arctan2(2 * xy, xx - yy) / 2
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        off = np.abs(apart[..., 0] * direction[..., None, 1] - apart[..., 1] * direction[..., None, 0])
        typical = np.maximum(1.5 * np.median(off, axis=-1, keepdims=True), _SURE_PX)
        counts = weight / (1 + (off / typical) ** 2)
    return middle, direction


def _meeting(
    on: Float[np.ndarray, "markers 4 2"], direction: Float[np.ndarray, "markers 4 2"]
) -> Float[np.ndarray, "markers 4 2"]:
    """Where each line meets the one before it; far away where they are parallel."""
    before, ahead = np.roll(on, 1, axis=1), np.roll(direction, 1, axis=1)
    apart = on - before
    cross = ahead[..., 0] * direction[..., 1] - ahead[..., 1] * direction[..., 0]
    along = apart[..., 0] * direction[..., 1] - apart[..., 1] * direction[..., 0]
    return before + (along / np.where(np.abs(cross) < 1e-9, 1e-9, cross))[..., None] * ahead


def _straight(points_px: _Points, lens: Camera | None) -> _Points:
    """Pixels of the same points if the lens did not distort."""
    if lens is None:
        return points_px
    return undistort(lens, points_px) @ lens.K[:2, :2].T + lens.K[:2, 2]


def _bent(
    corners_px: Float[np.ndarray, "markers 4 2"], lens: Camera | None
) -> Float[np.ndarray, "markers 4 2"]:
    """What `_straight` made straight, as the lens shows it."""
    if lens is None:
        return corners_px
    rays = (corners_px - lens.K[:2, 2]) @ np.linalg.inv(lens.K[:2, :2]).T
    return np.stack(distort(lens, rays[..., 0], rays[..., 1]), axis=-1) @ lens.K[:2, :2].T + lens.K[:2, 2]
