"""Corners of a board in an image.

A board of markers may be printed white on black, and a board may be seen mirrored: from behind through thin paper, or
because its back shows the mirrored pattern.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.calibration.boards import Board
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector

#: Largest standard deviation of corners from one line that is still a line, pixels.
_LINE_PX = 1.5
#: Largest size of an image in which OpenCV's search for a chessboard is fast, pixels.
_CHESSBOARD_SIDE_PX = 1000


@dataclass(frozen=True)
class BoardFinder:
    """Finds the corners of a board."""

    board: Board

    def find(self, grey: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "corners 2"]:
        """Pixels of the board's corners, (corners, 2); NaN where a corner is not found, everywhere if few are."""
        if self.board.kind == "chessboard":
            found = self._find_chessboard(grey)
        elif self.board.kind == "grid":
            found = self._find_grid(grey)
        else:
            found = self._find_charuco(grey)
        seen = np.isfinite(found[:, 0])
        if seen.sum() < self.board.least_corners or _on_a_line(found[seen]):
            found[:] = np.nan
        return found

    def find_mirrored(self, grey: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "corners 2"]:
        """The same in the mirrored image; the pixels are those of the image that is given."""
        found = self.find(np.ascontiguousarray(grey[:, ::-1]))
        found[:, 0] = grey.shape[1] - 1 - found[:, 0]
        return found

    def markers(self, grey: UInt8[np.ndarray, "height width"]) -> DetectedMarkers:
        """The board's markers in an image, each at most once."""
        return self._detector.detect(grey).of_single_ids()

    @cached_property
    def _detector(self) -> MarkerDetector:
        first = self.board.first_marker
        return MarkerDetector(self.board.dictionary, ids=range(first, first + self.board.num_markers))

    @cached_property
    def _charuco(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self.board.opencv())

    def _nothing(self) -> Float[np.ndarray, "corners 2"]:
        return np.full((self.board.num_corners, 2), np.nan)

    def _find_charuco(self, grey: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "corners 2"]:
        found, markers = self._nothing(), self.markers(grey)
        if len(markers):
            quads = [quad[None].astype(np.float32) for quad in markers.corners_px]
            corners, ids, _, _ = self._charuco.detectBoard(
                grey, markerCorners=quads, markerIds=markers.ids[:, None].astype(np.int32)
            )
            if ids is not None and len(ids):
                found[np.asarray(ids).ravel()] = np.asarray(corners, np.float64).reshape(-1, 2)
        return found

    def _find_grid(self, grey: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "corners 2"]:
        found, markers = self._nothing(), self.markers(grey)
        found.reshape(-1, 4, 2)[markers.ids - self.board.first_marker] = markers.corners_px
        return found

    def _find_chessboard(self, image: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "corners 2"]:
        columns, rows = self.board.squares_wh
        size = (columns - 1, rows - 1)
        # The search is slow in large images, and the corners are refined in the full image.
        scale = max(1, round(max(image.shape) / _CHESSBOARD_SIDE_PX))
        small = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        is_found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
        if not is_found:
            return self._nothing()
        pixels = np.asarray(corners, np.float64).reshape(-1, 2)
        if scale > 1:
            # Pixel centres are at whole numbers.
            pixels = (pixels + 0.5) * scale - 0.5
            start = pixels.astype(np.float32).reshape(-1, 1, 2).copy()
            half = _half_window(pixels.reshape(rows - 1, columns - 1, 2))
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
            pixels = np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria), np.float64)
        return _in_order(pixels.reshape(rows - 1, columns - 1, 2), image).reshape(-1, 2)


def _half_window(grid: Float[np.ndarray, "rows columns 2"]) -> int:
    """Half the side of a window around a corner that contains no other corner."""
    steps = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)])
    return int(np.clip(steps.min() / 3, 2, 11))


def _in_order(
    grid: Float[np.ndarray, "rows columns 2"], image: UInt8[np.ndarray, "height width"]
) -> Float[np.ndarray, "rows columns 2"]:
    """Order a chessboard's corners so that y follows x clockwise, and the first square between corners is dark.

    Only a board whose colours tell its two ends apart has such a first square; others stay in one of their orders.
    """
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    rows, columns = grid.shape[:2]
    if (rows + columns) % 2:
        middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
        columns_px, rows_px = middles.round().astype(np.int64).reshape(-1, 2).T
        inside = (rows_px.clip(0, image.shape[0] - 1), columns_px.clip(0, image.shape[1] - 1))
        bright = image[inside].astype(np.float64).reshape(rows - 1, columns - 1)
        even = np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0
        if bright[even].mean() > bright[~even].mean():
            grid = grid[::-1, ::-1]
    return grid


def _on_a_line(points_px: Float[np.ndarray, "points 2"]) -> bool:
    """Whether points are nearly on one line, so that they leave a board's pose open."""
    spread = np.linalg.svd(points_px - points_px.mean(axis=0), compute_uv=False)
    return bool(spread[-1] < _LINE_PX * np.sqrt(len(points_px)))
