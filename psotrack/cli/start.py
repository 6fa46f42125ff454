"""`psotrack board`, `demo` and `run`: what a newcomer types first."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from psotrack.cli.commands import command
from psotrack.cli.options import Jobs, compiled_folder
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


#: Small enough for a laptop to do all in a minute, long enough for paths to be seen.
NAME, NUM_FRAMES, SCALE = "S02_D4_A", 75, 0.5


@command(without=["json_path"])
def demo(output: Output, *, out: Path = Path("psotrack-demo"), seed: int = 0, jobs: Jobs = None) -> None:
    """Simulate four drones, track them in eight videos, print the errors and save a picture.

    After an interruption, the next call keeps the simulated sequence and the silhouettes.

    \b
    Example:
      psotrack demo --out demo

    Options:
        out: folder of the results.
        seed: seed of flights, noise and swarm.
    """
    from psotrack.evaluation import evaluate, tables
    from psotrack.foreground.silhouettes import SilhouetteSettings
    from psotrack.pipeline import track_recording, with_real_time
    from psotrack.recordings.datasets import read_sequence
    from psotrack.settings import TrackSettings
    from psotrack.show.flights import flight_of, record_files, write_tracked
    from psotrack.show.overlay import save_picture
    from psotrack.simulation import SimulationSettings, simulate
    from psotrack.support import atomic_write, keep_compiled

    keep_compiled(compiled_folder(None))
    tracks, picture, force = out / "tracks.csv", out / "demo.png", output.force
    output.refuse(tracks, *record_files(tracks), picture)
    made: dict[str, Any] = {"jobs": jobs, "report": output.report}
    simulated = SimulationSettings(NUM_FRAMES, SCALE, seed, masks=False, onboard=False)
    folder = simulate(NAME, out, simulated, force=force, keep=not force, **made)
    began_s = time.perf_counter()
    recording = read_sequence(folder).usable()
    # Half the image size needs half the reduction, so that drones have the same number of silhouette pixels.
    settings = TrackSettings(seed=seed, silhouettes=SilhouetteSettings(reduction=2, working_reduction=1))
    tracked = track_recording(recording, settings, cache=out / "silhouettes", **made)
    record = with_real_time(tracked.record, time.perf_counter() - began_s)
    tracked = replace(tracked, record=record)
    assert recording.truth is not None, "the simulator writes one"
    errors = evaluate(tracked.trajectories, recording.truth)
    with atomic_write(picture) as picture_file:
        save_picture(picture_file, flight_of(tracked, recording))
        write_tracked(tracks, tracked, folder, force=force)
    output.say(*tables.as_text(errors, recording.name).splitlines())
    output.say(f"picture: {picture}")
    # A command of an environment that is not activated is typed with its path.
    program = "psotrack" if shutil.which("psotrack") else os.path.relpath(sys.argv[0])
    output.say(f"next: {program} view {tracks} {folder}")


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
