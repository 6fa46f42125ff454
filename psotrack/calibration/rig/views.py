"""Views of a board: the pixels of its corners in all cameras and at all instants."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.calibration.board_corners import BoardFinder
from psotrack.calibration.board_recognition import (
    measure_markers,
    missing_board,
    recognise_board,
)
from psotrack.calibration.boards import LEAST_CORNERS, Board
from psotrack.calibration.rig.images import CameraImages
from psotrack.errors import InputError
from psotrack.support import Report, no_progress

#: Largest number of images of each camera from which the print is found out.
_MOST_SAMPLES = 24
#: Largest deviation of the measured size of a ChArUco board's markers from the stated one: corners of markers of 10
#: pixels, the smallest that are read, are found to about half a pixel at each end.
_MARKER_SIZE_ERROR = 0.2


@dataclass(frozen=True)
class BoardViews:
    """Pixels of a board's corners.

    Attributes:
        names: names of the cameras.
        image_size_wh: (cameras, 2), width and height of the images, pixels.
        number: (instants,), number of each instant: that of the frames, where frames of equal number are one instant.
        corners_px: (cameras, instants, corners, 2), pixels; NaN where a corner is not seen.
    """

    names: tuple[str, ...]
    image_size_wh: Int[np.ndarray, "cameras 2"]
    number: Int[np.ndarray, " instants"]
    corners_px: Float[np.ndarray, "cameras instants corners 2"]

    @property
    def seen(self) -> Bool[np.ndarray, "cameras instants"]:
        """(cameras, instants), True where a camera sees enough corners."""
        least = min(LEAST_CORNERS, self.corners_px.shape[2])
        return np.isfinite(self.corners_px[..., 0]).sum(axis=-1) >= least

    def select(self, instants: Bool[np.ndarray, " instants"]) -> BoardViews:
        """Views of chosen instants."""
        return replace(self, number=self.number[instants], corners_px=self.corners_px[:, instants])


@dataclass(frozen=True)
class FoundBoards:
    """Views of a board, and how they were found.

    Attributes:
        views: the views; instants at which no camera sees the board are left out.
        board: the board, with the pattern that was found.
        mirrored: (cameras,), number of views in which the board is seen mirrored.
        searched: (cameras,), number of images that were searched.
    """

    views: BoardViews
    board: Board
    mirrored: Int[np.ndarray, " cameras"]
    searched: Int[np.ndarray, " cameras"]


def find_views(
    board: Board,
    cameras: Sequence[CameraImages],
    instants: tuple[Int[np.ndarray, " instants"], Int[np.ndarray, "instants cameras"]],
    report: Report = no_progress,
) -> FoundBoards:
    """Find the corners of a board in the images of all cameras.

    Args:
        board: the board; how it was printed is found out.
        cameras: the images.
        instants: number of each instant, and (instants, cameras), number of each camera's frame or -1.
        report: display of the progress.

    Raises:
        InputError: an image cannot be read, or a camera never sees the board; the message says what is seen instead.
    """
    number, frames = instants
    board, seen_times = recognise_board(board, _samples(cameras, frames))
    if not seen_times:
        raise missing_board(board, list(islice(_samples(cameras, frames), _MOST_SAMPLES)))
    _check_markers(board, _samples(cameras, frames))
    finder = BoardFinder(board)
    corners_px = np.full((len(cameras), len(number), board.num_corners, 2), np.nan)
    mirrored = np.zeros(len(cameras), np.int64)
    with report("corners", int((frames >= 0).sum())) as advance:
        for index, camera in enumerate(cameras):
            row_of = {int(frame): row for row, frame in enumerate(frames[:, index]) if frame >= 0}
            for frame, grey in camera.read(np.array(sorted(row_of), np.int64)):
                advance(1)
                row = row_of[frame]
                corners_px[index, row] = finder.find(grey)
                if np.isnan(corners_px[index, row, :, 0]).all() and board.kind != "chessboard":
                    corners_px[index, row] = finder.find_mirrored(grey)
                    mirrored[index] += bool(np.isfinite(corners_px[index, row, :, 0]).any())
    views = BoardViews(
        tuple(camera.name for camera in cameras),
        np.array([camera.image_size_wh for camera in cameras]),
        number,
        corners_px,
    )
    searched = (frames >= 0).sum(axis=0)
    for name, of_camera, count in zip(views.names, views.seen, searched.tolist(), strict=True):
        if not of_camera.any():
            raise InputError(
                f"camera {name}",
                expected="views of the board that the other cameras see",
                found=f"none in {count} frames",
                remedy="check that the board is in its images, sharp and large enough, or leave the camera out",
            )
    return FoundBoards(views.select(np.asarray(views.seen.any(axis=0))), board, mirrored, searched)


def _check_markers(board: Board, images: Iterator[UInt8[np.ndarray, "height width"]]) -> None:
    """Raise `InputError` for a board whose markers are of another size than stated."""
    measured = measure_markers(board, images)
    if measured is None or board.marker_m is None:
        return
    stated = board.marker_m / board.square_m
    if abs(measured / stated - 1) > _MARKER_SIZE_ERROR:
        raise InputError(
            "board",
            expected=f"markers with sides of {stated:.2f} squares, as --square and --marker say",
            found=f"{measured:.2f} squares in the images",
            remedy="measure both with a ruler",
        )


def _samples(
    cameras: Sequence[CameraImages], frames: Int[np.ndarray, "instants cameras"]
) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """Grey images of all cameras in turn, evenly spread over the recording."""
    chosen = []
    for camera in range(frames.shape[1]):
        there = frames[frames[:, camera] >= 0, camera]
        # A round visits the recording from one end to the other, so that the first images differ.
        picked = there[
            np.linspace(0, len(there) - 1, min(len(there), _MOST_SAMPLES)).round().astype(np.int64)
        ]
        chosen.append(np.unique(picked))
    readers = [camera.read(picked) for camera, picked in zip(cameras, chosen, strict=True)]
    for _ in range(_MOST_SAMPLES):
        for reader in readers:
            for _, grey in islice(reader, 1):
                yield grey
