"""`psotrack run`: from the videos of a rig to a report, by the commands that a user would type."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from psotrack.cli.commands import command
from psotrack.cli.options import compiled_folder
from psotrack.cli.output import Output
from psotrack.cli.types import says


@command(without=["force"])
def run(
    output: Output,
    folder: Path,
    *,
    square_m: Annotated[float | None, says(metavar="METRES")] = None,
    floor: Annotated[int | None, says(metavar="FRAME")] = None,
    drones: Annotated[int | None, says(metavar="N")] = None,
    again: bool = False,
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

    Options:
        square_m: side of a square of the board in FOLDER/board, as it was printed; needed where FOLDER has no rig file.
        floor: frame of the board's videos in which the board lies on the floor, which becomes the world's origin.
        drones: number of drones. None: all that are found.
        again: do all steps again, also those that are done.
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
