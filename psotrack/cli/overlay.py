"""`psotrack overlay`: videos with what was found drawn into them."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import (
    CAMERAS,
    FORCE,
    JOBS,
    SEQUENCE,
    TRACKS,
    camera_names,
    frames_option,
    reporting,
)
from psotrack.cli.output import report_to


@click.command()
@TRACKS
@SEQUENCE
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder of the videos, CAMERA.mp4."
)
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
@CAMERAS
@frames_option
@JOBS
@FORCE
@reporting
def overlay(
    tracks: Path,
    sequence: Path,
    out: Path,
    mosaic: bool,
    scale: float,
    cameras: str | None,
    num_frames: int | None,
    jobs: int | None,
    force: bool,
    quiet: bool,
) -> None:
    """Draw TRACKS into the videos of SEQ: boxes, names, trails, 90 % ellipses and time.

    Finished videos of the same TRACKS are kept, so that a run that was interrupted can be continued.

    \b
    Examples:
      psotrack overlay tracks.csv data/Simulated_Data/S02_D4_A --out videos
      psotrack overlay tracks.csv data/Simulated_Data/S02_D4_A --out videos --mosaic
      psotrack overlay tracks.csv flight --out videos --cameras cam1,cam2 --scale 0.5
    """
    from psotrack.show.flights import first_instants, read_flight
    from psotrack.show.overlay import OverlayOptions, write_overlays

    flight = read_flight([tracks], sequence, cameras=camera_names(cameras))
    if num_frames is not None:
        flight = first_instants(flight, num_frames)
    options = OverlayOptions(mosaic=mosaic, scale=scale, force=force)
    written = write_overlays(out, flight, options, jobs=jobs, report=report_to(quiet))
    if not quiet:
        click.echo(written)
