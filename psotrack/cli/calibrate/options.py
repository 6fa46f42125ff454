"""Options that the commands of `calibrate` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click
from msgspec import Meta

from psotrack.cli.options import out_option
from psotrack.cli.types import Size
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.calibration import Board

OUT = out_option(
    "Calibration to write: a file that ends in .toml, .yml or .csv.",
    default=Path("rig.toml"),
    show_default=True,
)
SIZE = click.option(
    "--size",
    "image_size_wh",
    type=Size(),
    help="Size of the images in pixels, if the calibration file does not contain the size.",
)


def noise_option(default: float) -> Any:
    """Option `--noise`: standard deviation of points in the image."""
    return click.option(
        "--noise",
        "noise_px",
        type=float,
        default=default,
        show_default=True,
        help="Standard deviation of a point in the image, along x and along y, in pixels.",
    )


LENS = click.option(
    "--lens",
    default="auto",
    show_default=True,
    metavar="auto|0|4|5|8|12|14|fisheye",
    help="Number of distortion coefficients of OpenCV's lens model, or its fisheye model; auto chooses by views that "
    "are left out.",
)


@dataclass(frozen=True)
class BoardOptions:
    """The board that is moved before the cameras.

    Attributes:
        kind: kind of the board; a grid is one of ArUco markers or AprilTags; None: grid with --separation or --squares
            1x1, charuco with --marker, else chessboard.
        squares: number of squares of the board, of markers for a grid, such as 4x5.
        square_m: side of a square in metres.
        marker_m: side of a marker in metres.
        separation_m: gap between the markers of a grid in metres.
        dictionary: dictionary of the markers; any dictionary of OpenCV.
        first_marker: number of the first marker of a grid; the others count on from it, row by row.
    """

    kind: Literal["charuco", "chessboard", "grid"] | None = None
    squares: Annotated[tuple[int, int], Meta(extra={"metavar": "COLUMNSxROWS", "type": Size()})] | None = None
    square_m: float | None = None
    marker_m: float | None = None
    separation_m: float | None = None
    dictionary: str = "4x4_1000"
    first_marker: Annotated[int, Meta(ge=0)] = 0

    def board(self) -> Board:
        """The board of the options.

        Raises:
            SettingsError: the options do not say what the board is like.
        """
        from psotrack.calibration import Board

        if self.squares is None:
            raise SettingsError("board", expected="--squares, the number of squares", found="none")
        kind, marker_m, separation_m = self.kind, self.marker_m, self.separation_m
        if kind is None:
            is_grid = separation_m is not None or self.squares == (1, 1)
            kind = "grid" if is_grid else "charuco" if marker_m is not None else "chessboard"
        if kind == "grid":
            if marker_m is not None and self.squares == (1, 1):
                # A single marker has no gap to another one.
                separation_m = 0.0
            if marker_m is None or separation_m is None:
                raise SettingsError(
                    "board",
                    expected="--marker and --separation of a grid",
                    found="--marker only" if marker_m else "no --marker",
                )
            side_m = marker_m + separation_m
            return Board(self.squares, side_m, marker_m, self.dictionary, "grid", self.first_marker)
        if self.square_m is None:
            raise SettingsError("board", expected="--square, the side of a square in metres", found="none")
        return Board(self.squares, self.square_m, marker_m, self.dictionary, kind)


#: Names of the options of `BoardOptions`.
BOARD_NAMES = {"kind": "board"}
