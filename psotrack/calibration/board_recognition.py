"""Boards in images: the corners of a board that is known, and what a board is of which only a square's side is known.

A board of markers may be printed white on black, and a board may be seen mirrored: from behind through thin paper, or
because its back shows the mirrored pattern.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, product

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.calibration.boards import Board
from psotrack.errors import InputError
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector, marker_dictionary

#: Largest standard deviation of corners from one line that is still a line, pixels.
_LINE_PX = 1.5
#: Largest side of an image in which markers, and by OpenCV chessboards, are found quickly, pixels.
_QUICK_SIDE_PX = 1000
#: Number of views after which one pattern is certain, if it has three times as many views as the other.
_CERTAIN = 6
#: Number of images with most markers that are used to find out what a board is that was not found.
_IMAGES = 5
#: The largest dictionary of each family, and the numbers of markers of its smaller ones, which are its beginnings.
_FAMILIES = {
    **{f"{bits}x{bits}": (50, 100, 250, 1000) for bits in (4, 5, 6, 7)},
    **dict.fromkeys(("aruco_original", "aruco_mip_36h12", "apriltag_36h11", "apriltag_36h10"), ()),
    **dict.fromkeys(("apriltag_25h9", "apriltag_16h5"), ()),
}
#: Smallest number of different markers in an image, and of images that show a marker, that are not there by chance.
_LEAST_MARKERS, _LEAST_IMAGES = 3, 3
#: Number of markers that determine the plane of a board, and number of images in which their size is measured.
_MARKERS_OF_PLANE, _IMAGES_OF_SIZE = 5, 40
#: A marker that is nearer than this to its place in another image stands still, pixels.
_STILL_PX = 2.0
#: Smallest number of images that show a marker of the board, as a fraction of those that show its most frequent marker.
_OFTEN = 0.25
#: Largest number of squares along a side of a board that is recognised by its markers.
_MOST_SQUARES = 20
#: Largest distance, in sides of a square, up to which middles of markers fit a board, and a marker's side by default.
_FITS, _USUAL_MARKER = 0.15, 0.75

_Images = Sequence[UInt8[np.ndarray, "_ _"]]
_Corners = Float[np.ndarray, "corners 2"]
#: Markers of one family in an image: number of each and its corners, (4, 2), pixels.
_Markers = dict[int, Float[np.ndarray, "4 2"]]


@dataclass(frozen=True)
class BoardFinder:
    """Finds the corners of a board."""

    board: Board

    def find(self, grey: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "corners 2"]:
        """Pixels of the board's corners, (corners, 2); NaN where a corner is not found, everywhere if few are."""
        found = np.full((self.board.num_corners, 2), np.nan)
        if self.board.kind == "chessboard":
            self._find_chessboard(grey, found)
        elif self.board.kind == "grid":
            self._find_grid(grey, found)
        else:
            self._find_charuco(grey, found)
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

    def _find_charuco(self, grey: UInt8[np.ndarray, "height width"], found: _Corners) -> None:
        markers = self.markers(grey)
        if len(markers):
            quads = [quad[None].astype(np.float32) for quad in markers.corners_px]
            corners, ids, _, _ = self._charuco.detectBoard(
                grey, markerCorners=quads, markerIds=markers.ids[:, None].astype(np.int32)
            )
            if ids is not None and len(ids):
                found[np.asarray(ids).ravel()] = np.asarray(corners, np.float64).reshape(-1, 2)

    def _find_grid(self, grey: UInt8[np.ndarray, "height width"], found: _Corners) -> None:
        markers = self.markers(grey)
        found.reshape(-1, 4, 2)[markers.ids - self.board.first_marker] = markers.corners_px

    def _find_chessboard(self, image: UInt8[np.ndarray, "height width"], found: _Corners) -> None:
        columns, rows = self.board.squares_wh
        size = (columns - 1, rows - 1)
        # The search is slow in large images, and the corners are refined in the full image.
        small, scale = _reduced(image)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        is_found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
        if not is_found:
            return
        pixels = np.asarray(corners, np.float64).reshape(-1, 2)
        if scale > 1:
            # Pixel centres are at whole numbers.
            pixels = (pixels + 0.5) * scale - 0.5
            start = pixels.astype(np.float32).reshape(-1, 1, 2).copy()
            # Half the side of a window around a corner that contains no other corner.
            grid = pixels.reshape(rows - 1, columns - 1, 2)
            steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
            half = int(np.clip(min(steps) / 3, 2, 11))
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
            pixels = np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria), np.float64)
        found[:] = _in_order(pixels.reshape(rows - 1, columns - 1, 2), image).reshape(-1, 2)


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


