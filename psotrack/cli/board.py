"""`psotrack board`: a board to print, for `psotrack calibrate rig` and `psotrack run`."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, QUIET, out_option
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import Size


@click.command(cls=HelpfulCommand)
@out_option("Page to write: .pdf, .png or .svg.", default=Path("board.pdf"), show_default=True)
@click.option(
    "--squares",
    "squares_wh",
    type=Size(),
    default="7x5",
    show_default=True,
    metavar="COLUMNSxROWS",
    help="Number of squares.",
)
@click.option(
    "--square", "square_m", type=float, default=0.035, show_default=True, help="Side of a square in metres."
)
@click.option(
    "--marker", "marker_m", type=float, help="Side of a marker in metres.  [default: 3/4 of a square]"
)
@click.option("--dictionary", default="4x4_50", show_default=True, help="Dictionary of the markers.")
@FORCE
@QUIET
@pass_output
def board(
    output: Output,
    out: Path,
    squares_wh: tuple[int, int],
    square_m: float,
    marker_m: float | None,
    dictionary: str,
) -> None:
    """Draw a ChArUco board to print, in its true size.

    Print the page at 100 %, glue it onto something flat, and measure a square: the printed size is what
    `psotrack run --square` and `psotrack calibrate rig --square` want. The default fits a sheet of A4.

    \b
    Examples:
      psotrack board
      psotrack board --square 0.06 --out large.pdf
    """
    from psotrack.calibration import Board, describe_board, save_board

    drawn = Board(squares_wh, square_m, marker_m or 0.75 * square_m, dictionary)
    path = save_board(out, drawn, force=output.force)
    output.say(f"{path}: {describe_board(drawn)}; print it at 100 %")
