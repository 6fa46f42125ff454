"""Calibration boards: ChArUco boards, chessboards, and grids of ArUco markers or AprilTags; and a board to print.

A board's own axes are those of OpenCV: seen from the front, x points right and y points down, so that z points away
from the viewer, into the board. The origin is the board's top left corner, for a grid the first marker's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.rig.settings import BoardSettings
from psotrack.errors import SettingsError, check_positive
from psotrack.foreground.markers import marker_dictionary
from psotrack.support import atomic_write, refuse_to_overwrite

BoardKind = Literal["charuco", "chessboard", "grid"]
#: Smallest number of corners of a view that counts, or all that the board has.
LEAST_CORNERS = 6
#: White border about a board, in sides of a square; resolution of a square, pixels; millimetres of an inch.
_BORDER, _SQUARE_PX, _INCH_MM = 1.0, 120, 25.4
_SUFFIXES = (".pdf", ".png", ".svg")


@dataclass(frozen=True)
class Board:
    """A board of known size.

    Attributes:
        squares_wh: columns and rows of squares; of markers, for a grid.
        square_m: side of a square in metres; for a grid, the distance from the middle of a marker to the next one's;
            for a single marker, its side.
        marker_m: side of a marker in metres; None for a chessboard.
        dictionary: name of the markers' dictionary, such as 4x4_50 or apriltag_36h11.
        kind: ChArUco board, chessboard, or grid of markers.
        first_marker: number of the first marker of a grid; the others count on from it, row by row.
        legacy: ChArUco pattern of OpenCV before version 4.6: a board with an even number of rows has a marker, not a
            black square, in its top left corner.
    """

    squares_wh: tuple[int, int]
    square_m: float
    marker_m: float | None = None
    dictionary: str = "4x4_50"
    kind: BoardKind = "charuco"
    first_marker: int = 0
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(BoardKind):
            raise SettingsError(
                "board.kind", expected=f"one of {', '.join(get_args(BoardKind))}", found=self.kind
            )
        if min(self.squares_wh) < (1 if self.kind == "grid" else 3):
            what = "at least one marker" if self.kind == "grid" else "at least 3 x 3 squares"
            raise SettingsError("board.squares_wh", expected=what, found=f"{self.squares_wh}")
        check_positive("board.square_m", self.square_m)
        if self.kind == "chessboard":
            if self.marker_m is not None:
                raise SettingsError(
                    "board.marker_m", expected="none on a chessboard", found=f"{self.marker_m:g}"
                )
        elif self.marker_m is None or not (
            0 < self.marker_m < self.square_m or (self.kind == "grid" and self.marker_m == self.square_m)
        ):
            found = "none" if self.marker_m is None else f"{self.marker_m:g}"
            raise SettingsError(
                "board.marker_m", expected="a side above 0 and below the square's", found=found
            )

    @classmethod
    def of(cls, settings: BoardSettings) -> Board:
        """The board that settings state.

        Raises:
            SettingsError: the settings do not say what the board is like.
        """
        if settings.squares is None:
            raise SettingsError("board", expected="--squares, the number of squares", found="none")
        kind, marker_m, separation_m = settings.kind, settings.marker_m, settings.separation_m
        if kind is None:
            is_grid = separation_m is not None or settings.squares == (1, 1)
            kind = "grid" if is_grid else "charuco" if marker_m is not None else "chessboard"
        if kind == "grid":
            if marker_m is not None and settings.squares == (1, 1):
                # A single marker has no gap to another one.
                separation_m = 0.0
            if marker_m is None or separation_m is None:
                raise SettingsError(
                    "board",
                    expected="--marker and --separation of a grid",
                    found="--marker only" if marker_m else "no --marker",
                )
            side_m = marker_m + separation_m
            return cls(settings.squares, side_m, marker_m, settings.dictionary, "grid", settings.first_marker)
        if settings.square_m is None:
            raise SettingsError("board", expected="--square, the side of a square in metres", found="none")
        return cls(settings.squares, settings.square_m, marker_m, settings.dictionary, kind)

    def __str__(self) -> str:
        columns, rows = self.squares_wh
        if self.squares_wh == (1, 1):
            return f"marker {self.first_marker} of {self.dictionary}"
        words = {"charuco": "ChArUco board", "chessboard": "chessboard", "grid": "grid of markers"}[self.kind]
        markers = "" if self.kind == "chessboard" else f" of {self.dictionary}"
        return f"{words} {columns} x {rows}{markers}"

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """A ChArUco board as an object of OpenCV.

        Raises:
            SettingsError: the dictionary does not exist, or the board is of another kind.
        """
        if self.kind != "charuco" or self.marker_m is None:
            raise SettingsError("board.kind", expected="charuco", found=self.kind)
        model = cv2.aruco.CharucoBoard(
            self.squares_wh, self.square_m, self.marker_m, marker_dictionary(self.dictionary)
        )
        model.setLegacyPattern(self.legacy)
        return model

    @property
    def num_corners(self) -> int:
        """Number of points of the board that a camera can see."""
        columns, rows = self.squares_wh
        return 4 * columns * rows if self.kind == "grid" else (columns - 1) * (rows - 1)

    @property
    def num_markers(self) -> int:
        """Number of markers on the board."""
        columns, rows = self.squares_wh
        return {"grid": columns * rows, "charuco": columns * rows // 2, "chessboard": 0}[self.kind]

    @property
    def least_corners(self) -> int:
        """Smallest number of corners of a view that counts."""
        return min(LEAST_CORNERS, self.num_corners)

    @cached_property
    def corners_m(self) -> Float[np.ndarray, "corners 3"]:
        """(corners, 3), positions on the board, metres: inner corners row by row; or four of each marker, clockwise."""
        columns, rows = self.squares_wh
        if self.kind == "grid":
            steps = _steps(np.arange(columns), np.arange(rows))[:, None]
            quad = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (self.marker_m or 0.0)
            flat = (steps * self.square_m + quad).reshape(-1, 2)
        else:
            flat = _steps(np.arange(1, columns), np.arange(1, rows)) * self.square_m
        return np.column_stack([flat, np.zeros(len(flat))]).astype(np.float64)

    @cached_property
    def labellings(self) -> Int[np.ndarray, "labellings corners"]:
        """(labellings, corners), orders of the corners that look alike: turns of a chessboard that keep its colours.

        The first row is the order of `corners_m`; a board with markers has no other row.
        """
        columns, rows = self.squares_wh
        order = np.arange(self.num_corners)
        if self.kind != "chessboard":
            return order[None]
        grid = order.reshape(rows - 1, columns - 1)
        turns = [grid]
        if columns == rows and columns % 2:
            turns += [np.rot90(grid, quarter) for quarter in (1, 2, 3)]
        elif (columns + rows) % 2 == 0:
            turns.append(np.rot90(grid, 2))
        return np.stack([turn.ravel() for turn in turns])


def _steps(
    columns: Int[np.ndarray, " columns"], rows: Int[np.ndarray, " rows"]
) -> Int[np.ndarray, "points 2"]:
    """(points, 2), column and row of each point of a grid, row by row."""
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def save_board(path: Path | str, board: Board, *, force: bool = False) -> Path:
    """Draw a ChArUco board to print at 100 %.

    Args:
        path: file of the page, .pdf, .png or .svg.
        board: the board.
        force: whether an existing file is replaced.

    Raises:
        SettingsError: the file has another ending.
        OutputError: the file exists and `force` is not set, or cannot be written.
    """
    from matplotlib.figure import Figure

    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise SettingsError("board", expected=f"a file that ends in {', '.join(_SUFFIXES)}", found=path.name)
    refuse_to_overwrite(path, force)
    columns, rows = board.squares_wh
    drawn = board.opencv().generateImage((columns * _SQUARE_PX, rows * _SQUARE_PX))
    size = np.array([columns, rows]) + 2 * _BORDER
    figure = Figure(figsize=tuple(1e3 * board.square_m / _INCH_MM * size))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, size[0]), ylim=(0, size[1]))
    axes.axis("off")
    edges = (_BORDER, _BORDER + columns, _BORDER, _BORDER + rows)
    axes.imshow(drawn, cmap="gray", vmin=0, vmax=255, extent=edges, interpolation="nearest")
    axes.set(xlim=(0, size[0]), ylim=(0, size[1]))
    words = f"{columns} x {rows} squares of {1e3 * board.square_m:g} mm, dictionary {board.dictionary}: print at 100 %"
    axes.text(_BORDER, _BORDER / 2, words, fontsize=8, va="center")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=300)
    return path
