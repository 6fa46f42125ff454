"""`psotrack board`: a board to print, for `psotrack calibrate rig` and `psotrack run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from psotrack.cli.commands import command
from psotrack.cli.output import Output
from psotrack.cli.types import says


@command(without=["progress", "json_path"])
def board(
    output: Output,
    *,
    out: Path = Path("board.pdf"),
    squares_wh: Annotated[tuple[int, int], says(flag="squares", metavar="COLUMNS,ROWS")] = (7, 5),
    square_m: float = 0.035,
    marker_m: float | None = None,
    dictionary: str = "4x4_50",
) -> None:
    """Draw a ChArUco board to print, in its true size.

    Print the page at 100 %, glue it onto something flat, and measure a square: the printed size is what
    `psotrack run --square` and `psotrack calibrate rig --square` want. The default fits a sheet of A4.

    \b
    Examples:
      psotrack board
      psotrack board --square 0.06 --out large.pdf

    Options:
        out: page to write: .pdf, .png or .svg.
        squares_wh: number of squares.
        square_m: side of a square in metres.
        marker_m: side of a marker in metres. None: 3/4 of a square.
        dictionary: dictionary of the markers.
    """
    from psotrack.calibration import Board, describe_board, save_board

    drawn = Board(squares_wh, square_m, marker_m or 0.75 * square_m, dictionary)
    path = save_board(out, drawn, force=output.force)
    output.say(f"{path}: {describe_board(drawn)}; print it at 100 %")
