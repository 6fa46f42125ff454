"""`psotrack evaluate`: compare tracks with the reference of their sequence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

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
from psotrack.errors import InputError, SettingsError, errors_name

if TYPE_CHECKING:
    from psotrack.recordings import Recording
    from psotrack.trajectories import Trajectories

#: Tracks whose rate differs by less than this share from the recording's have the recording's rate.
RATE_TOLERANCE = 1e-3


@click.command(cls=HelpfulCommand)
@TRACKS
@sequence_argument
@plot_option("3D paths and error over time", "beside TRACKS, as .png")
@click.option(
    "--offset",
    metavar="SECONDS|auto",
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
    offset: str | None,
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
    from psotrack.evaluation import evaluate as compare
    from psotrack.evaluation import plots, tables
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    sequence = sequence_of(tracks, sequence)
    recording = open_recording(sequence, bodies=bodies)
    if recording.truth is None:
        raise InputError(sequence, expected="a reference to compare with", found="none")
    estimate = read_tracks(tracks, recording=recording)
    recording = _at_rate_of(estimate, recording)
    truth, offset_s, both = recording.truth, 0.0, f"{tracks} and {sequence}"
    assert truth is not None
    if offset is not None:
        truth, offset_s = _shifted_reference(recording, estimate, offset, where=both)
    with errors_name(both):
        evaluation = compare(estimate, truth)
    content = evaluation.to_dict() | ({"reference_offset_s": offset_s} if offset else {})
    output.json(content)
    title = f"{recording.name}, reference's clock {offset_s:+.4f} s" if offset else recording.name
    output.show(tables.render(evaluation, title=title))
    if plot is not None:
        picture = plot if plot.name else tracks.with_suffix(".png")
        plots.save_overview(picture, estimate, truth, force=output.force)
        output.say(f"{picture}: paths, and errors over time")


def _at_rate_of(estimate: Trajectories, recording: Recording) -> Recording:
    """The recording, with its reference at the instants of tracks that have a rate of their own (`track --rate`)."""
    from psotrack.trajectories import resample

    if estimate.num_frames < 2 or recording.reference is None:
        return recording
    rate_hz = float(np.ptp(estimate.frame) / max(np.ptp(estimate.time_s), 1e-9))
    if abs(rate_hz / recording.fps - 1) < RATE_TOLERANCE:
        return recording
    timed = replace(recording, timing=replace(recording.timing, rate_hz=rate_hz))
    time_s = timed.timeline().time_s
    truth = resample(recording.reference.truth, np.arange(len(time_s)), time_s)
    return replace(timed, reference=replace(recording.reference, truth=truth))


def _shifted_reference(
    recording: Recording, estimate: Trajectories, offset: str, *, where: str
) -> tuple[Trajectories, float]:
    """The reference at the frames of the videos, and the time by which the reference's clock is ahead, seconds."""
    from psotrack.calibration.clocks import find_offset, own_reference, shifted

    reference = own_reference(recording)
    if offset == "auto":
        clock = (reference.time_s, reference.position_m, reference.orientation_wxyz)
        with errors_name(where):
            offset_s = find_offset(estimate, *clock, max_offset_s=2.0).offset_s
    else:
        try:
            offset_s = float(offset)
        except ValueError:
            offset_s = math.nan
        if not math.isfinite(offset_s):
            raise SettingsError("--offset", expected="a number of seconds, or auto", found=offset)
    time_s = recording.timeline().time_s
    return shifted(reference, offset_s, np.arange(len(time_s)), time_s), offset_s