def recognise_board(board: Board, images: Iterable[UInt8[np.ndarray, "_ _"]]) -> tuple[Board, int]:
    """The board with the pattern that images show, the stated one or OpenCV's other one, and the number of its views.

    Args:
        board: the board as it is stated.
        images: grey images, in an order in which different views come early; as few are read as are certain.
    """
    boards = [board]
    if board.kind == "charuco" and board.squares_wh[1] % 2 == 0:
        # The old pattern differs for an even number of rows only.
        boards.append(replace(board, legacy=not board.legacy))
    finders = [BoardFinder(one) for one in boards]
    views = np.zeros(len(finders), np.int64)
    for grey in images:
        found = np.array([np.isfinite(finder.find(grey)[:, 0]).sum() for finder in finders])
        if not found.any() and board.kind != "chessboard":
            found = np.array([np.isfinite(finder.find_mirrored(grey)[:, 0]).sum() for finder in finders])
        views += (found == found.max()) & (found > 0)
        if views.max() >= _CERTAIN and views.max() >= 3 * np.sort(views)[:-1].max(initial=0):
            break
    return boards[int(views.argmax())], int(views.max())


def detect_board(square_m: float, images: _Images) -> Board:
    """Find out what board images show, of which only the side of a square is known: a ChArUco board or a chessboard.

    Args:
        square_m: side of a square, metres, which no image shows.
        images: grey images, of the cameras in turn.

    Raises:
        InputError: the images show neither, or a board whose squares cannot be counted.
    """
    family, seen = _family_of_board([_reduced(grey)[0] for grey in images])
    if not family:
        return Board(_size_of_chessboard(images), square_m, None, kind="chessboard")
    clearest = sorted(_without_chance(seen), key=len, reverse=True)[:_IMAGES]
    clearest = [found for found in clearest if len(found) >= _MARKERS_OF_PLANE] or clearest[:1]
    lowest, highest = min(map(min, clearest)), max(map(max, clearest))
    fits: list[tuple[float, Board]] = []
    for columns, rows in product(range(3, _MOST_SQUARES + 1), repeat=2):
        # A board has a marker on every second square, and at most a row of its markers was never seen.
        if highest < columns * rows // 2 <= highest + 1 + columns // 2:
            dictionary = _smallest(family, columns * rows // 2 - 1)
            board = Board((columns, rows), square_m, _USUAL_MARKER * square_m, dictionary)
            fits.append((float(np.median([_flattened(board, one)[1] for one in clearest])), board))
    misfit, fitting = min(fits, key=lambda one: one[0], default=(np.inf, None))
    if fitting is None or misfit > _FITS:
        raise InputError(
            "board",
            expected="a ChArUco board or a chessboard",
            found=f"markers {lowest} to {highest} of the dictionary {_smallest(family, highest)} in another order",
            remedy="say with --board, --squares, --marker, --dictionary and --first-marker what the board is",
        )
    side = measure_markers(fitting, images) or _USUAL_MARKER
    return replace(fitting, marker_m=round(side, 2) * square_m)


def describe_board(board: Board) -> str:
    """What a board is, in words: the kind, the squares, the markers."""
    columns, rows = board.squares_wh
    squares = f"{columns} x {rows} squares of {1e3 * board.square_m:g} mm"
    if board.marker_m is None:
        return f"a chessboard of {squares}"
    return f"a ChArUco board of {squares} with markers of {1e3 * board.marker_m:g} mm, dictionary {board.dictionary}"


def measure_markers(board: Board, images: Iterable[UInt8[np.ndarray, "_ _"]]) -> float | None:
    """The side of a ChArUco board's marker in sides of a square, as images show it; None if they do not show enough."""
    if board.kind != "charuco" or board.num_markers < _MARKERS_OF_PLANE:
        return None
    finder, sides = BoardFinder(board), []
    for grey in islice(images, _IMAGES_OF_SIZE):
        markers = finder.markers(grey)
        flat, misfit = _flattened(board, dict(zip(markers.ids.tolist(), markers.corners_px, strict=True)))
        if misfit < _FITS:
            sides.append(float(np.median(np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=-1))))
    return float(np.median(sides)) if len(sides) >= _LEAST_IMAGES else None


def _flattened(board: Board, found: _Markers) -> tuple[Float[np.ndarray, "markers 4 2"], float]:
    """Corners of markers on a ChArUco board, in squares, and the median distance of their middles from the board's.

    The middles, which are whole squares apart whatever the size of the markers, give the homography from the image to
    the board. The distance is infinite for too few markers, or for markers that are not on a plane.
    """
    quads = np.array(list(found.values())).reshape(-1, 1, 2)
    places = np.asarray(board.opencv().getObjPoints(), np.float64)[..., :2].mean(axis=1) / board.square_m
    if len(found) < _MARKERS_OF_PLANE:
        return quads.reshape(-1, 4, 2), np.inf
    places = places[list(found)]
    to_board, _ = cv2.findHomography(quads.reshape(-1, 4, 2).mean(axis=1), places)
    if to_board is None:
        return quads.reshape(-1, 4, 2), np.inf
    flat = cv2.perspectiveTransform(quads, to_board).reshape(-1, 4, 2)
    return flat, float(np.median(np.linalg.norm(flat.mean(axis=1) - places, axis=-1)))


