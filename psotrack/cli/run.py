"""`psotrack run`: from the videos of a rig to a report, by the commands that a user would type."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import JSON, compiled_folder, reporting
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand


@click.command(cls=HelpfulCommand)
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--square",
    "square_m",
    type=float,
    metavar="METRES",
    help="Side of a square of the board in FOLDER/board, as it was printed; needed where FOLDER has no rig file.",
)
@click.option(
    "--floor",
    type=int,
    metavar="FRAME",
    help="Frame of the board's videos in which the board lies on the floor, which becomes the world's origin.",
)
@click.option("--drones", type=int, metavar="N", help="Number of drones.  [default: all that are found]")
@click.option("--again", is_flag=True, help="Do all steps again, also those that are done.")
@reporting
@JSON
@pass_output
def run(
    output: Output, folder: Path, square_m: float | None, floor: int | None, drones: int | None, again: bool
) -> None:
    """Calibrate, check, track and show the videos of a rig in FOLDER, from board to report.

    FOLDER has a video of each camera, and a folder `board` with videos of the same cameras in which a board is moved
    (`psotrack board` draws one), or a rig file. Each step's command is printed before it, so that it can be typed with
    other options. The results are in FOLDER/results. A run that was stopped goes on where it was; to repeat a step
    and those after it, remove what it made.

    \b
    Examples:
      psotrack run my_lab --square 0.035
      psotrack run my_lab --square 0.035 --floor 0 --drones 4
    """
    from psotrack import api
    from psotrack.cli.init import asked
    from psotrack.recordings import RECORDING_FILE
    from psotrack.recordings.datasets import DraftOptions, videos_in
    from psotrack.support import keep_compiled

    files = DraftOptions()
    if output.can_ask and videos_in(folder) and not (folder / RECORDING_FILE).exists():
        files = asked(folder, folder / RECORDING_FILE, files)
    keep_compiled(compiled_folder(None))
    summary = api.run(
        folder,
        square_m=square_m,
        floor=floor,
        drones=drones,
        again=again,
        progress=output.report,
        say=lambda words: output.say(*words.splitlines()),
        match=files.match,
        leave_out=files.leave_out,
    )
    output.result(summary)
