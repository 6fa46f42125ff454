"""`psotrack overlay`: videos with what was found drawn into them."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import (
    FORCE,
    TRACKS,
    Extent,
    extent_options,
    out_option,
    reporting,
    sequence_argument,
    sequence_of,
)
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand


@click.command(cls=HelpfulCommand)
@TRACKS
@sequence_argument
@out_option("Folder of the videos, CAMERA.mp4.  [default: overlay beside TRACKS]")
@click.option(
    "--mosaic",
    is_flag=True,
    help="Write one video of all cameras with a map from above, mosaic.mp4, instead of a video per camera.",
)
@click.option(
    "--scale",
    type=click.FloatRange(min=0, min_open=True, max=4),
    default=1.0,
    show_default=True,
    help="Size of the videos per size of the cameras' videos; the mosaic is 1920 pixels wide.",
)
@extent_options
@FORCE
@reporting
@pass_output
def overlay(
    output: Output,
    tracks: Path,
    sequence: Path | None,
    out: Path | None,
    mosaic: bool,
    scale: float,
    extent: Extent,
) -> None:
    """Draw TRACKS into the videos of SEQ: boxes, names, trails, 90 % ellipses and time.

    SEQ is the recording of TRACKS; the record beside TRACKS names it. Finished videos of the same TRACKS are kept, so
    that a run that was interrupted can be continued.

    \b
    Examples:
      psotrack overlay my_lab/results/tracks.csv
      psotrack overlay tracks.csv my_lab --out videos --mosaic
      psotrack overlay tracks.csv my_lab --out videos --cameras cam1,cam2 --scale 0.5
    """
    from psotrack import api

    written = api.overlay(
        tracks,
        out,
        recording=sequence_of(tracks, sequence),
        cameras=extent.cameras,
        num_frames=extent.num_frames,
        jobs=extent.jobs,
        progress=output.report,
        mosaic=mosaic,
        scale=scale,
        force=output.force,
    )
    output.say(f"{written}")
