"""`psotrack doctor`: check a sequence's calibration against its detections."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import (
    BODIES,
    CACHE,
    FORCE,
    JOBS,
    JSON,
    SEQUENCE,
    cache_folder,
    detections_of,
    plot_option,
    reporting,
)
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import Numbers
from psotrack.errors import errors_name

if TYPE_CHECKING:
    from psotrack.recordings import Recording

#: Exit code if something was found.
FOUND = 1


@click.command(cls=HelpfulCommand)
@SEQUENCE
@click.option(
    "--detections",
    metavar="yolo|blobs|FOLDER",
    help="Detections in dl_data, blobs of the foreground, or a folder of files in the layout of dl_data.  [default: "
    "yolo where there are some, else blobs]",
)
@click.option(
    "--bounds",
    "bounds_m",
    type=Numbers(6),
    metavar="X0,X1,Y0,Y1,Z0,Z1",
    help="Bounds of the room, in metres.  [default: far around the cameras, above and below]",
)
@click.option(
    "--tracks",
    type=click.Path(path_type=Path),
    metavar="TRACKS",
    help="Find the offset between the clocks of SEQ's reference and of its videos instead, from the motion in TRACKS.",
)
@click.option(
    "--max-offset",
    "max_offset_s",
    type=float,
    default=2.0,
    show_default=True,
    help="Largest offset that is tried, in seconds, in both directions, with --tracks.",
)
@plot_option("the mean distance over the offsets, with --tracks", "beside TRACKS, as .offset.png")
@BODIES
@CACHE
@JOBS
@reporting
@FORCE
@JSON
@pass_output
def doctor(
    output: Output,
    sequence: Path,
    tracks: Path | None,
    bodies: dict[str, tuple[str, ...]],
    cache: Path | None,
    detections: str | None,
    **options: Any,
) -> None:
    """Check the calibration of SEQ against the detections of its cameras, before tracking.

    Reports which camera, pair of cameras or file disagrees, by how much, and what to do. It finds a camera that is
    turned, moved or late, has another focal length, or is exchanged with another camera; camera centres that were read
    as translations; millimetres that were read as metres; mirrored axes; a reference with another clock, unit or
    origin. A video is late if its frame i shows what the others show in an earlier frame.

    A fault is named only if it explains the detections clearly better than a sound rig, whose boxes may have
    correlated errors: the middle of a lopsided body's box is not the same point for two cameras. If faults of several
    cameras explain them equally well, as often with two or three cameras, all are listed and none is certain.

    With --tracks, the offset of the reference's clock minimises the mean distance between TRACKS and the reference, to
    a fraction of a frame. Each drone may have a constant lever arm.

    The exit code is 0 if nothing was found, 1 if something was found, and 2 for an error.

    \b
    Examples:
      psotrack doctor my_lab
      psotrack doctor data/Real_Data/R12_D4 --detections blobs --json -
      psotrack doctor data/Real_Data/R12_D4 --tracks tracks.csv --max-offset 10 --plot offset.png
    """
    from psotrack import api
    from psotrack.recordings.datasets import open_recording

    recording = open_recording(sequence, bodies=bodies)
    max_offset_s, plot = options.pop("max_offset_s"), options.pop("plot")
    if tracks is not None:
        _synchronise(output, recording, tracks, max_offset_s, plot)
        return
    diagnosis = api.doctor(
        recording,
        detections=detections or detections_of(output, recording),
        cache=cache_folder(cache),
        progress=output.report,
        **options,
    )
    output.result(diagnosis)
    if output.quiet:
        output.say(*map(str, diagnosis.findings), always=True)
    if diagnosis.findings:
        sys.exit(FOUND)


def _synchronise(
    output: Output, recording: Recording, tracks: Path, max_offset_s: float, plot: Path | None
) -> None:
    """Find the offset of the reference's clock."""
    from psotrack.calibration.clocks import reference_offset, save_curve
    from psotrack.recordings.exchange import read_tracks

    estimate = read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {recording.folder}"):
        found = reference_offset(recording, estimate, max_offset_s=max_offset_s)
    output.result(found)
    if plot is not None:
        picture = plot if plot.name else tracks.with_suffix(".offset.png")
        save_curve(picture, found.offset, force=output.force)
        output.say(f"picture: {picture}")
