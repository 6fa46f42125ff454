"""`psotrack run`: from the videos of a rig to a report, by the commands that a user would type."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click

from psotrack.cli.options import reporting
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.errors import InputError, SettingsError

#: Kind of the doctor's finding that `track --clocks auto` answers.
_CLOCK = "clock"


class _Step(NamedTuple):
    """A command of a run: its words, and the file that says that the command was done; None: it is always run."""

    words: tuple[str, ...]
    made: Path | None


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
@pass_output
def run(
    output: Output, folder: Path, square_m: float | None, floor: int | None, drones: int | None, again: bool
) -> None:
    """Calibrate, check, track and show the videos of a rig in FOLDER, from board to report.

    FOLDER has a video of each camera, and a folder `board` with videos of the same cameras in which a board is moved
    (`psotrack board` draws one), or a rig file. Each command is printed before it runs, so that it can be typed with
    other options. The results are in FOLDER/results. A run that was stopped goes on where it was; to repeat a step,
    remove what it made.

    \b
    Examples:
      psotrack run my_lab --square 0.035
      psotrack run my_lab --square 0.035 --floor 0 --drones 4
    """
    from psotrack.recordings.datasets import open_recording, videos_in

    if not videos_in(folder):
        raise InputError(folder, expected="a video of each camera", found="none")
    results = folder / "results"
    _do(output, _first_steps(folder, square_m, floor, again), again)
    if not open_recording(folder).is_placed:
        raise InputError(
            folder,
            expected=f"videos of a board in {folder / 'board'}, or a rig file",
            found="neither",
            remedy="`psotrack board` draws a board",
        )
    findings = results / "doctor.json"
    checked = _Step(("doctor", f"{folder}", "--json", f"{findings}"), findings)
    _do(output, iter([checked]), again)
    _do(output, _last_steps(folder, drones, _clocks(findings)), again)
    output.say(f"report: {results / 'report.html'}", f"videos: {results / 'overlay'}")


def _first_steps(folder: Path, square_m: float | None, floor: int | None, again: bool) -> Iterator[_Step]:
    """From videos of a board to a recording whose cameras have places."""
    from psotrack.recordings import RECORDING_FILE
    from psotrack.recordings.datasets import open_recording

    drafted = (folder / RECORDING_FILE).exists()
    if drafted and not again and open_recording(folder).is_placed:
        return
    rig, board = folder / "rig.toml", folder / "board"
    # Another rig file is found by `init`.
    if board.is_dir():
        if square_m is None and (again or not rig.exists()):
            raise SettingsError(
                "--square", expected="the side of a square of the board, metres", found="none"
            )
        placed = () if floor is None else ("--floor", f"{floor}")
        yield _Step(
            ("calibrate", "rig", f"{board}", "--square", f"{square_m}", *placed, "--out", f"{rig}"), rig
        )
    words = ("--calibration", f"{rig}") if rig.exists() else ()
    if drafted:
        # A recording whose cameras have no places yet; `init` keeps the old file beside the new one.
        yield _Step(("init", f"{folder}", *words, "--force"), None)
    else:
        yield _Step(("init", f"{folder}", *words), folder / RECORDING_FILE)


def _last_steps(folder: Path, drones: int | None, clocks: tuple[str, ...]) -> Iterator[_Step]:
    """From a recording to tracks and what shows them."""
    results = folder / "results"
    tracks = results / "tracks.csv"
    count = () if drones is None else ("--drones", f"{drones}")
    yield _Step(("track", f"{folder}", *clocks, *count, "--out", f"{tracks}"), tracks)
    yield _Step(
        ("report", f"{tracks}", f"{folder}", "--out", f"{results / 'report.html'}"), results / "report.html"
    )
    # The command itself keeps the videos that are finished.
    yield _Step(("overlay", f"{tracks}", f"{folder}", "--out", f"{results / 'overlay'}"), None)


def _clocks(findings: Path) -> tuple[str, ...]:
    """Options of `track` where the doctor found a camera that is late."""
    from psotrack.support import read_json

    kinds = {each["kind"] for each in read_json(findings)["findings"]}
    return ("--clocks", "auto") if _CLOCK in kinds else ()


def _do(output: Output, steps: Iterator[_Step], again: bool) -> None:
    """Print and run the commands that are not done."""
    from psotrack.cli import cli

    for step in steps:
        if step.made is not None and step.made.exists() and not again:
            output.say(f"{step.made}: there already")
            continue
        output.say(f"$ psotrack {shlex.join(step.words)}")
        words = [*step.words, *(["--quiet"] if output.quiet else []), *(["--force"] if again else [])]
        if step.words[0] != "init":
            words += ["--progress", output.progress]
        try:
            # `cli.main` would answer Ctrl-C itself.
            with cli.make_context("psotrack", words) as context:
                cli.invoke(context)
        except SystemExit as ended:
            # The doctor ends with 1 where it found something, which `track` may answer.
            if ended.code != 1:
                raise
