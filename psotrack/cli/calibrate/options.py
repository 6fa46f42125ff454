"""Options that the commands of `calibrate` share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import Size, dictionary_option
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.calibration import Board

OUT = click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Calibration to write: a file that ends in .toml, .yml or .csv.",
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


def board_options() -> Any:
    """Options that describe a board; `board_of` makes the board."""
    options: list[Any] = [
        click.option(
            "--board",
            "kind",
            type=click.Choice(["charuco", "chessboard", "grid"]),
            help="Kind of the board; a grid is one of ArUco markers or AprilTags.  "
            "[default: grid with --separation or --squares 1x1, charuco with --marker, else chessboard]",
        ),
        click.option(
            "--squares",
            "squares_wh",
            type=Size(),
            metavar="COLUMNSxROWS",
            help="Number of squares of the board, of markers for a grid, such as 4x5.",
        ),
        click.option("--square", "square_m", type=float, help="Side of a square in metres."),
        click.option("--marker", "marker_m", type=float, help="Side of a marker in metres."),
        click.option(
            "--separation", "separation_m", type=float, help="Gap between the markers of a grid in metres."
        ),
        dictionary_option(),
        click.option(
            "--first-marker",
            type=click.IntRange(min=0),
            default=0,
            show_default=True,
            help="Number of the first marker of a grid; the others count on from it, row by row.",
        ),
    ]

    def decorate(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


def board_of(
    kind: str | None,
    squares_wh: tuple[int, int],
    square_m: float | None,
    marker_m: float | None,
    separation_m: float | None,
    dictionary: str,
    first_marker: int,
) -> Board:
    """The board of the options."""
    from psotrack.calibration import Board

    if kind is None:
        is_grid = separation_m is not None or squares_wh == (1, 1)
        kind = "grid" if is_grid else "charuco" if marker_m is not None else "chessboard"
    if kind == "grid":
        if marker_m is not None and squares_wh == (1, 1):
            # A single marker has no gap to another one.
            separation_m = 0.0
        if marker_m is None or separation_m is None:
            raise SettingsError(
                "board",
                expected="--marker and --separation of a grid",
                found="--marker only" if marker_m else "no --marker",
            )
        return Board(squares_wh, marker_m + separation_m, marker_m, dictionary, "grid", first_marker)
    if square_m is None:
        raise SettingsError("board", expected="--square, the side of a square in metres", found="none")
    if kind == "chessboard":
        return Board(squares_wh, square_m, marker_m, dictionary, "chessboard")
    return Board(squares_wh, square_m, marker_m, dictionary)
