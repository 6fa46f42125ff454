"""How a board was printed, found out from images: white on black, OpenCV's old pattern; and why no board is found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.calibration.board_corners import BoardFinder
from psotrack.calibration.boards import Board
from psotrack.errors import InputError
from psotrack.foreground.detection import marker_dictionary

#: Number of views after which one way of printing is certain, if it has three times as many views as any other way.
_CERTAIN = 6
#: Number of images with most markers that are used to find out what a board is that was not found.
_IMAGES = 5
#: The largest dictionary of each family, and the numbers of markers of its smaller ones, which are its beginnings.
_FAMILIES = {
    **{f"{bits}x{bits}": (50, 100, 250, 1000) for bits in (4, 5, 6, 7)},
    **dict.fromkeys(
        (
            "aruco_original",
            "aruco_mip_36h12",
            "apriltag_36h11",
            "apriltag_36h10",
            "apriltag_25h9",
            "apriltag_16h5",
        ),
        (),
    ),
}
#: Smallest number of different markers in an image that are not there by chance.
_LEAST_MARKERS = 3
#: Number of markers that determine the plane of a board well, and number of images in which their size is measured.
_MARKERS_OF_PLANE, _IMAGES_OF_SHARE = 6, 40
#: A marker that is nearer than this to its place in another image stands still, pixels.
_STILL_PX = 2.0
#: Smallest number of images that show a marker that is not there by chance.
_LEAST_IMAGES = 3
#: Number of images in which markers are looked for before a chessboard is; two of each camera at least, because only
#: two images of one camera show what stands still. Side of these images, pixels, and number that must show markers.
_FIRST_IMAGES, _FIRST_SIDE_PX, _LEAST_FIRST_IMAGES = 6, 1000, 2
#: Largest number of squares along a side of a board that is recognised by its markers.
_MOST_SQUARES = 20
#: Largest distance, in sides of a marker, up to which markers fit a board.
_FITS = 0.2
#: Sides of a marker in sides of a square that are tried: one of them is near enough to any that is printed.
_SHARES = (0.75, 0.5)

#: Markers of an image by number, and their middles, pixels.
_Markers = dict[int, Float[np.ndarray, "2"]]


@dataclass(frozen=True)
class Recognised:
    """How a board was printed.

    Attributes:
        board: the board, with the pattern that was found.
        inverted: whether it is printed white on black.
        views: number of images in which it was found.
    """

    board: Board
    inverted: bool
    views: int

    def finder(self) -> BoardFinder:
        """Finder of this board."""
        return BoardFinder(self.board, self.inverted)


def recognise_board(board: Board, images: Iterable[UInt8[np.ndarray, "_ _"]]) -> Recognised:
    """Find out how a board was printed, from as few images as are certain.

    Args:
        board: the board as it is stated.
        images: grey images, in an order in which different views come early.
    """
    boards = [board]
    if board.kind == "charuco" and board.squares_wh[1] % 2 == 0:
        # The old pattern differs for an even number of rows only.
        boards.append(replace(board, legacy=not board.legacy))
    # A chessboard looks alike in both prints.
    prints = (False,) if board.kind == "chessboard" else (False, True)
    finders = [BoardFinder(one, inverted) for inverted in prints for one in boards]
    views = np.zeros(len(finders), np.int64)
    for grey in images:
        found = np.array([np.isfinite(finder.find(grey)[:, 0]).sum() for finder in finders])
        if not found.any() and board.kind != "chessboard":
            found = np.array([np.isfinite(finder.find_mirrored(grey)[:, 0]).sum() for finder in finders])
        views += (found == found.max()) & (found > 0)
        first, *others = sorted(views.tolist(), reverse=True)
        if first >= _CERTAIN and first >= 3 * max(others, default=0):
            break
    best = finders[int(views.argmax())]
    return Recognised(best.board, best.inverted, int(views.max()))


def detect_board(square_m: float, images: Sequence[UInt8[np.ndarray, "_ _"]]) -> Board:
    """Find out what board images show, of which only the side of a square is known: a ChArUco board or a chessboard.

    Args:
        square_m: side of a square, metres, which no image shows.
        images: grey images, of the cameras in turn.

    Raises:
        InputError: the images show neither, or a board whose squares cannot be counted.
    """
    counted = [
        (len(ids), name, turned, ids) for name, turned, ids in _markers_of_all_dictionaries(_small(images))
    ]
    most, family, inverted, _ = max(counted, key=lambda one: one[0], default=(0, "", False, np.zeros(0)))
    if most < _LEAST_MARKERS:
        return Board(_size_of_chessboard(images), square_m, None, kind="chessboard")
    largest = f"{family}_1000" if _FAMILIES[family] else family
    seen = _seen_markers(family, [255 - grey if inverted else grey for grey in images])
    # Those first that show most of the board.
    order = sorted(range(len(images)), key=lambda index: -len(seen[index]))
    clearest = [images[index] for index in order]
    models = (Board((3, 3), square_m, share * square_m, largest) for share in _SHARES)
    size = next((size for model in models if (size := _size_by_markers(model, clearest, inverted))), None)
    if size is None:
        ids = [marker for of_image in seen for marker in of_image]
        raise InputError(
            "board",
            expected="a ChArUco board or a chessboard",
            found=f"markers {min(ids)} to {max(ids)} of the dictionary {_smallest(family, max(ids))} in another order",
            remedy="say with --board, --squares, --marker, --dictionary and --first-marker what the board is",
        )
    dictionary = _smallest(family, size[0] * size[1] // 2 - 1)
    board = Board(size, square_m, square_m / 2, dictionary)
    share = measure_marker_share(Recognised(board, inverted, 0), clearest) or 0.75
    return replace(board, marker_m=round(share, 2) * square_m)


def describe_board(board: Board) -> str:
    """What a board is, in words: the kind, the squares, the markers."""
    columns, rows = board.squares_wh
    squares = f"{columns} x {rows} squares of {1e3 * board.square_m:g} mm"
    if board.marker_m is None:
        return f"a chessboard of {squares}"
    return f"a ChArUco board of {squares} with markers of {1e3 * board.marker_m:g} mm, dictionary {board.dictionary}"


def _small(images: Sequence[UInt8[np.ndarray, "_ _"]]) -> list[UInt8[np.ndarray, "_ _"]]:
    """Images in which markers are found quickly."""
    return [
        cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        for grey in images
        for scale in [max(1, round(max(grey.shape) / _FIRST_SIDE_PX))]
    ]


def _size_of_chessboard(images: Sequence[UInt8[np.ndarray, "_ _"]]) -> tuple[int, int]:
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


def measure_marker_share(recognised: Recognised, images: Iterable[UInt8[np.ndarray, "_ _"]]) -> float | None:
    """The side of a ChArUco board's marker in sides of a square, as images show it; None where they do not show enough.

    The middles of the markers, which are whole squares apart whatever their size, give the homography from the image to
    the board; it maps the markers' corners to the board.
    """
    board = recognised.board
    if board.kind != "charuco" or board.num_markers < _MARKERS_OF_PLANE:
        return None
    model = board.opencv()
    detector = cv2.aruco.ArucoDetector(model.getDictionary())
    corners_of = dict(
        zip(np.ravel(model.getIds()).tolist(), np.asarray(model.getObjPoints(), float)[..., :2], strict=True)
    )
    shares = []
    for grey in islice(images, _IMAGES_OF_SHARE):
        quads, ids, _ = detector.detectMarkers(255 - grey if recognised.inverted else grey)
        found = {} if ids is None else dict(zip(np.ravel(ids).tolist(), quads, strict=True))
        own = [marker for marker in found if marker in corners_of]
        if len(own) < _MARKERS_OF_PLANE:
            continue
        quads_px = np.array([found[marker].reshape(4, 2) for marker in own], float)
        middles_m = np.array([corners_of[marker].mean(axis=0) for marker in own])
        to_board, _ = cv2.findHomography(quads_px.mean(axis=1), middles_m, cv2.RANSAC, 0.2 * board.square_m)
        if to_board is None:
            continue
        quads_m = cv2.perspectiveTransform(quads_px.reshape(-1, 1, 2), to_board).reshape(-1, 4, 2)
        sides_m = np.linalg.norm(quads_m - np.roll(quads_m, 1, axis=1), axis=-1)
        shares.append(float(np.median(sides_m)) / board.square_m)
    return float(np.median(shares)) if len(shares) >= _LEAST_IMAGES else None


def number_of_first_images(cameras: int) -> int:
    """Number of images, of all cameras in turn, that `explain_markers_on_chessboard` needs."""
    return max(_FIRST_IMAGES, 2 * cameras)


def explain_markers_on_chessboard(
    board: Board, images: Sequence[UInt8[np.ndarray, "_ _"]]
) -> tuple[str, str] | None:
    """Say which markers are on a board that is stated as a chessboard, from a few images; None if there are none.

    OpenCV takes seconds to find no chessboard in many images of a ChArUco board, and in some images it takes corners of
    squares and markers for a smaller board's. The markers count where they move, and are inside of the corners that are
    found, if any.

    Returns:
        what was found, and what to do; both are parts of a message.
    """
    small = _small(images)
    finder = BoardFinder(board)
    corners: dict[int, Float[np.ndarray, "corners 2"]] = {}
    for family in _FAMILIES:
        shown = [0, 0]
        for index, found in enumerate(_moved(_seen_markers(family, small, both_prints=True))):
            if len(found) < _LEAST_MARKERS:
                continue
            if index not in corners:
                corners[index] = finder.find(small[index])
            if _any_inside(list(found.values()), corners[index]):
                shown = [shown[0] + 1, max(shown[1], *found)]
        if shown[0] >= _LEAST_FIRST_IMAGES:
            dictionary = _smallest(family, shown[1])
            return (
                f"a board with markers of the dictionary {dictionary} in {shown[0]} of the first {len(images)} images",
                f"pass --marker, the side of a marker, and --dictionary {dictionary}",
            )
    return None


def _any_inside(
    points_px: Sequence[Float[np.ndarray, "2"]], corners_px: Float[np.ndarray, "corners 2"]
) -> bool:
    """Whether any point is inside of the hull of corners; True where no corner was found."""
    if np.isnan(corners_px).all():
        return True
    hull = cv2.convexHull(corners_px[np.isfinite(corners_px[:, 0])].astype(np.float32))
    return any(cv2.pointPolygonTest(hull, (float(u), float(v)), False) > 0 for u, v in points_px)


def missing_board(board: Board, images: Sequence[UInt8[np.ndarray, "_ _"]]) -> InputError:
    """The error for a board that is not found in any image: it says what is seen instead."""
    if board.num_markers == 1:
        found, remedy = _other_marker(images)
    else:
        try:
            seen = detect_board(board.square_m, images)
        except InputError as error:
            return error
        if (seen.kind, seen.squares_wh) == (board.kind, board.squares_wh) and _family(seen) == _family(board):
            found = "too few of its corners in each image"
            remedy = "is the board large and sharp in the images?"
        else:
            found = describe_board(seen)
            remedy = f"pass --squares {seen.squares_wh[0]}x{seen.squares_wh[1]}"
            if seen.marker_m is not None:
                # A ruler is better than the images.
                marker = f" --marker {seen.marker_m:g}" if board.marker_m is None else ""
                remedy += f"{marker} --dictionary {seen.dictionary}"
    return InputError("board", expected=f"a {board}", found=found, remedy=remedy)


def _family(board: Board) -> str:
    return "" if board.marker_m is None else board.dictionary.lower().removeprefix("dict_").rpartition("_")[0]


def _other_marker(images: Sequence[UInt8[np.ndarray, "_ _"]]) -> tuple[str, str]:
    """The marker that most images show, in words, and what to do."""
    seen = Counter[tuple[str, int]]()
    for grey, inverted, mirrored in product(images, (False, True), (False, True)):
        sides = np.ascontiguousarray(grey[:, ::-1]) if mirrored else grey
        for family in _FAMILIES:
            ids = _most(_seen_markers(family, [255 - sides if inverted else sides]))
            seen.update((family, int(marker)) for marker in ids)
    ((family, marker), count), *_ = [*seen.most_common(1), (("", 0), 0)]
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


def _markers_of_all_dictionaries(
    images: Sequence[UInt8[np.ndarray, "_ _"]],
) -> list[tuple[str, bool, np.ndarray]]:
    """Family of a dictionary, whether white on black, and the markers of the image that shows most of them.

    Markers that stand still, such as those on the walls of a laboratory, are not those of a board that is moved: they
    count only if no others are found. Mirrored images are searched only if no dictionary has enough markers in the
    others.
    """
    searched: dict[bool, list[tuple[str, bool, list[_Markers]]]] = {}
    for moved, mirrored in product((True, False), (False, True)):
        if mirrored not in searched:
            # All images: they come from the cameras in turn, and only two of one camera show what stands still.
            sides = [np.ascontiguousarray(grey[:, ::-1]) if mirrored else grey for grey in images]
            searched[mirrored] = [
                (name, inverted, _seen_markers(name, [255 - side if inverted else side for side in sides]))
                for name, inverted in product(_FAMILIES, (False, True))
            ]
        found = [
            (name, inverted, _most(_moved(seen) if moved else seen))
            for name, inverted, seen in searched[mirrored]
        ]
        if any(len(ids) >= _LEAST_MARKERS for _, _, ids in found):
            break
    return found


def _seen_markers(
    family: str, images: Sequence[UInt8[np.ndarray, "_ _"]], *, both_prints: bool = False
) -> list[_Markers]:
    """The markers of a family in each image; if `both_prints`, also those printed white on black."""
    dictionary = marker_dictionary(f"{family}_1000" if _FAMILIES[family] else family)
    # A marker of few bits is easily seen where none is: only exact matches count.
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 0.0
    parameters.detectInvertedMarker = both_prints
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    seen = []
    for image in images:
        quads, ids, _ = detector.detectMarkers(image)
        found = [] if ids is None else np.ravel(ids).astype(int).tolist()
        seen.append(
            {
                marker: quad.reshape(4, 2).astype(float).mean(axis=0)
                for marker, quad in zip(found, quads, strict=True)
            }
        )
    return seen


def _moved(seen: Sequence[_Markers]) -> list[_Markers]:
    """The markers of each image that are in no other image at the same place."""

    def stands_still(number: int, marker: int) -> bool:
        return any(
            np.linalg.norm(other[marker] - seen[number][marker]) < _STILL_PX
            for index, other in enumerate(seen)
            if index != number and marker in other
        )

    return [
        {marker: place for marker, place in of_image.items() if not stands_still(number, marker)}
        for number, of_image in enumerate(seen)
    ]


def _most(seen: Sequence[_Markers]) -> Int[np.ndarray, " markers"]:
    """The markers of the image that shows most."""
    most: _Markers = max(seen, key=lambda of_image: len(of_image), default={})
    return np.array(sorted(most), np.int64)


def _size_by_markers(
    board: Board, images: Sequence[UInt8[np.ndarray, "_ _"]], inverted: bool
) -> tuple[int, int] | None:
    """Columns and rows of a ChArUco board whose markers lie as they do in the images; None if no board fits."""
    detector = cv2.aruco.ArucoDetector(marker_dictionary(board.dictionary))
    seen = []
    for grey in images[:_IMAGES]:
        image = 255 - grey if inverted else grey
        found = [detector.detectMarkers(side) for side in (image, np.ascontiguousarray(image[:, ::-1]))]
        # In the mirrored image of a board that is not mirrored, a few markers are seen by chance.
        quads, ids, _ = max(found, key=lambda one: 0 if one[1] is None else len(one[1]))
        if ids is not None and len(ids) >= _LEAST_MARKERS:
            seen.append((np.ravel(ids).astype(np.int64), np.asarray(quads, np.float64).reshape(-1, 4, 2)))
    if not seen:
        return None
    highest = max(int(ids.max()) for ids, _ in seen)
    fits: list[tuple[float, tuple[int, int]]] = []
    for columns, rows in product(range(3, _MOST_SQUARES + 1), repeat=2):
        # A board has a marker on every second square, and at most a row of its markers was never seen.
        if highest < columns * rows // 2 <= highest + 1 + columns // 2:
            model = replace(board, squares_wh=(columns, rows)).opencv()
            of_marker = np.asarray(model.getObjPoints(), np.float64)[..., :2]
            errors = [_misfit(of_marker[ids], quads) for ids, quads in seen]
            fits.append((float(np.median(errors)), (columns, rows)))
    best = min(fits, default=(np.inf, (0, 0)))
    return best[1] if best[0] < _FITS else None


def _misfit(flat: Float[np.ndarray, "markers 4 2"], quads: Float[np.ndarray, "markers 4 2"]) -> float:
    """Median distance of markers in an image from the markers of a plane, in sides of a marker."""
    homography, _ = cv2.findHomography(flat.reshape(-1, 2), quads.reshape(-1, 2))
    if homography is None:
        return np.inf
    ends = cv2.perspectiveTransform(flat.reshape(-1, 1, 2), homography).reshape(-1, 2)
    side = np.linalg.norm(np.diff(quads, axis=1), axis=-1).mean()
    return float(np.median(np.linalg.norm(ends - quads.reshape(-1, 2), axis=-1)) / side)


def _smallest(family: str, highest: int) -> str:
    """Name of the smallest dictionary of a family that has a marker."""
    sizes = [size for size in _FAMILIES[family] if size > highest]
    return f"{family}_{sizes[0]}" if sizes else family
