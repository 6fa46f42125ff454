"""`psotrack board`, `demo`, `init` and `run`: what a newcomer types first."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import click
from msgspec import Meta

from psotrack import geometry, pipeline, recordings, simulation, support
from psotrack.cli.commands import command
from psotrack.cli.options import Bodies, Jobs, compiled_folder
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import SequencePath, Words, says
from psotrack.foreground import silhouettes
from psotrack.recordings import datasets
from psotrack.show import flights, overlay

#: Width of the table in a file or a pipe, characters.
_WIDE = 200


def _pair(match: str) -> tuple[str, str]:
    """Camera and file of --match."""
    camera, _, file = match.partition("=")
    if not (camera and file):
        raise ValueError
    return camera, file


@command(without=["progress"])
def init(
    output: Output,
    folder: Annotated[Path, says(type=SequencePath(path_type=Path))],
    *,
    calibration: Annotated[Path | None, says(metavar="FILE")] = None,
    unit: Annotated[Literal["m", "cm", "mm"] | None, says(flag="units")] = None,
    match: Annotated[
        tuple[tuple[str, str], ...], says(multiple=True, type=Words("CAMERA=FILE", "CAMERA=FILE", _pair))
    ] = (),
    leave_out: Annotated[tuple[str, ...], says(multiple=True, metavar="FILE", type=str)] = (),
    fps: Annotated[float, Meta(gt=0, le=1e6)] | None = None,
    size_wh: Annotated[tuple[int, int] | None, says(flag="size", metavar="W,H")] = None,
    out: Annotated[Path | None, says(metavar="FILE")] = None,
    show: bool = False,
    bodies: Bodies,
) -> None:
    """Write the recording.toml of the videos, images and detections in FOLDER, or show what a recording contains.

    Files belong to cameras by their names: cam1i_s.avi to cam1, cam_60881257.mp4 to 60881257, gopro3_clip.MP4 to
    GoPro 3. Nothing is guessed: where names do not say whose files are, the command asks once on a terminal, for all
    files; --match and --leave-out answer before.
    Detections, frame times (frame,time_s), images of what is ignored (a name with "ignore" or "mask"), references and
    marker corners are found by name and content.

    Without a rig file, the cameras have the names of their files, and no place yet.

    With --show, FOLDER is a recording that is there already: a recording.toml or its folder, a folder of the DPJAIT
    dataset, or an archive.

    \b
    Examples:
      psotrack init my_lab
      psotrack init my_lab --calibration rig.toml --match left=GX010123.MP4 --leave-out test.mp4
      psotrack init my_lab --calibration rig.toml --body cf1=M1,M2,M3,M4 --body cf2
      psotrack init data/Simulated_Data/S02_D4_A --show

    Options:
        calibration: rig file, of any format that `calibrate convert` reads. None: the one in FOLDER.
        unit: unit of the lengths in the rig file; needed if the format leaves the unit open.
        match: FILE of FOLDER, or address of a stream, that belongs to CAMERA; may be repeated.
        leave_out: file of FOLDER that is not used; may be repeated.
        fps: frames per second of cameras that have images or detections only.
        size_wh: size of the images of cameras that have detections only, if the rig file states none or another one.
        out: file to write. None: FOLDER/recording.toml.
        show: show what the recording FOLDER contains, and check its files, of videos the last frame; write nothing.
    """
    if show:
        _show(output, folder, bodies)
        return
    out = out or folder / recordings.RECORDING_FILE
    check_suffix("--out", out, ".toml")
    output.refuse(out)
    options = datasets.DraftOptions(
        calibration, unit=unit, match=match, leave_out=leave_out, fps=fps, size_wh=size_wh, bodies=bodies
    )
    draft = datasets.draft_recording(folder, out, asked(folder, out, options) if output.can_ask else options)
    for each in draft.recording.cameras:
        each.check_size()
    older = draft.write()
    _say_inventory(output, draft.to_dict())
    output.say(*str(draft).splitlines())
    if older is not None:
        output.say(f"{older}: the file as it was; copy what you had written into it")


def _show(output: Output, sequence: Path, bodies: dict[str, tuple[str, ...]]) -> None:
    """Show a recording, and check its files."""
    recording = datasets.open_recording(sequence, bodies=bodies)
    for each in recording.cameras:
        each.check_size()
    recording.check_detections(recording.detections)
    if recording.marker_corners is not None:
        from psotrack.inside_out import read_marker_table

        read_marker_table(recording.marker_corners)
    _say_inventory(output, recording.to_dict())


def _say_inventory(output: Output, content: dict[str, Any]) -> None:
    output.json(content)
    title, headings, rows = recordings.inventory(content)
    output.table(headings, rows, title, least_width=_WIDE)


def asked(folder: Path, out: Path, options: datasets.DraftOptions) -> datasets.DraftOptions:
    """The options with what the user answers of the files whose names do not say whose they are.

    Raises:
        InputError: a line is empty: the error that names these files.
    """
    from dataclasses import replace

    matching = datasets.match_files(folder, out, options)
    questions = matching.questions()
    if not questions:
        return options
    # Numbers of a list beside cameras that are numbers would be read wrongly.
    numbered = not any(name.isdecimal() for name in matching.cameras)
    numbers = {f"{number}": name for number, name in enumerate(matching.cameras, 1)} if numbered else {}
    click.echo("cameras:")
    for number, name in enumerate(matching.cameras, 1):
        click.echo(f"  {number}  {name}" if numbered else f"  {name}")
    click.echo(
        f"Whose are these {len(questions)} files? A camera's {'number or ' if numbered else ''}name; "
        "- leaves a file out; an empty line ends without any change."
    )
    matched, left_out = [*options.match], [*options.leave_out]
    for path, (_, found) in questions.items():
        file = os.path.relpath(path, folder)
        answer = _answer(f"  {file} ({found}): ", matching, numbers)
        if answer == "-":
            left_out.append(file)
        else:
            matched.append((answer, file))
    return replace(options, match=matched, leave_out=left_out)


def _answer(question: str, matching: datasets.Matching, numbers: dict[str, str]) -> str:
    """The camera of a file, or "-"."""
    while True:
        try:
            answer = input(question).strip()
        except EOFError:
            answer = ""
        if not answer:
            raise matching.error()
        camera = numbers.get(answer) or geometry.chosen_camera(answer, matching.cameras)
        if answer == "-" or camera is not None:
            return camera or answer
        if matching.calibration is None:
            return answer
        click.echo(f"  expected a camera of {matching.calibration.name}, or -, found {answer}")


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
    from psotrack.settings import TrackSettings

    support.keep_compiled(compiled_folder(None))
    tracks, picture, force = out / "tracks.csv", out / "demo.png", output.force
    output.refuse(tracks, *flights.record_files(tracks), picture)
    made: dict[str, Any] = {"jobs": jobs, "report": output.report}
    simulated = simulation.SimulationSettings(NUM_FRAMES, SCALE, seed, masks=False, onboard=False)
    folder = simulation.simulate(NAME, out, simulated, force=force, keep=not force, **made)
    began_s = time.perf_counter()
    recording = datasets.read_sequence(folder).usable()
    # Half the image size needs half the reduction, so that drones have the same number of silhouette pixels.
    settings = TrackSettings(
        seed=seed, silhouettes=silhouettes.SilhouetteSettings(reduction=2, working_reduction=1)
    )
    tracked = pipeline.track_recording(recording, settings, cache=out / "silhouettes", **made)
    record = pipeline.with_real_time(tracked.record, time.perf_counter() - began_s)
    tracked = replace(tracked, record=record)
    assert recording.truth is not None, "the simulator writes one"
    errors = evaluate(tracked.trajectories, recording.truth)
    with support.atomic_write(picture) as picture_file:
        overlay.save_picture(picture_file, flights.flight_of(tracked, recording))
        flights.write_tracked(tracks, tracked, folder, force=force)
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

    files = datasets.DraftOptions()
    if output.can_ask and datasets.videos_in(folder) and not (folder / recordings.RECORDING_FILE).exists():
        files = asked(folder, folder / recordings.RECORDING_FILE, files)
    support.keep_compiled(compiled_folder(None))
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
