"""What a board is, found out from images: the pattern of its markers, or another board than the one that is stated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice, product

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.calibration.board_corners import BoardFinder
from psotrack.calibration.boards import Board
from psotrack.errors import InputError
from psotrack.foreground.markers import marker_dictionary

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
#: Number of markers that determine the plane of a board well, and number of images in which their size is measured.
_MARKERS_OF_PLANE, _IMAGES_OF_SIZE = 6, 40
#: A marker that is nearer than this to its place in another image stands still, pixels.
_STILL_PX = 2.0
#: Smallest number of images that show a marker of the board, as a fraction of those that show its most frequent marker.
_OFTEN = 0.25
#: Number of images in which markers are looked for before a chessboard is, and side of these images, pixels.
_FIRST_IMAGES, _FIRST_SIDE_PX = 6, 1000
#: Largest number of squares along a side of a board that is recognised by its markers.
_MOST_SQUARES = 20
#: Largest distance, in sides of a marker, up to which markers fit a board.
_FITS = 0.2
#: Sides of a marker in sides of a square that are tried: one of them is near enough to any that is printed.
_MARKERS_IN_SQUARES = (0.75, 0.5)

_Images = Sequence[UInt8[np.ndarray, "_ _"]]
#: Markers of one family in an image: number of each and its corners, (4, 2), pixels.
_Markers = dict[int, Float[np.ndarray, "4 2"]]


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
    family, seen = _family_of_board(_small(images))
    if not family:
        return Board(_size_of_chessboard(images), square_m, None, kind="chessboard")
    clearest = sorted(filter(None, _without_chance(seen)), key=len, reverse=True)[:_IMAGES]
    lowest, highest = min(map(min, clearest)), max(map(max, clearest))
    fits: list[tuple[float, Board]] = []
    sides = range(3, _MOST_SQUARES + 1)
    for part, columns, rows in product(_MARKERS_IN_SQUARES, sides, sides):
        # A board has a marker on every second square, and at most a row of its markers was never seen.
        if highest < columns * rows // 2 <= highest + 1 + columns // 2:
            board = Board(
                (columns, rows), square_m, part * square_m, _smallest(family, columns * rows // 2 - 1)
            )
            model = np.asarray(board.opencv().getObjPoints(), np.float64)[..., :2]
            fits.append((float(np.median([_misfit(model, one) for one in clearest])), board))
    misfit, fitting = min(fits, key=lambda one: one[0], default=(np.inf, None))
    if fitting is None or misfit > _FITS:
        raise InputError(
            "board",
            expected="a ChArUco board or a chessboard",
            found=f"markers {lowest} to {highest} of the dictionary {_smallest(family, highest)} in another order",
            remedy="say with --board, --squares, --marker, --dictionary and --first-marker what the board is",
        )
    part = measure_markers(fitting, images) or 0.75
    return replace(fitting, marker_m=round(part, 2) * square_m)


def describe_board(board: Board) -> str:
    """What a board is, in words: the kind, the squares, the markers."""
    columns, rows = board.squares_wh
    squares = f"{columns} x {rows} squares of {1e3 * board.square_m:g} mm"
    if board.marker_m is None:
        return f"a chessboard of {squares}"
    return f"a ChArUco board of {squares} with markers of {1e3 * board.marker_m:g} mm, dictionary {board.dictionary}"


def measure_markers(board: Board, images: Iterable[UInt8[np.ndarray, "_ _"]]) -> float | None:
    """The side of a ChArUco board's marker in sides of a square, as images show it; None where they do not show enough.

    The middles of the markers, which are whole squares apart whatever their size, give the homography from the image to
    the board; it maps the markers' corners to the board.
    """
    if board.kind != "charuco" or board.num_markers < _MARKERS_OF_PLANE:
        return None
    middles = np.asarray(board.opencv().getObjPoints(), np.float64)[..., :2].mean(axis=1) / board.square_m
    finder, sides = BoardFinder(board), []
    for grey in islice(images, _IMAGES_OF_SIZE):
        found = finder.markers(grey)
        if len(found) < _MARKERS_OF_PLANE:
            continue
        middles_px = found.corners_px.mean(axis=1)
        to_board, _ = cv2.findHomography(middles_px, middles[found.ids], cv2.RANSAC, 0.2)
        if to_board is not None:
            flat = cv2.perspectiveTransform(found.corners_px.reshape(-1, 1, 2), to_board).reshape(-1, 4, 2)
            sides.append(float(np.median(np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=-1))))
    return float(np.median(sides)) if len(sides) >= _LEAST_IMAGES else None


def number_of_first_images(cameras: int) -> int:
    """Number of images, of all cameras in turn, that `markers_on_chessboard` needs: two of each camera at least."""
    return max(_FIRST_IMAGES, 2 * cameras)


def markers_on_chessboard(board: Board, images: _Images) -> InputError | None:
    """The error for a board with markers that is stated as a chessboard, from a few images; None if there are none.

    OpenCV takes seconds to find no chessboard in many images of a ChArUco board, and in some images it takes corners of
    squares and markers for a smaller board's. The markers count where they move, and are inside of the corners that are
    found, if any.
    """
    small, finder = _small(images), BoardFinder(board)
    for family, of_images in _seen_markers(small).items():
        shown: list[_Markers] = []
        for grey, found in zip(small, _moved(of_images), strict=True):
            if len(found) >= _LEAST_MARKERS:
                corners_px = finder.find(grey).astype(np.float32)
                hull = (
                    cv2.convexHull(corners_px[np.isfinite(corners_px[:, 0])])
                    if np.isfinite(corners_px).any()
                    else None
                )
                middles = [quad.mean(axis=0) for quad in found.values()]
                if hull is None or any(
                    cv2.pointPolygonTest(hull, (float(u), float(v)), False) > 0 for u, v in middles
                ):
                    shown.append(found)
        if len(shown) > 1:
            dictionary = _smallest(family, max(max(found) for found in shown))
            number = f"in {len(shown)} of the first {len(images)} images"
            return InputError(
                "board",
                expected=f"a {board}",
                found=f"a board with markers of the dictionary {dictionary} {number}",
                remedy=f"pass --marker, the side of a marker, and --dictionary {dictionary}",
            )
    return None


def missing_board(board: Board, images: _Images) -> InputError:
    """The error for a board that is not found in any image: it says what is seen instead."""
    if board.num_markers == 1:
        found, remedy = _other_marker(images)
        return InputError("board", expected=f"a {board}", found=found, remedy=remedy)
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


def _other_marker(images: _Images) -> tuple[str, str]:
    """The marker that most images show, in words, and what to do."""
    counts = Counter(
        (family, marker)
        for sides in (images, _mirrored(images))
        for family, of_images in _seen_markers(sides).items()
        for found in of_images
        for marker in found
    )
    ((family, marker), count), *_ = [*counts.most_common(1), (("", 0), 0)]
    if count < _LEAST_IMAGES:
        return (
            f"no such marker in {len(images)} images",
            "check that the marker is large and sharp enough in the images, and has a white border",
        )
    dictionary = _smallest(family, marker)
    return (
        f"marker {marker} of the dictionary {dictionary} in {count} of {len(images)} images",
        f"pass --dictionary {dictionary} --first-marker {marker}",
    )


def _family_of_board(images: _Images) -> tuple[str, list[_Markers]]:
    """The family of a board's markers, and the markers in each image; no family if there are too few.

    Markers that stand still, such as those on the walls of a laboratory, are not those of a board that is moved: they
    count only if no others are found, in the images or in mirrored ones.
    """
    searched: dict[bool, dict[str, list[_Markers]]] = {}
    for only_moved, mirrored in product((True, False), (False, True)):
        if mirrored not in searched:
            searched[mirrored] = _seen_markers(_mirrored(images) if mirrored else images)
        seen = searched[mirrored]
        chosen = {family: _moved(found) if only_moved else found for family, found in seen.items()}
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


def _small(images: _Images) -> _Images:
    """Images in which markers are found quickly."""
    return [
        cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        for grey in images
        for scale in [max(1, round(max(grey.shape) / _FIRST_SIDE_PX))]
    ]


def _mirrored(images: _Images) -> _Images:
    return [np.ascontiguousarray(grey[:, ::-1]) for grey in images]


def _size_of_chessboard(images: _Images) -> tuple[int, int]:
    """Columns and rows of the squares of the chessboard that most images show.

    Raises:
        InputError: fewer than two images show one.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    shapes = Counter[tuple[int, int]]()
    for grey in _small(images):
        found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
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


def _misfit(model: Float[np.ndarray, "markers 4 2"], found: _Markers) -> float:
    """Median distance of markers in an image from the markers of a plane, in sides of a marker."""
    quads, flat = np.array(list(found.values())), model[list(found)].reshape(-1, 2)
    homography, _ = cv2.findHomography(flat, quads.reshape(-1, 2))
    if homography is None:
        return np.inf
    ends = cv2.perspectiveTransform(flat[:, None], homography).reshape(quads.shape)
    side = np.linalg.norm(np.diff(quads, axis=1), axis=-1).mean()
    return float(np.median(np.linalg.norm(ends - quads, axis=-1)) / side)


def _smallest(family: str, highest: int) -> str:
    """Name of the smallest dictionary of a family that has a marker."""
    sizes = [size for size in _FAMILIES[family] if size > highest]
    return f"{family}_{sizes[0]}" if sizes else family
