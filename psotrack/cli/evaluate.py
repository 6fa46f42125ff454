"""`psotrack evaluate`: compare tracks with the reference of their sequence."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import click

from psotrack.cli.options import (
    BODIES,
    FORCE,
    JSON,
    QUIET,
    TRACKS,
    plot_option,
    sequence_argument,
    sequence_of,
)
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.errors import SettingsError, errors_name


@click.command(cls=HelpfulCommand)
@TRACKS
@sequence_argument
@plot_option("3D paths and error over time", "beside TRACKS, as .png")
@click.option(
    "--offset",
    metavar="SECONDS|auto",
    callback=lambda _, __, given: _read_offset(given),
    help="Time by which the reference's clock is ahead of the videos'; auto estimates it, up to 2 s.  [default: 0]",
)
@BODIES
@FORCE
@QUIET
@JSON
@pass_output
def evaluate(
    output: Output,
    tracks: Path,
    sequence: Path | None,
    plot: Path | None,
    offset: float | Literal["auto"] | None,
    bodies: dict[str, tuple[str, ...]],
) -> None:
    """Compare TRACKS with the reference of SEQ.

    SEQ is the recording of TRACKS; the record beside TRACKS names it.

    TRACKS is a file of `psotrack track`, or tracks of any other program: CSV, Parquet, JSON, TUM, KITTI, MOTChallenge
    with positions, C3D or MCAP, as a file or a folder.

    \b
    Examples:
      psotrack evaluate my_lab/results/tracks.csv
      psotrack evaluate tracks.csv data/Simulated_Data/S02_D4_A --json errors.json --plot errors.png
      psotrack evaluate tracks.csv data/Real_Data/R12_D4 --offset auto
      psotrack evaluate tracks.csv flight --body cf1=M1,M2,M3,M4 --body cf2
      psotrack evaluate folder_of_tum_files data/Simulated_Data/S02_D4_A
    """
    from psotrack.calibration.clocks import reference_for
    from psotrack.evaluation import evaluate as compare
    from psotrack.evaluation import plots, tables
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    sequence = sequence_of(tracks, sequence)
    recording = open_recording(sequence, bodies=bodies)
    estimate = read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {sequence}"):
        truth, offset_s = reference_for(recording, estimate, offset)
        evaluation = compare(estimate, truth)
    content = evaluation.to_dict() | ({} if offset is None else {"reference_offset_s": offset_s})
    output.json(content)
    clock = "" if offset is None else f", reference's clock {offset_s:+.4f} s"
    output.show(tables.render(evaluation, title=f"{recording.name}{clock}"))
    if plot is not None:
        picture = plot if plot.name else tracks.with_suffix(".png")
        plots.save_overview(picture, estimate, truth, force=output.force)
        output.say(f"{picture}: paths, and errors over time")


def _read_offset(given: str | None) -> float | Literal["auto"] | None:
    """The value of --offset."""
    if given is None:
        return None
    if given == "auto":
        return "auto"
    try:
        offset_s = float(given)
    except ValueError:
        offset_s = math.nan
    if not math.isfinite(offset_s):
        raise SettingsError("--offset", expected="a number of seconds, or auto", found=given)
    return offset_s