def missing_board(board: Board, images: _Images) -> InputError:
    """The error for a board that is not found in any image: it says what is seen instead."""
    if board.num_markers == 1:
        return InputError(
            "board",
            expected=f"a {board}",
            found=f"no such marker in {len(images)} images",
            remedy="check --dictionary and --first-marker; is it large and sharp, with a white border?",
        )
    try:
        seen = detect_board(board.square_m, images)
    except InputError as error:
        return error
    remedy = f"pass --squares {seen.squares_wh[0]}x{seen.squares_wh[1]}"
    if seen.marker_m is not None:
        # A ruler is better than the images.
        remedy += "" if board.marker_m else f" --marker {seen.marker_m:g}"
        remedy += f" --dictionary {seen.dictionary}"
    found = describe_board(seen)
    if (seen.kind, seen.squares_wh) == (board.kind, board.squares_wh) and _family(seen) == _family(board):
        found, remedy = "too few of its corners in each image", "is the board large and sharp in the images?"
    return InputError("board", expected=f"a {board}", found=found, remedy=remedy)


def _family(board: Board) -> str:
    return "" if board.marker_m is None else board.dictionary.lower().removeprefix("dict_").rpartition("_")[0]


def _family_of_board(images: _Images) -> tuple[str, list[_Markers]]:
    """The family of a board's markers, and the markers in each image; no family if there are too few.

    Markers that stand still, such as those on the walls of a laboratory, are not those of a board that is moved: they
    count only if no others are found.
    """
    seen = _seen_markers(images)
    for chosen in ({family: _moved(found) for family, found in seen.items()}, seen):
        family, of_images = max(chosen.items(), key=lambda one: max(map(len, one[1]), default=0))
        if max(map(len, of_images), default=0) >= _LEAST_MARKERS:
            return family, of_images
    return "", []


def _seen_markers(images: _Images) -> dict[str, list[_Markers]]:
    """The markers of each family in each image, in both prints."""
    dictionaries = [marker_dictionary(f"{name}_1000" if sizes else name) for name, sizes in _FAMILIES.items()]
    # A marker of few bits is easily seen where none is: only exact matches count.
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate, parameters.detectInvertedMarker = 0.0, True
    detector = cv2.aruco.ArucoDetector(dictionaries, parameters)
    seen: dict[str, list[_Markers]] = {name: [{} for _ in images] for name in _FAMILIES}
    for number, grey in enumerate(images):
        quads, ids, _, which = detector.detectMarkersMultiDict(grey)
        found = zip(quads, np.ravel(ids), np.ravel(which), strict=True) if quads else ()
        for quad, marker, family in found:
            seen[list(_FAMILIES)[int(family)]][number][int(marker)] = quad.reshape(4, 2).astype(float)
    return seen


def _moved(seen: Sequence[_Markers]) -> list[_Markers]:
    """The markers of each image that are in no other image at the same place."""

    def stands_still(number: int, marker: int) -> bool:
        middle = seen[number][marker].mean(axis=0)
        others = [one[marker] for index, one in enumerate(seen) if index != number and marker in one]
        return any(np.linalg.norm(other.mean(axis=0) - middle) < _STILL_PX for other in others)

    return [
        {marker: quad for marker, quad in found.items() if not stands_still(number, marker)}
        for number, found in enumerate(seen)
    ]


def _without_chance(seen: Sequence[_Markers]) -> list[_Markers]:
    """The markers of each image, without those that few of the images show.

    A marker of few bits is read by chance in some images, such as in a part of another dictionary's marker.
    """
    times = Counter(marker for found in seen for marker in found)
    least = _OFTEN * max(times.values())
    return [{marker: quad for marker, quad in found.items() if times[marker] >= least} for found in seen]


def _reduced(grey: UInt8[np.ndarray, "height width"]) -> tuple[UInt8[np.ndarray, "_ _"], int]:
    """An image in which markers and chessboards are found quickly, and by how much it is reduced."""
    scale = max(1, round(max(grey.shape) / _QUICK_SIDE_PX))
    return cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA), scale


def _size_of_chessboard(images: _Images) -> tuple[int, int]:
    """Columns and rows of the squares of the chessboard that most images show.

    Raises:
        InputError: fewer than two images show one.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    shapes = Counter[tuple[int, int]]()
    for grey in images:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(_reduced(grey)[0], (3, 3), flags)
        if found:
            rows, columns = np.shape(meta)[:2]
            shapes[(max(rows, columns) + 1, min(rows, columns) + 1)] += 1
    ((size, count), *_) = [*shapes.most_common(1), ((0, 0), 0)]
    if count < 2:
        raise InputError(
            "board",
            expected="a ChArUco board or a chessboard",
            found=f"neither in {len(images)} images",
            remedy="is the board large and sharp, with a white border? --squares states another kind",
        )
    return size


def _smallest(family: str, highest: int) -> str:
    """Name of the smallest dictionary of a family that has a marker."""
    sizes = [size for size in _FAMILIES[family] if size > highest]
    return f"{family}_{sizes[0]}" if sizes else family
